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
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from lscan.records import Floats, GreyValues, Ints, Mask, Status, Stripe, has_value
from lscan.stripe.noise.model import robust_variance
from lscan.stripe.peaks import windows
from lscan.stripe.pieces import pieces
from lscan.stripe.width import line_width

_Number = TypeVar("_Number", bound=np.number)

_REPEATED = 1 + 2 * (15**2 + 6**2 + 1**2) / 20**2
"""By how much the variance of a mean square of third differences exceeds that of as many
independent values: the sum of their squared autocorrelations, 1, -15/20, 6/20 and -1/20."""

_LAGS = (1, 2, 4, 8, 16)  # columns; a block of JPEG has 8, of its subsampled colours 16
_SETTLED = 1.25  # ratio of the variances at a lag and the one before that is no growth
_BEYOND_CHANCE = 4.0  # standard deviations
_FEWEST = 32  # third differences
_WIDTHS = 3.0  # of the line: extractors that smooth along it do so over its width
_SPANS = 8  # stretches as long as the lag, of columns that share errors: sigma to a third
_FINEST_PX = 1.5  # a narrower window lets the raster of the pixels through
_STEPS = 4  # from a pixel beside the line, to a hundredth of a pixel


def at_least_seen(
    stripes: Sequence[Stripe], lights: Sequence[GreyValues], crests: Sequence[Ints]
) -> list[Stripe]:
    """The stripes with sigma_px enlarged to what their centres scatter about their neighbours.

    One factor for the columns that are OK and one for those SATURATED, never below 1.

    Parameters
    ----------
    stripes : sequence of Stripe, px, of N entries each
    lights : sequence of (N, L) array, DN, row i being the column (or row) of the picture that entry
        i of the stripe was found in
    crests : sequence of (N,) array, px, where each of those rows is the highest
    """
    valued = [np.count_nonzero(has_value(stripe.status)) for stripe in stripes]
    judged = [place for place, count in enumerate(valued) if count >= _FEWEST]
    lags = shared_columns(
        [stripes[place] for place in judged],
        [lights[place] for place in judged],
        [crests[place] for place in judged],
    )
    found = list(stripes)
    for place, lag in zip(judged, lags, strict=True):
        found[place] = _enlarged(stripes[place], lag)
    return found


def _enlarged(stripe: Stripe, lag: int) -> Stripe:
    """The same of a stripe whose columns share errors along ``lag`` columns."""
    run, sigma_px = pieces(stripe), stripe.sigma_px.copy()
    for status in (Status.OK, Status.SATURATED):
        kept = stripe.status == status
        if np.count_nonzero(kept) > _FEWEST:
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
        if count >= max(_FEWEST, _SPANS * lag):
            first, second, third, last = _apart(stripe.sigma_px**2, lag)
            stated = np.sqrt(first + last + 9 * (second + third))[at]
            seen = _third_differences(stripe.centre_px, lag)[at]
            ratio = max(ratio, robust_variance(seen / stated))
            chance *= np.sqrt(2 * _REPEATED / count)
        lag = 3 * lag // 4
    return float(np.sqrt(ratio)) if ratio > 1 + chance else 1.0


def shared_columns(
    stripes: Sequence[Stripe], lights: Sequence[GreyValues], crests: Sequence[Ints]
) -> list[int]:
    """Columns along which the pixels of each picture share their errors, 1 where each has its own.

    The lag, of 1, 2, 4, 8 and 16, beyond which the third differences of the line's width grow
    no more.  Where that is beyond 1 it is at least three widths of the line, over which some
    extractors smooth along it; it is 1 too where none grows by more than chance, four standard
    deviations of it.

    Parameters
    ----------
    stripes : sequence of Stripe, px, of N entries, some of which have a value
    lights, crests : sequence of array, as :func:`at_least_seen` takes them
    """
    scales: list[float] = []
    for stripe, light, crest in zip(stripes, lights, crests, strict=True):
        valued = np.flatnonzero(has_value(stripe.status))
        scales.append(line_width(light, valued, crest[valued]))
    if not scales:
        return []
    widths = _variances(stripes, lights, [max(scale, _FINEST_PX) for scale in scales])
    return [_lag(*known) for known in zip(stripes, widths, scales, strict=True)]


def _lag(stripe: Stripe, width: Floats, scale: float) -> int:
    """The same of one picture, from the line's variance (N,) in each of its columns."""
    run = np.where(np.isfinite(width), pieces(stripe), -1)
    growths: list[float] = []
    by_chance, last = True, np.inf
    for lag in _LAGS:
        values = _third_differences(width, lag)[_in_one_piece(run, lag)]
        if len(values) < _FEWEST:
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


def _variances(
    stripes: Sequence[Stripe], lights: Sequence[GreyValues], scales: Sequence[float]
) -> list[Floats]:
    """(N,) the light's variance across the line over scale², NaN where there is no line; of each.

    By moments weighted with a Gaussian of the width ``scale``, in px, about as wide as the line.
    Through it half of a line's displacement is seen, so each step to the line's middle goes twice
    as far as the first moment says; and of the variance w² only s² w² / (s² + w²), which is
    turned back.  Along a column a line of slope t is wider than across itself by (1 + t²)^(1/2).

    A weight about the middle m is that about 0 times exp(m k / s²) at the pixel k, but for a factor
    that all have in common, and so for none: of the weights about 0 powers of a number are left.
    """
    valued = [np.flatnonzero(has_value(stripe.status)) for stripe in stripes]
    ends = np.cumsum([len(at) for at in valued])
    centre = np.concatenate([one.centre_px[at] for one, at in zip(stripes, valued, strict=True)])
    row = np.rint(centre).astype(int)
    rows = np.split(row, ends[:-1])
    reach = [int(np.ceil(3 * scale)) + 2 for scale in scales]
    weighted = np.zeros((2 * max(reach) + 1, ends[-1]))  # (n, K): n is short
    for at, end, *known in zip(valued, ends, lights, rows, reach, scales, strict=True):
        light, here, far, scale = known
        part = np.s_[max(reach) - far : max(reach) + far + 1, end - len(at) : end]
        weighted[part] = _about_zero(windows(light, at, here, far).T, scale)
    scale = np.repeat(scales, [len(at) for at in valued])
    middle = centre - row
    for _ in range(_STEPS):
        about = middle
        zeroth, first, second = _moments(weighted, np.exp(about / scale**2))
        total = np.where(zeroth > 0, zeroth, np.nan)
        moved = (first / total - about) / scale
        middle = about + scale * np.clip(2 * moved, -1.0, 1.0)
    seen = ((second - 2 * about * first) / total + about**2) / scale**2
    across = seen / np.where(seen < 1, 1 - seen, np.nan)
    each = zip(
        stripes, valued, *(np.split(v, ends[:-1]) for v in (across, row + middle)), strict=True
    )
    return [_across_itself(len(stripe.status), *found) for stripe, *found in each]


def _about_zero(grey: Floats, scale: float) -> Floats:
    """Windows (n, K) of the light above its ground, with the weights about the middle pixel."""
    steps = np.arange(len(grey)) - len(grey) // 2
    weight = np.exp(-0.5 * (steps / scale) ** 2)
    return (grey - grey[[0, 1, -2, -1]].mean(axis=0)) * weight[:, None]


def _moments(weighted: Floats, factor: Floats) -> Floats:
    """(3, K) zeroth to second moments of ``weighted`` (n, K) times ``factor`` (K,) ** step.

    All by one factor more, that of the pixels before the middle one.  Horner's scheme.
    """
    total, reach = np.zeros((3, len(factor))), len(weighted) // 2
    for step in range(reach, -reach - 1, -1):
        total *= factor
        light = weighted[step + reach]
        total[0] += light
        light = light * step
        total[1] += light
        light *= step
        total[2] += light
    return total


def _across_itself(count: int, at: Ints, across: Floats, centre: Floats) -> Floats:
    """(N,) the variances (K,) of the columns ``at``, of the line square to itself."""
    seen, middle = np.full((2, count), np.nan)
    seen[at], middle[at] = across, centre
    return seen / (1 + np.gradient(middle) ** 2)


def _apart(values: NDArray[_Number], lag: int) -> list[NDArray[_Number]]:
    """Four times (Q,) values of (N,), each ``lag`` entries after the one before."""
    count = max(len(values) - 3 * lag, 0)
    return [values[k * lag : k * lag + count] for k in range(4)]


def _in_one_piece(run: Ints, lag: int) -> Mask:
    """(Q,) whether four entries ``lag`` apart are all of the same piece; -1 is none."""
    first, *others = _apart(run, lag)
    return np.logical_and.reduce([first >= 0, *(first == other for other in others)])


def _third_differences(values: Floats, lag: int) -> Floats:
    """(Q,) of values (N,), ``lag`` entries apart."""
    first, second, third, last = _apart(values, lag)
    return first - last + 3 * (third - second)
