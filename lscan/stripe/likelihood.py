"""The extractor that makes the most of the pixels: maximum likelihood of a Gaussian line."""

from dataclasses import dataclass, replace

import numpy as np

from lscan.config.rig import StripeSection
from lscan.records import Floats, GreyValues, Ints, Mask, Status, Stripe, select
from lscan.stripe.api import on_integers
from lscan.stripe.fit import (
    CENTRE,
    LN_HEIGHT,
    LN_WIDTH,
    TILT,
    LineFit,
    LinePrior,
    LineSearch,
    LineWindows,
    Scatter,
    fit_lines,
    parameters_of,
    scatter_of,
)
from lscan.stripe.peaks import (
    FWHM,
    Peaks,
    all_windows,
    clipped_middles,
    clipped_near,
    nominal_peaks,
    running_median,
    smoothed_crests,
    stripe_at,
    windows,
)
from lscan.stripe.picture import Noise, constant_variance, sample_of, stated_noise
from lscan.stripe.returns import withhold

# What every extractor that fits itself to the line must know first: place, width, noise.
#
# A sample of the columns is fitted with the full model (fit.py); the line's width and the
# slope of the ground under it vary little from one column to the next, so a running median
# over the sample holds for the columns between, and the residuals give the noise.


_SAMPLE = 256
_NEIGHBOURS = 9  # of the sample, whose median holds for the columns between them
_FIRST_REACH_PX = 32
_WIDTHS_PX = (0.4, 12.0)
_NOISE_TURNS = 3  # of noise from residuals and residuals from noise, until they agree
_WIDTH_DOUBT = 0.4  # of the logarithm of the first guess
_ROUNDED_DN2 = 1.5
"""Mean square of second differences that rounding leaves: 6 / 12 of three rounded values, twice
that where the brighter of two colours was subtracted; and half as much again."""
_FILLED_IN_PX2 = 4 / 6
"""What the mean of both neighbours adds to a line's variance: a triangle of two pixels each way."""
_UNLIKE_ROWS = 20.0  # times that the rows between have: a line wider than a pixel has them alike
_APART = {1: 1, 2: 4}
"""Columns to the next that shares no noise, by the pitch of the rows: of a colour seen in every
second column too, those between are the mean of both beside them."""
_SEEN_NOISE = {1: 1.0, 2: 4 / 3}
"""Variance of a seen pixel over that of all: half of the columns have half of it."""


@dataclass(frozen=True)
class Guess:
    """A quantity of K columns and how far a single column may lie from it.

    Attributes
    ----------
    value : (K,) array, of the quantity
    spread : float, one sigma
    """

    value: Floats
    spread: float


@dataclass(frozen=True)
class Survey:
    """The columns with a line in them, K, and what is known of that line.

    Attributes
    ----------
    stripe : Stripe, statuses and peaks of all columns; no centres yet
    peaks : Peaks, the pixel at which each line, smoothed over its width, is brightest
    reach_px : (K,) array, px, how far from there the centre may lie: two widths, or the span if
        that is more, all of them in the picture
    view : LineWindows, px and DN, the pixels about the peaks
    start : (K, 5) array, px and DN, a first guess of the line, as in fit.py
    ln_width : Guess, of the logarithm of the width in px
    tilt : Guess, DN/px, of the ground
    noise : Noise, of the pixels
    misfit : float, share of its light by which the line is no Gaussian; its part that is odd about
        the centre (fit.py)
    pitch_px : int, rows from one that the camera has seen to the next
    """

    stripe: Stripe
    peaks: Peaks
    reach_px: Floats
    view: LineWindows
    start: Floats
    ln_width: Guess
    tilt: Guess
    noise: Noise
    misfit: float
    pitch_px: int

    @property
    def width_px(self) -> Floats:
        """(K,) standard deviation of the line across it, as its neighbours have it."""
        return np.exp(self.ln_width.value)

    def is_near(self, offset: Floats, sigma: Floats) -> Mask:
        """(K,) whether a centre was found: it and its sigma both within ``reach_px``.

        Parameters
        ----------
        offset : (K,) array, px, of the centre from the peak; NaN where there is none
        sigma : (K,) array, px, its standard uncertainty
        """
        with np.errstate(invalid="ignore"):
            near: Mask = np.abs(offset) <= self.reach_px
            near &= (sigma > 0) & (sigma <= self.reach_px)
        return near


def survey(image: GreyValues, settings: StripeSection, clipped: Mask) -> Survey | Stripe:
    """What is known of the line in a picture, or the stripe itself where there is none.

    The noise is the one in ``settings.noise`` or, without, estimated from the picture.

    Parameters
    ----------
    image : (H, W) array, DN, as extractors get it
    settings : StripeSection, threshold, span and noise
    clipped : (H, W) mask, as extractors get it
    """
    found = _lit_columns(image, settings, clipped)
    return _survey_by_sample(found) if isinstance(found, _LitColumns) else found


@dataclass(frozen=True)
class _LitColumns:
    """What is known of the K columns with a line before any line is fitted.

    As in :class:`Survey`; width_px: (K,) the rough width.  known_from: second differences that
    the noise is known from, 0 where it is stated.  sample: indices of the columns that are fitted.
    """

    settings: StripeSection
    stripe: Stripe
    peaks: Peaks
    width_px: Floats
    noise: Noise
    known_from: int
    view: LineWindows
    start: Floats
    pitch_px: int
    sample: Ints


def _lit_columns(image: GreyValues, settings: StripeSection, clipped: Mask) -> _LitColumns | Stripe:
    """The columns with a line, or the stripe itself where there are none."""
    # Writable: loops would be compiled once more for what a stranger may read alone.
    columns, lost = np.require(image.T, None, ["C", "W"]), np.ascontiguousarray(clipped.T)
    stripe, peaks = nominal_peaks(columns, settings)
    if len(peaks.columns) == 0:
        return stripe
    if settings.noise is None:
        noise = Noise(constant_variance(columns), 0.0)
    else:
        noise = stated_noise(settings.noise, float(np.median(peaks.base)))
    peaks = replace(peaks, rows=clipped_middles(lost, peaks)[0].astype(int))
    rough = _rough_width(columns, peaks, noise.constant)
    if settings.line_width_px is not None:
        rough = np.full(len(rough), settings.line_width_px / FWHM)
    width_px = float(np.median(rough))
    peaks = replace(peaks, rows=smoothed_crests(columns, peaks.columns, peaks.rows, width_px))
    stripe, peaks, rough = _within(stripe, peaks, rough, columns.shape[1], settings)
    if len(peaks.columns) == 0:
        return stripe
    view, known_from = _view(columns, lost, peaks, rough), 0
    pitch, first_row = _seen_rows(view, peaks.rows)
    if pitch > 1:
        seen = (peaks.rows[:, None] + view.steps.astype(int)) % pitch == first_row
        view = replace(view, used=view.used & seen)
        rough = np.sqrt(np.maximum(rough**2 - _FILLED_IN_PX2, _WIDTHS_PX[0] ** 2))
    if settings.noise is None:
        scaled = replace(peaks, rows=peaks.rows // pitch)
        aside = _aside(columns[:, first_row::pitch], scaled, rough / pitch)
        constant = _SEEN_NOISE[pitch] * constant_variance(aside)
        noise, known_from = Noise(constant, 0.0), aside[:, 2:].size
    start, count = _start(view, rough), len(rough)
    # About _SAMPLE columns, evenly, each with the next that shares no noise with it.
    first = np.arange(0, count, max(1, -(-2 * count // _SAMPLE)))
    sample = np.unique(np.minimum(np.concatenate([first, first + _APART[pitch]]), count - 1))
    return _LitColumns(
        settings, stripe, peaks, rough, noise, known_from, view, start, pitch, sample
    )


def _survey_by_sample(found: _LitColumns) -> Survey:
    """The survey of a picture with a line, from the fits to a sample of it.

    The noise is that found before where the settings state it, else as the lines' residuals have
    it.
    """
    precision = weak_precision(found.start)
    precision[:, LN_WIDTH] = 1 / _WIDTH_DOUBT**2
    prior = LinePrior(found.start, precision)
    search = LineSearch(found.view, found.start, found.noise, prior).of(found.sample)
    fit, scatter = _fit_sample(search, found)
    for _ in range(_NOISE_TURNS if found.settings.noise is None else 0):
        noise = scatter.noise(found.noise.constant, found.known_from)
        search = replace(search, start=fit.parameters, noise=noise)
        fit, scatter = _fit_sample(search, found)
    return _survey(found, fit, search.noise, scatter.misfit(search.noise))


def _fit_sample(search: LineSearch, found: _LitColumns) -> tuple[LineFit, Scatter]:
    fit, peaks = fit_lines(search), select(found.peaks, found.sample)
    scatter = scatter_of(fit, peaks.columns, peaks.rows, _APART[found.pitch_px])
    return fit, replace(scatter, different=_SEEN_NOISE[found.pitch_px] * scatter.different)


def _survey(found: _LitColumns, fit: LineFit, noise: Noise, misfit: float) -> Survey:
    """The survey, with what the ``fit`` of the sample says of all columns."""
    count, start = len(found.width_px), found.start.copy()
    ln_width, tilt = (_between(fit, which, found.sample, count) for which in (LN_WIDTH, TILT))
    start[:, LN_WIDTH], start[:, TILT] = ln_width.value, tilt.value
    reach = _reach(found.width_px, found.settings)
    known = (found.stripe, found.peaks, reach, found.view, start)
    return Survey(*known, ln_width, tilt, noise, misfit, found.pitch_px)


def _aside(columns: GreyValues, peaks: Peaks, width_px: Floats) -> GreyValues:
    """Pixels more than six widths away from the line, one sampled column a row.

    Those below it first, then, one odd pair in hundreds, those from the top on.  All pixels of
    columns that have none.
    """
    sample = _sample(len(peaks.rows))
    sample = sample[sample_of(len(sample))]
    height = columns.shape[1]
    reach = int(np.ceil(6 * np.median(width_px))) + 2
    if height - 2 * reach < 3:
        return columns[sample_of(len(columns))]
    seen = columns[peaks.columns[sample]]
    around = all_windows(np.concatenate([seen, seen], axis=1), height - 2 * reach)
    return around[np.arange(len(sample)), (peaks.rows[sample] + reach) % height]


def _sample(count: int) -> Ints:
    return np.arange(0, count, -(-count // _SAMPLE))


def _rough_width(columns: GreyValues, peaks: Peaks, constant: float) -> Floats:
    """Width (K,) in px of each line, from the sums of its light and of its light squared.

    A Gaussian of flux F has the sum of squares F² / (2 sqrt(pi) s).  Twice, the second time
    in windows no wider than the line needs.
    """
    sample = _sample(len(peaks.rows))
    chosen = select(peaks, sample)
    reach = _FIRST_REACH_PX
    for _ in range(2):
        light = _above_ground(windows(columns, chosen.columns, chosen.rows, reach))
        flux = np.maximum(light.sum(axis=1), 0.0)
        squares = (light**2).sum(axis=1) - light.shape[1] * constant
        width = flux**2 / (2 * np.sqrt(np.pi) * np.maximum(squares, constant))
        width = np.clip(width, *_WIDTHS_PX)
        reach = int(np.ceil(4 * np.median(width))) + 3
    smooth = running_median(width, _NEIGHBOURS)
    return np.interp(np.arange(len(peaks.rows)), sample, smooth)


def _above_ground(windows: Floats) -> Floats:
    """Windows (K, n) less the straight line through the medians of their ends."""
    n = windows.shape[1]
    end = max(2, n // 8)
    left, right = np.median(windows[:, :end], axis=1), np.median(windows[:, -end:], axis=1)
    rise = np.clip((np.arange(n) - (end - 1) / 2) / (n - end), 0, 1)
    return windows - left[:, None] - (right - left)[:, None] * rise


def _reach(width_px: Floats, settings: StripeSection) -> Floats:
    return np.maximum(np.ceil(2 * width_px), settings.span_px)


def _within(
    stripe: Stripe, peaks: Peaks, width_px: Floats, height: int, settings: StripeSection
) -> tuple[Stripe, Peaks, Floats]:
    """The peaks whose line lies whole in the picture; AT_BORDER for the others."""
    reach = _reach(width_px, settings)
    inside = (peaks.rows >= reach) & (peaks.rows < height - reach)
    status = stripe.status.copy()
    status[peaks.columns[~inside]] = Status.AT_BORDER
    kept = select(peaks, inside)
    return replace(stripe, status=status), kept, width_px[inside]


def _view(columns: GreyValues, lost: Mask, peaks: Peaks, width_px: Floats) -> LineWindows:
    """The windows, four widths and two pixels to either side."""
    reach = np.ceil(4 * width_px).astype(int)[:, None] + 2
    steps = np.arange(-reach.max(), reach.max() + 1)
    rows = peaks.rows[:, None] + steps
    used = (np.abs(steps) <= reach) & (rows >= 0) & (rows < columns.shape[1])
    grey = windows(columns, peaks.columns, peaks.rows, steps)
    clipped = windows(lost, peaks.columns, peaks.rows, steps) > 0
    return LineWindows(steps.astype(float), grey, peaks.base, used, clipped)


def _seen_rows(view: LineWindows, rows: Ints) -> tuple[int, int]:
    """Rows from one that was seen to the next, 1 or 2, and the first that was.

    Behind a Bayer filter red and blue are seen in every second row; bilinear demosaicing makes
    the rows between the mean of both beside them.  There second differences are nothing but
    rounding, and elsewhere those of the line.  rows: of the middle pixels.  Clipped ones, which
    may have been filled in before, tell nothing.
    """
    grey = view.grey.astype(float)
    square = np.square(grey[:, 2:] - 2 * grey[:, 1:-1] + grey[:, :-2])
    parity = (rows[:, None] + view.steps.astype(int)[1:-1]) % 2
    whole = view.used & ~view.clipped
    near = whole[:, 2:] & whole[:, 1:-1] & whole[:, :-2]
    each = (near & (parity == one) for one in (0, 1))
    bent = [square[rows].sum() / max(np.count_nonzero(rows), 1) for rows in each]
    filled_in = min(bent) <= _ROUNDED_DN2 and max(bent) >= _UNLIKE_ROWS * _ROUNDED_DN2
    return (2, int(np.argmax(bent))) if filled_in else (1, 0)


def _start(view: LineWindows, width_px: Floats) -> Floats:
    """First guess (K, 5) of the parameters: a line at the middle pixel, on the least ground."""
    middle = view.grey.shape[1] // 2
    ground = np.where(view.used, view.grey, np.inf).min(axis=1)
    height = np.maximum(view.grey[:, middle - 1 : middle + 2].max(axis=1) - ground, 1e-3)
    level = np.zeros(len(ground))
    return parameters_of(level, width_px, height, ground, level)


def weak_precision(start: Floats) -> Floats:
    """1/variance (K, 5) of the little that is known of any line.

    It decides only what the pixels leave open, as where all are clipped: the centre within
    ten widths, the width and the height within a factor of 20, the ground within the height
    and its slope within a tenth of the height a width.

    Parameters
    ----------
    start : (K, 5) array, px and DN, where the line begins (fit.py)
    """
    width, height = np.exp(start[:, LN_WIDTH]), np.exp(start[:, LN_HEIGHT])
    factor = np.full(len(start), np.log(20.0))
    spread = np.column_stack([10 * width, factor, factor, height, height / (10 * width)])
    return spread**-2


def _between(fit: LineFit, which: int, sample: Ints, count: int) -> Guess:
    """A parameter at all columns from its running median over the sample.

    Its spread is what single columns scatter beyond their own uncertainty, and at least that
    of the median of so few.
    """
    value = fit.parameters[:, which]
    smooth = running_median(value, _NEIGHBOURS)
    scatter = (1.4826 * np.median(np.abs(value - smooth))) ** 2
    own = np.median(fit.covariance[:, which, which])
    spread = np.sqrt(max(scatter - own, 0.2 * own))
    return Guess(np.interp(np.arange(count), sample, smooth), float(spread))


# The extractor that makes the most of the pixels: maximum likelihood of a Gaussian line.


_MISFIT_NEIGHBOURS = 31
_FOREIGN = 3.0
"""Misfit of a column beyond which something other than noise is in it: chi-square over its
degrees of freedom, a dozen at least, passes 3 by chance once in a thousand times."""
_CREST = 1.5  # widths from its brightest pixel, where a line has a third of its height
_SURE = 1e6  # precision in px²/DN² of a slope that so few pixels do not tell


def _search(seen: Survey) -> LineSearch:
    """What the lines of a picture are fitted to, their width and ground held to the neighbours'."""
    precision = weak_precision(seen.start)
    precision[:, LN_WIDTH] = 1 / seen.ln_width.spread**2
    precision[:, TILT] = 1 / seen.tilt.spread**2
    return LineSearch(seen.view, seen.start, seen.noise, LinePrior(seen.start, precision))


@on_integers
def maximum_likelihood(image: GreyValues, settings: StripeSection, clipped: Mask) -> Stripe:
    """The line by maximum likelihood in each column of a picture.

    A Gaussian averaged over each pixel on a sloping ground (fit.py) under reading noise,
    shot noise and speckle; a clipped pixel says "at least this".  Width and slope are free, but
    held to the median of the neighbouring columns as far as those agree with one another: where a
    column alone does not determine them, they do.

    sigma_px follows from Fisher's information, and from what the line differs from a Gaussian
    alike in neighbouring columns (fit.py), carried through the fit.  Where the pixels
    scatter about the line more than the noise explains it grows by the root of that ratio
    (Birge 1932): the neighbours' median of it, and the column's own where beyond chance.
    Where that is a column's own and the noise is stated, as beside light that ends at the line, it
    also grows by as far as the line's crest alone lies from the whole line.
    SATURATED columns have been allowed for.  Too few of their pixels are left to estimate the
    noise by: unless that is stated, ``extract_stripe`` widens their sigma_px to what their centres
    scatter (scatter.py).  NO_PEAK also where no line can be fitted.

    Rows that a colour camera has filled in by their neighbours' mean, as bilinear demosaicing
    does, are left out.  AMBIGUOUS where the line is narrower at half its height than the rows that
    are left lie apart: where between two of them it runs is not to be seen then.

    Parameters
    ----------
    image : (H, W) array, DN, grey values
    settings : StripeSection, threshold, span and noise
    clipped : (H, W) mask, of the pixels at the end of the camera's range

    References
    ----------
    The bound that it approaches: docs/explanation/physics.md, section 4.
    """
    seen = survey(image, settings, clipped)
    if isinstance(seen, Stripe):
        return seen
    search = _search(seen)
    fit = fit_lines(search)
    stripe = _stripe(seen, fit, _crests(seen, search, _foreign(search, fit, settings)))
    saturated = clipped_near(stripe, clipped.T, settings.span_px)
    status = stripe.status.copy()
    status[saturated] = Status.SATURATED
    return replace(stripe, status=status)


def _crests(seen: Survey, search: LineSearch, at: Ints) -> Floats:
    """(K,) centre in px from the peak by each line's crest alone, NaN where the whole line will do.

    at: numbers of the lines with something beside them, as light of a surface that begins there,
    or the line of another surface where the target has a step.
    """
    crests = np.full(len(search.start), np.nan)
    if len(at):
        fit = fit_lines(_crest(seen, search, at))
        crests[at] = np.where(fit.settled, fit.parameters[:, CENTRE], np.nan)
    return crests


def _foreign(search: LineSearch, fit: LineFit, settings: StripeSection) -> Ints:
    """Numbers of the fitted lines with something beside them that their neighbours do not have.

    None of them is clipped.  There are none where the noise is not known: it is then taken from
    pixels beside lines as well, and on a lit target texture would count for more than lines.
    """
    if settings.noise is None:
        return np.zeros(0, dtype=np.int64)
    clipped = (search.view.clipped & search.view.used).any(axis=1)
    unlike = fit.misfit > _FOREIGN * np.maximum(_common(fit), 1.0)
    return np.flatnonzero(fit.settled & unlike & ~clipped)


def _common(fit: LineFit) -> Floats:
    """(K,) misfit that a column has in common with its neighbours."""
    return running_median(fit.misfit, _MISFIT_NEIGHBOURS)


def _crest(seen: Survey, search: LineSearch, at: Ints) -> LineSearch:
    """The search for some lines in the pixels about the brightest one, on a slope that is known."""
    part = search.of(at)
    view, aside = part.view, np.abs(part.view.steps)
    within = view.used & (aside <= seen.reach_px[at][:, None])
    middle = view.steps[np.where(within, view.grey, -np.inf).argmax(axis=1)][:, None]
    reach = np.ceil(_CREST * seen.width_px[at])[:, None]
    start, precision = part.start.copy(), part.prior.precision.copy()
    start[:, [CENTRE]] = middle
    precision[:, TILT] = _SURE
    view = replace(view, used=view.used & (np.abs(view.steps - middle) <= reach))
    return LineSearch(view, start, part.noise, LinePrior(start, precision))


def _stripe(seen: Survey, fit: LineFit, crest: Floats) -> Stripe:
    """The survey's stripe with the centres of the fit, which may lie as far off as crests do."""
    offset = fit.parameters[:, CENTRE]
    own = np.where(fit.misfit > _FOREIGN, fit.misfit, 1.0)
    excess = np.maximum(np.maximum(_common(fit), own), 1.0)
    misfit = (fit.gain**2 * (seen.misfit * fit.light) ** 2).sum(axis=1)
    doubt = np.where(np.isnan(crest), 0.0, crest - offset) ** 2 / 3  # a uniform distribution's
    sigma = np.sqrt(fit.covariance[:, CENTRE, CENTRE] * excess + misfit + doubt)
    kept = fit.settled & seen.is_near(offset, sigma)
    stripe = stripe_at(seen.stripe, seen.peaks, offset, sigma, kept)
    between = np.zeros(len(stripe.status), dtype=bool)
    between[seen.peaks.columns] = FWHM * seen.width_px < seen.pitch_px
    return withhold(stripe, between) if seen.pitch_px > 1 else stripe
