"""The scatter of a line's centres as the line itself shows it, from column to column.

A model of the noise (model.py) gives every pixel an error of its own.  In the pictures of most
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

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import compress
from math import sqrt
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from lscan.records import Floats, GreyValues, Ints, Mask, Status, Stripe, has_value
from lscan.stripe.fit import CENTRE, TILT, LineFit, lines, parameters_of
from lscan.stripe.noise import Noise, robust_variance, scatter_noise
from lscan.stripe.peaks import line_width, pieces, windows

_Number = TypeVar("_Number", bound=np.number)

_REPEATED = 1 + 2 * (15**2 + 6**2 + 1**2) / 20**2
"""By how much the variance of a mean square of third differences exceeds that of as many
independent values: the sum of their squared autocorrelations, 1, -15/20, 6/20 and -1/20."""

_LAGS = (1, 2, 4, 8, 16)  # columns; a block of JPEG has 8, of its subsampled colours 16
_SETTLED = 1.25  # ratio of the variances at a lag and the one before that is no growth
_BEYOND_CHANCE = 4.0  # standard deviations
_FEWEST_DIFFERENCES = 32  # third differences
_WIDTHS = 3.0  # of the line: extractors that smooth along it do so over its width
_SPANS = 8  # stretches as long as the lag, of columns that share errors: sigma to a third
_FINEST_PX = 1.5  # a narrower window lets the raster of the pixels through
_STEPS = 4  # from a pixel beside the line, to a hundredth of a pixel


SeenLine = tuple[Stripe, GreyValues, Ints]
"""A stripe, px, of N entries; the light (N, L) in DN, row i being the column (or row) of the
picture that entry i of the stripe was found in; and (N,), px, where each of those is the highest.
"""


def at_least_seen(seen: Sequence[SeenLine]) -> list[Stripe]:
    """The stripes with sigma_px enlarged to what their centres scatter about their neighbours.

    One factor for the columns that are OK and one for those SATURATED, never below 1.

    Parameters
    ----------
    seen : sequence of SeenLine, of one picture each
    """
    enough = [
        np.count_nonzero(has_value(stripe.status)) >= _FEWEST_DIFFERENCES for stripe, *_ in seen
    ]
    lags = iter(shared_columns(list(compress(seen, enough))))
    each = zip(seen, enough, strict=True)
    return [_enlarged(one[0], next(lags)) if many else one[0] for one, many in each]


def _enlarged(stripe: Stripe, lag: int) -> Stripe:
    """The same of a stripe whose columns share errors along ``lag`` columns."""
    run, sigma_px = pieces(stripe), stripe.sigma_px.copy()
    for status in (Status.OK, Status.SATURATED):
        kept = stripe.status == status
        if np.count_nonzero(kept) > _FEWEST_DIFFERENCES:
            sigma_px[kept] *= excess(stripe, np.where(kept, run, -1), lag)
    return replace(stripe, sigma_px=sigma_px)


def excess(stripe: Stripe, run: Ints, lag: int) -> float:
    """Scatter of the centres over the one that sigma_px states, at least 1.

    The largest that is seen at the lag or a shorter one: of errors that columns share, short
    lags see less.  At a lag of 1 the noise may be as stated, and an excess within chance, four
    standard deviations of it, counts as none.

    Parameters
    ----------
    stripe : Stripe, px, of N entries
    run : (N,) array, number of the piece each entry belongs to (pieces.py), -1 for none
    lag : int, columns, from which on the centres' errors are independent; lags are left out at
        which the pieces hold fewer than 32 third differences, or less than eight stretches
    """
    chance, ratio = _BEYOND_CHANCE if lag == 1 else 0.0, 0.0
    while lag >= 1:
        at = _in_one_piece(run, lag)
        count = np.count_nonzero(at)
        if count >= max(_FEWEST_DIFFERENCES, _SPANS * lag):
            first, second, third, last = _apart(stripe.sigma_px**2, lag)
            stated = np.sqrt(first + last + 9 * (second + third))[at]
            seen = _third_differences(stripe.centre_px, lag)[at]
            ratio = max(ratio, robust_variance(seen / stated))
            chance *= np.sqrt(2 * _REPEATED / count)
        lag = 3 * lag // 4
    return float(np.sqrt(ratio)) if ratio > 1 + chance else 1.0


def shared_columns(seen: Sequence[SeenLine]) -> list[int]:
    """Columns along which the pixels of each picture share their errors, 1 where each has its own.

    The lag, of 1, 2, 4, 8 and 16, beyond which the third differences of the line's width grow
    no more.  Where that is beyond 1 it is at least three widths of the line, over which some
    extractors smooth along it; it is 1 too where none grows by more than chance, four standard
    deviations of it.

    Parameters
    ----------
    seen : sequence of SeenLine, of one picture each, in which some columns have a value
    """
    scales = [line_width(light, at := _valued(one), crest[at]) for one, light, crest in seen]
    widths = _variances(seen, [max(scale, _FINEST_PX) for scale in scales]) if seen else []
    each = zip(seen, widths, scales, strict=True)
    return [_lag(stripe, width, scale) for (stripe, *_), width, scale in each]


def _valued(stripe: Stripe) -> Ints:
    return np.flatnonzero(has_value(stripe.status))


def _lag(stripe: Stripe, width: Floats, scale: float) -> int:
    """The same of one picture, from the line's variance (N,) in each of its columns."""
    run = np.where(np.isfinite(width), pieces(stripe), -1)
    growths: list[float] = []
    by_chance, last = True, np.inf
    for lag in _LAGS:
        values = _third_differences(width, lag)[_in_one_piece(run, lag)]
        if len(values) < _FEWEST_DIFFERENCES:
            continue
        scatter = robust_variance(values)
        growths.append(scatter / max(last, np.finfo(float).tiny))
        if len(growths) == 2 and growths[1] <= _SETTLED:
            return 1
        # Two variances are compared, each of as many values as the second has, or more.
        by_chance &= growths[-1] <= 1 + _BEYOND_CHANCE * np.sqrt(4 * _REPEATED / len(values))
        last = scatter
    if by_chance:
        return 1
    settled = int(np.append(np.array(growths[1:]) <= _SETTLED, True).argmax())
    return max(_LAGS[settled], int(np.ceil(_WIDTHS * scale)))


def _variances(seen: Sequence[SeenLine], scales: Sequence[float]) -> list[Floats]:
    """(N,) the light's variance across the line over scale², NaN where there is no line; of each.

    By moments weighted with a Gaussian of the width ``scale``, in px, about as wide as the line.
    Through it half of a line's displacement is seen, so each step to the line's middle goes twice
    as far as the first moment says; and of the variance w² only s² w² / (s² + w²), which is
    turned back.  Along a column a line of slope t is wider than across itself by (1 + t²)^(1/2).

    A weight about the middle m is that about 0 times exp(m k / s²) at the pixel k, but for a factor
    that all have in common, and so for none: of the weights about 0 powers of a number are left.
    """
    valued = [_valued(stripe) for stripe, *_ in seen]
    ends = np.cumsum([len(at) for at in valued])
    centre = np.concatenate([one.centre_px[at] for (one, *_), at in zip(seen, valued, strict=True)])
    row = np.rint(centre).astype(int)
    reach = [int(np.ceil(3 * scale)) + 2 for scale in scales]
    weighted = np.zeros((2 * max(reach) + 1, len(row)))  # (n, K): n is short
    for (_, light, _), at, end, far, scale in zip(seen, valued, ends, reach, scales, strict=True):
        part, beside = slice(end - len(at), end), max(reach) - far
        grey = windows(light, at, row[part], far).T
        weight = np.exp(-0.5 * (np.arange(-far, far + 1) / scale) ** 2)[:, None]
        ground = grey[[0, 1, -2, -1]].mean(axis=0)
        weighted[beside : len(weighted) - beside, part] = weight * (grey - ground)
    spread = np.repeat(scales, [len(at) for at in valued])
    middle = centre - row
    for _ in range(_STEPS):
        about = middle
        zeroth, first, second = _moments(weighted, np.exp(about / spread**2))
        total = np.where(zeroth > 0, zeroth, np.nan)
        moved = (first / total - about) / spread
        middle = about + spread * np.clip(2 * moved, -1.0, 1.0)
    variance = ((second - 2 * about * first) / total + about**2) / spread**2
    across, places = variance / np.where(variance < 1, 1 - variance, np.nan), row + middle
    found = []
    for (stripe, *_), at, end in zip(seen, valued, ends, strict=True):
        squared, line = np.full((2, len(stripe.status)), np.nan)
        squared[at], line[at] = across[end - len(at) : end], places[end - len(at) : end]
        found.append(squared / (1 + np.gradient(line) ** 2))
    return found


def _moments(weighted: Floats, factor: Floats) -> Floats:
    """(3, K) zeroth to second moments of ``weighted`` (n, K) times ``factor`` (K,) ** step.

    All by one factor more, that of the pixels before the middle one.  Horner's scheme.
    """
    total, reach = np.zeros((3, len(factor))), len(weighted) // 2
    for step in range(reach, -reach - 1, -1):
        total *= factor
        light = weighted[step + reach]
        for moment in total:
            moment += light
            light = light * step
    return total


def _apart(values: NDArray[_Number], lag: int) -> list[NDArray[_Number]]:
    """Four times (Q,) values of (N,), each ``lag`` entries after the one before."""
    count = max(len(values) - 3 * lag, 0)
    return [values[k * lag : k * lag + count] for k in range(4)]


def _in_one_piece(run: Ints, lag: int) -> Mask:
    """(Q,) whether four entries ``lag`` apart are all of the same piece; -1 is none."""
    first, second, third, last = _apart(run, lag)
    return (first >= 0) & (first == second) & (first == third) & (first == last)


def _third_differences(values: Floats, lag: int) -> Floats:
    """(Q,) of values (N,), ``lag`` entries apart."""
    first, second, third, last = _apart(values, lag)
    return first - last + 3 * (third - second)


# Noise and misfit: how the pixels of neighbouring columns scatter about their lines.
#
# No laser line is quite a Gaussian.  What it differs by is much the same in the next column, and
# noise is not.  So half the squared difference of two neighbours' residuals is the variance of
# the noise, and their product is the square of the misfit.  Of the misfit only the odd part, of
# opposite signs on either side of the peak, moves the centre.


_FEWEST_PAIRS = 8  # pairs of columns, some hundred pixels
_SIDEWAYS_PX = 3  # farther apart along the column, two peaks are of two lines
_FAINT = 0.005  # of the line's height: what Gaussians have beyond 3.3 standard deviations
# Relative variance of robust_variance, times the values: 1.83 within 3 sigma, divided by
# (1 - 0.11)^2, for the cut follows what is found.  A column may be in two pairs, whose squares
# correlate by 1/4; those of second differences do by 4/9 and 1/36.
_OF_PAIRS, _OF_SECOND_DIFFERENCES = 2.32 * (1 + 2 / 4), 2.32 * (1 + 8 / 9 + 2 / 36)
_CORE = 5.0  # standard deviations within which pixels are used


@dataclass(frozen=True)
class Scatter:
    """Pixels of lines, P of each kind.

    Attributes
    ----------
    light : (P,) array, DN, that the line has there
    different : (P,) array, DN², on average the variance of the noise
    common : (P,) array, DN², on average twice the square of the misfit's odd part: of errors
        independent from pixel to pixel it would take as much to move the centre as far
    faint : (P,) mask, of the pixels nearly without light
    """

    light: Floats
    different: Floats
    common: Floats
    faint: Mask

    def noise(self, constant: float, pixels: int) -> Noise:
        """The noise, where that of the pixels far from the line is known.

        Beside the line it may be more, by more than chance: compressed pictures are noisy only
        where something is.

        Parameters
        ----------
        constant : float, DN², variance of the pixels far from the line
        pixels : int, second differences that it is known from
        """
        faint = np.sqrt(self.different[self.faint])
        beside = robust_variance(faint)
        chance = 1 + _BEYOND_CHANCE * chance_of_variances(len(faint), pixels)
        beside = beside if beside > constant * chance else constant
        return scatter_noise(self.different, self.light, beside)

    def misfit(self, noise: Noise) -> float:
        """Deviation of the lines from Gaussians, as a share of their light.

        Least squares of ``common`` on light², weighted by the inverse of its variance.

        Parameters
        ----------
        noise : Noise, of the pixels
        """
        variance = noise.variance(self.light)
        core = np.abs(self.common) <= _CORE**2 * variance
        weight = core * self.light**2 / np.maximum(variance, 1e-3 * self.light**2) ** 2
        total = float((weight * self.light**2).sum())
        square = float((weight * self.common).sum()) / total if total > 0 else 0.0
        return min(max(square, 0.0) ** 0.5, 1.0)


def chance_of_variances(pairs: int, pixels: int) -> float:
    """Relative standard deviation of a variance of pairs of columns over one of pixels afar.

    Parameters
    ----------
    pairs : int, pixels of the pairs
    pixels : int, second differences down columns
    """
    return sqrt(_OF_PAIRS / max(pairs, 1) + _OF_SECOND_DIFFERENCES / max(pixels, 1))


def scatter_of(fit: LineFit, columns: Ints, rows: Ints) -> Scatter:
    """The pixels of those fitted lines that have a neighbour, each with its neighbour's.

    With next to no neighbours all scatter counts as noise.

    Parameters
    ----------
    fit : LineFit, px and DN, of K columns
    columns, rows : (K,) array, place of the lines' middle pixels in the picture, columns rising
    """
    first = np.flatnonzero((np.diff(columns) == 1) & (np.abs(np.diff(rows)) <= _SIDEWAYS_PX))
    if len(first) < _FEWEST_PAIRS:
        first = second = np.arange(len(columns))
    else:
        second = first + 1
    # The windows lie even about the peaks: turned round, a pixel meets its mirror image.
    seen = fit.seen[first] & fit.seen[second]
    seen &= seen[:, ::-1]
    light = ((fit.light[first] + fit.light[second]) / 2)[seen]
    height = np.broadcast_to(fit.light[first].max(axis=1, keepdims=True), seen.shape)[seen]
    one, other = fit.residual[first], fit.residual[second]
    if first is second:
        return Scatter(light, one[seen] ** 2, np.zeros_like(light), light < _FAINT * height)
    odd = (one - one[:, ::-1]) * (other - other[:, ::-1]) / 4
    different = (one - other)[seen] ** 2 / 2
    return Scatter(light, different, 2 * odd[seen], light < _FAINT * height)


# The Cramér-Rao bound: no unbiased extractor scatters less than this.


def centre_bound_px(
    width_px: Floats | float,
    height_dn: Floats | float,
    noise: Noise,
    phase_px: Floats | float = 0.0,
    reach_px: int | None = None,
) -> Floats:
    """Least standard deviation (K,) in px of an unbiased estimate of a line's centre.

    Centre, width, height and an even ground are unknown; the noise is known, independent from
    pixel to pixel and normal: reading, shot and speckle.  For additive noise and a line much wider
    than a pixel the bound is (sigma_n / A) sqrt(2 w / sqrt(pi)).

    Parameters
    ----------
    width_px : (K,) array or float, px, standard deviation of the Gaussian
    height_dn : (K,) array or float, DN, its height
    noise : Noise, of the pixels
    phase_px : (K,) array or float, px, place of the centre in the middle pixel
    reach_px : int, optional, px, pixels seen to either side; 8 widths by default

    References
    ----------
    The inverse of Fisher's information J^T V^-1 J: Kay, Fundamentals of Statistical Signal
    Processing I, sec. 3.9, without the little that the variance itself says of the line;
    docs/explanation/physics.md, section 4.
    """
    width, height, phase = np.broadcast_arrays(
        *(np.atleast_1d(np.asarray(value, float)) for value in (width_px, height_dn, phase_px))
    )
    reach = int(np.ceil(8 * width.max())) + 1 if reach_px is None else reach_px
    steps = np.arange(-reach, reach + 1, dtype=float)
    level = np.zeros(len(width))
    seen = lines(parameters_of(phase, width, height, level, level), steps)
    jacobian = np.delete(seen.jacobian, TILT, axis=1)
    weight = 1 / noise.variance(seen.light)
    information = (jacobian * weight[:, None]) @ jacobian.transpose(0, 2, 1)
    return np.sqrt(np.linalg.inv(information)[:, CENTRE, CENTRE])
