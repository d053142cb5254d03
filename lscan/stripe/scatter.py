"""How far a line's centres scatter, as the line itself shows it from column to column.

A model of the noise (picture.py) gives every pixel an error of its own.  In the pictures of most
cameras that does not hold: colours are filled in from neighbours, edges sharpened, blocks of
pixels compressed together, and the target's texture shifts the light of many columns alike.
Errors that pixels share average out less, and a noise estimated from how neighbouring pixels
differ is too small.

What the centres do is seen without a model.  Third differences along the line,
c[i] - 3 c[i+h] + 3 c[i+2h] - c[i+3h], vanish on any parabola, and hold 20 times the variance of
errors that are independent h columns apart.  So h must reach as far as columns share errors;
the shorter it is, the less of the target's relief is taken for scatter.  How far that is, the
line's *width* tells: it has the errors of the same pixels, and hardly any of the relief.
Where its third differences are the same at every h, each column has errors of its own, h is 1,
and of relief nothing is left but what is rough from one column to the next.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from lscan.config.rig import NoiseSection, StripeSection
from lscan.records import Floats, GreyValues, Ints, Status, Stripe, has_value
from lscan.stripe import peaks
from lscan.stripe.corrections import smoothing_doubt
from lscan.stripe.loops.scatter import end_doubts, third_differences, weighted_moments
from lscan.stripe.picture import robust_variance, stated_noise

_REPEATED = 1 + 2 * (15**2 + 6**2 + 1**2) / 20**2
"""By how much the variance of a mean square of third differences exceeds that of as many
independent values: the sum of their squared autocorrelations, 1, -15/20, 6/20 and -1/20."""

_LAGS = (1, 2, 4, 8, 16)  # columns; a block of JPEG has 8, of its subsampled colours 16
_SETTLED = 1.25  # ratio of the greatest variance to one that is about as large
_BEYOND_CHANCE = 4.0  # standard deviations
_FEWEST_DIFFERENCES = 32  # third differences
_WIDTHS = 3.0  # of the line: extractors that smooth along it do so over its width
_SPANS = 8  # stretches as long as the lag, of columns that share errors: sigma to a third
_FINEST_PX = 1.5  # a narrower window lets the raster of the pixels through
_FINEST_SMOOTHED_PX = 1.0  # nothing finer smooths the pixels' raster away
_SHARED = 2 * np.sqrt(np.pi)  # widths of a Gaussian that smooths: the sum of its autocorrelation
_INSIDE = (4, 12)  # columns from an end, beyond which it is not blurred


SeenLine = tuple[Stripe, GreyValues, Ints]
"""A stripe, px, of N entries; the light (N, L) in DN, row i being the column (or row) of the
picture that entry i of the stripe was found in; and (N,), px, where each of those is the highest.
"""


class SeenScatter(NamedTuple):
    """A stripe whose sigma_px is what each column errs by itself, and what columns share.

    Attributes
    ----------
    stripe : Stripe, px, of N entries
    doubt_px : (N,) array, px, standard uncertainty of what moves neighbours alike
    shared_columns : int, columns over which the errors in sigma_px are shared; 1: none are
    """

    stripe: Stripe
    doubt_px: Floats
    shared_columns: int


def at_least_seen(seen: SeenLine, settings: StripeSection, smooths: bool = False) -> SeenScatter:
    """The stripe with sigma_px enlarged to what their centres scatter about their neighbours.

    One factor for the columns that are OK and one for those SATURATED, never below 1.

    Where the settings state the noise there is one factor for all: by how much the light's own
    first moment, weighted with a Gaussian of the line's width, scatters more than that noise makes
    it.  That judges the noise which is stated, and not what an extractor makes of it; it is no more
    than what the centres scatter beyond sigma_px.

    Columns share what a blur that is not stated may do near the ends of a sloping line, and what
    the extractor's own smoothing along the line, as wide as the line, does to bends.

    Parameters
    ----------
    seen : SeenLine, of a picture
    settings : StripeSection, the line's width and the noise, as stated for the picture
    smooths : bool, whether the extractor smooths along the line: the centres' own scatter tells
        little then, and bends are displaced (corrections.py)
    """
    stripe, lines, _ = seen
    doubt = np.zeros(len(stripe.status))
    if np.count_nonzero(has_value(stripe.status)) < _FEWEST_DIFFERENCES:
        return SeenScatter(stripe, doubt, 1)
    light = light_moments(seen, settings.line_width_px)
    shared = light.shared_columns(stripe)
    if settings.noise is None:
        widened = _widen_sigma(stripe, light, shared)
    else:
        widened = _widen_beyond_stated(seen, light, settings.noise, smooths)
    if settings.blur_px is None:
        doubt = _end_doubt(stripe, light)
    if smooths:
        smoothed_px = max(light.line_px, _FINEST_SMOOTHED_PX)
        doubt = np.hypot(doubt, smoothing_doubt(widened, lines, smoothed_px**2))
        shared = max(shared, int(np.ceil(_SHARED * smoothed_px)))
    return SeenScatter(widened, doubt, shared)


def _end_doubt(stripe: Stripe, light: "LightMoments") -> Floats:
    """(N,) px, standard uncertainty of centres near an end for what blur may have moved them.

    By s² v' F'/F (corrections.py), of a blur s that is not known: it lies between none and the
    line's own width, and the shift anywhere between 0 and that (a rectangular distribution about
    0, GUM 4.3.7).  The fall of the light F is that from the next column towards the inside, or
    between both neighbours where that is more; the slope v' is the one farther inside, for at the
    end all light is that of the last column.
    """
    variance = light.scale_px**2 * light.squared
    found = (light.pieces(stripe), stripe.centre_px, variance, np.log(light.flux))
    return np.nan_to_num(end_doubts(*found, *_INSIDE))


def _widen_sigma(stripe: Stripe, light: "LightMoments", lag: int) -> Stripe:
    """The stripe with sigma_px enlarged to its own scatter."""
    run, sigma_px = light.pieces(stripe), stripe.sigma_px.copy()
    for status in (Status.OK, Status.SATURATED):
        kept = stripe.status == status
        if np.count_nonzero(kept) > _FEWEST_DIFFERENCES:
            sigma_px[kept] *= excess(stripe, np.where(kept, run, -1), lag)
    return replace(stripe, sigma_px=sigma_px)


def _widen_beyond_stated(
    seen: SeenLine, light: "LightMoments", noise: NoiseSection, smooths: bool
) -> Stripe:
    """The stripe with sigma_px enlarged where the light scatters more than its stated noise."""
    stripe = seen[0]
    run, lag = light.pieces(stripe), light.shared_columns(stripe)
    middles = _weighted_middles(seen, light, noise)
    factor = excess(middles, np.where(middles.status == Status.OK, run, -1), lag)
    if factor > 1 and not smooths:
        factor = min(factor, excess(stripe, run, lag))
    return replace(stripe, sigma_px=factor * stripe.sigma_px)


def _weighted_middles(seen: SeenLine, light: "LightMoments", noise: NoiseSection) -> Stripe:
    """The stripe whose centres are the light's middles; sigma by the noise stated.

    The middle m solves sum of w (x - m) I = 0 with weights w(x - m), so that a pixel moves it by
    w (x - m) over the sum of w I (1 - (x - m)² / s²).
    """
    stripe, lines, _ = seen
    scale, near = light.scale_px, light.scale_px + 1
    apart = light.middle - stripe.centre_px
    at = np.flatnonzero((stripe.status == Status.OK) & (np.abs(apart) < near))
    row = np.rint(light.middle[at]).astype(int)
    reach = int(np.ceil(3 * scale)) + 2
    grey = peaks.windows(lines, at, row, reach)
    line = grey - grey[:, [0, 1, -2, -1]].mean(axis=1, keepdims=True)
    off = np.arange(-reach, reach + 1) - (light.middle[at] - row)[:, None]
    weight = np.exp(-0.5 * (off / scale) ** 2)
    by_pixel = weight * off
    by_pixel /= (weight * line * (1 - (off / scale) ** 2)).sum(axis=1)[:, None]
    variance = stated_noise(noise, 0.0).variance(np.maximum(grey, 0.0))
    # Speckle is the laser's: the ground has none.
    variance += noise.speckle**2 * (np.maximum(line, 0.0) ** 2 - np.maximum(grey, 0.0) ** 2)
    sigma = np.sqrt((by_pixel**2 * variance).sum(axis=1))
    status = np.full(len(stripe.status), int(Status.NO_PEAK))
    sigma_px = np.full(len(status), np.nan)
    status[at[np.isfinite(sigma) & (sigma > 0)]], sigma_px[at] = Status.OK, sigma
    return replace(stripe, centre_px=light.middle, sigma_px=sigma_px, status=status)


def excess(stripe: Stripe, run: Ints, lag: int) -> float:
    """Scatter of the centres over the one that sigma_px states, at least 1.

    The largest that is seen at the lag or a shorter one: of errors that columns share, short
    lags see less.  At a lag of 1 the noise may be as stated, and an excess within chance, four
    standard deviations of it, counts as none.

    Parameters
    ----------
    stripe : Stripe, px, of N entries
    run : (N,) array, number of the piece each entry belongs to (peaks.py), -1 for none
    lag : int, columns, from which on the centres' errors are independent; lags are left out at
        which the pieces hold fewer than 32 third differences, or less than eight stretches
    """
    chance, ratio = _BEYOND_CHANCE if lag == 1 else 0.0, 0.0
    while lag >= 1:
        at, seen = third_differences(stripe.centre_px, run, lag)
        if len(at) >= max(_FEWEST_DIFFERENCES, _SPANS * lag):
            first, second, third, last = (stripe.sigma_px[at + k * lag] ** 2 for k in range(4))
            stated = np.sqrt(first + last + 9 * (second + third))
            ratio = max(ratio, robust_variance(seen / stated))
            chance *= np.sqrt(2 * _REPEATED / len(at))
        lag = 3 * lag // 4
    return float(np.sqrt(ratio)) if ratio > 1 + chance else 1.0


class LightMoments(NamedTuple):
    """The light across a line of N columns, weighted with a Gaussian about as wide as the line.

    Attributes
    ----------
    line_px : float, px, the line's standard deviation across
    middle : (N,) array, px, first moment of the light; NaN where there is no line
    squared : (N,) array, the light's variance over that of the Gaussian, likewise
    flux : (N,) array, DN, the light
    """

    line_px: float
    middle: Floats
    squared: Floats
    flux: Floats

    @property
    def scale_px(self) -> float:
        """Standard deviation of the Gaussian, px."""
        return max(self.line_px, _FINEST_PX)

    def pieces(self, stripe: Stripe) -> Ints:
        """(N,) number of the piece each column belongs to (peaks.py), -1 for none.

        By where the light's middle jumps: the scatter of a wide line's centres may be as large.

        Parameters
        ----------
        stripe : Stripe, px, whose columns count where they have a value
        """
        return peaks.pieces(replace(stripe, centre_px=self.middle))

    def shared_columns(self, stripe: Stripe) -> int:
        """Columns along which the pixels share their errors, 1 where each has its own.

        The least lag, of 1, 2, 4, 8 and 16, at which the third differences of the line's width are
        about as large as at any.  Where that is beyond 1 it is at least three widths of the line,
        over which some extractors smooth along it; it is 1 too where none exceeds that at 1 by more
        than chance, four standard deviations of it, and where too few neighbours have a width.

        Parameters
        ----------
        stripe : Stripe, px, as of :meth:`pieces`
        """
        run = np.where(np.isfinite(self.squared), self.pieces(stripe), -1)
        found: dict[int, float] = {}
        for lag in _LAGS:
            values = third_differences(self.squared, run, lag)[1]
            # None at 1, where the widths of neighbours are hardly ever both known: none to compare.
            if len(values) >= _FEWEST_DIFFERENCES and (lag == 1 or 1 in found):
                scatter = robust_variance(values)
                # Two variances are compared, each of as many values as the second has, or more.
                chance = _BEYOND_CHANCE * np.sqrt(4 * _REPEATED / len(values))
                if lag == 1 or scatter > (1 + chance) * found[1]:
                    found[lag] = scatter
        most = max(found.values(), default=0.0)
        lag = next((lag for lag, scatter in found.items() if _SETTLED * scatter >= most), 1)
        return 1 if lag == 1 else max(lag, int(np.ceil(_WIDTHS * self.line_px)))


def light_moments(seen: SeenLine, width_px: float | None = None) -> LightMoments:
    """The light's moments across the line in a picture.

    Through a Gaussian as wide as the line half of its displacement is seen, so each step to its
    middle goes twice as far as the first moment says; and of its variance w² only
    s² w² / (s² + w²), which is turned back.  Along a column a line of slope t is wider than across
    itself by (1 + t²)^(1/2).

    Parameters
    ----------
    seen : SeenLine, of a picture in which some columns have a value
    width_px : float, optional, px, full width of the line at half its height; found if left out
    """
    stripe, light, crest = seen
    at = np.flatnonzero(has_value(stripe.status))
    width = peaks.line_width(light, at, crest[at], width_px)
    scale = max(width, _FINEST_PX)
    line, squared, flux = values = np.full((3, len(stripe.status)), np.nan)
    values[:, at] = weighted_moments(light, at, stripe.centre_px[at], scale)
    squared /= np.where(squared < 1, 1 - squared, np.nan) * (1 + _slope(line, width) ** 2)
    return LightMoments(width, line, squared, flux)


def _slope(line: Floats, width_px: float) -> Floats:
    """(N,) px a column, over half of the line's width to either side: scatter is no slope."""
    reach, at = max(round(width_px / 2), 1), np.arange(len(line))
    before, after = np.maximum(at - reach, 0), np.minimum(at + reach, len(line) - 1)
    slope: Floats = (line[after] - line[before]) / (after - before)
    return slope
