"""The centre of a line by the paper's rules and by Steger's, with its variance."""

from math import atan2, cos, hypot, pi, sin, sqrt

import numpy as np

from lscan.files.compiling import compiled, compiled_sums
from lscan.records import Floats, Ints

# The centre by the paper's rules (stripe/rules.py).


MIDDLE, CENTROID, RELATIVE = range(3)


@compiled_sums
def centroids(
    wide: Floats,
    around: Floats,
    base: Floats,
    rule: int,
    constant: float,
    per_dn: float,
    averaged: float,
) -> tuple[Floats, Floats]:
    """Offset in px, and its variance in px², of the line in K columns from the middle pixel.

    Parameters
    ----------
    wide : (K, n + 2) array, DN, the pixels that the rule sees, and one more on either side
    around : (K, m) array, DN, smoothed, where the brightest pixel might have been as well
    base : (K,) array, DN, the columns' background
    rule : int, MIDDLE pixel, CENTROID or that of RELATIVE values
    constant, per_dn : float, DN² and DN, of the pixels' noise, as in ``picture.Noise``
    averaged : float, pixels that one of ``around`` is the mean of

    References
    ----------
    Eq. (8) of the paper; ``rules.centroid`` says what the variance holds.
    """
    count, size = len(wide), wide.shape[1] - 2
    reach, far = size // 2, around.shape[1] // 2
    offsets, variances = np.empty(count), np.empty(count)
    slope, spare = np.empty(size), np.empty(size)
    for k in range(count):
        window = wide[k, 1:-1]
        offset = _centroid(window, rule, slope)
        variance = 0.0
        for p in range(size):
            variance += slope[p] ** 2 * (constant + per_dn * max(window[p] - base[k], 0.0))
        # Another brightest pixel: those that might have been it, and how far the brighter of the
        # neighbours would move the centre.
        crest = constant + per_dn * max(window[reach] - base[k], 0.0)
        least, near, first, second = around[k, far] - 2 * sqrt(crest / averaged), 0, 0.0, 0.0
        for p in range(2 * far + 1):
            if around[k, p] >= least:
                near, first, second = near + 1, first + (p - far), second + (p - far) ** 2
        spread = second / near - (first / near) ** 2 + 1 / 12  # each is a pixel wide
        step = 1 if wide[k, reach + 2] >= wide[k, reach] else -1
        moved = step + _centroid(wide[k, 1 + step : 1 + step + size], rule, spare)
        variance += _at_most_one(moved - offset) ** 2 * spread
        if rule == RELATIVE:
            for p in range(size):
                spare[p] = window[p] - base[k]
            variance += _at_most_one(_centroid(spare, CENTROID, slope) - offset) ** 2 / 6
        offsets[k], variances[k] = offset, variance
    return offsets, variances


@compiled_sums
def _centroid(window: Floats, rule: int, slope: Floats) -> float:
    """The centre by a rule, px from the middle; ``slope`` becomes its derivative by each pixel.

    NaN where the weights have no positive sum.
    """
    size = len(window)
    reach, lowest, total, moment = size // 2, 0, 0.0, 0.0
    if rule == MIDDLE:
        slope[:] = 0.0
        return 0.0
    if rule == RELATIVE:
        for p in range(size):
            lowest = p if window[p] < window[lowest] else lowest
    floor = window[lowest] if rule == RELATIVE else 0.0
    for p in range(size):
        total += window[p] - floor
        moment += (window[p] - floor) * (p - reach)
    offset = moment / total if total > 0 else np.nan
    whole = 0.0
    for p in range(size):
        slope[p] = (p - reach - offset) / total
        whole += slope[p]
    if rule == RELATIVE:  # the lowest is taken off all weights, and moves the centroid through all
        slope[lowest] -= whole
    return offset


@compiled
def _at_most_one(step: float) -> float:
    """A pixel too where it is not known."""
    return min(abs(step), 1.0) if abs(step) == abs(step) else 1.0


# The crossing of a column with a ridge (stripe/ridge.py).


_STEEPEST = 0.1
"""Least share of the line's normal that lies along the column: steeper than 84 degrees, the
line has no one crossing with it."""
_DARK = 1e-9  # DN; what is not brighter has no ridge
_BESIDE = 2  # rows from where the picture bends most to its crossing


@compiled_sums
def ridge_crossings(
    light: Floats,
    noise: Floats,
    lit: Ints,
    threshold_dn: float,
    along: Floats,
    across: Floats,
) -> tuple[Floats, Floats]:
    """Row and its standard uncertainty, (K,) px each, of the ridge of a smoothed picture.

    Near the row where the picture bends most, among those whose own light or a neighbour's is above
    the threshold: a stronger line that ends beside the column is smoothed into it.  The derivative
    across the line must change its sign within two rows; NaN where it does not, and where the line
    runs along the column.

    Parameters
    ----------
    light : (W, H) array, DN, one column of the picture a row; beyond its edges there is none
    noise : (3,) array, of its pixels, constant in DN², DN of variance per DN of light, speckle
    lit : (K,) array, rising, the columns wanted
    threshold_dn : float, DN
    along, across : (3, 2 n + 1) array, a Gaussian and its first two derivatives, along the rows and
        along the columns; where the first is one pixel long each column is smoothed by itself
    """
    width, height = light.shape
    reach_u, reach_v = along.shape[1] // 2, across.shape[1] // 2
    first, last = np.full(width, height), np.full(width, -1)
    top, bottom = np.full(len(lit), height), np.full(len(lit), -1)
    for k in range(len(lit)):
        for row in range(height):
            if light[lit[k], row] > threshold_dn:
                top[k] = min(top[k], max(row - 1, 0))
                bottom[k] = min(row + 1, height - 1)
        for u in range(max(lit[k] - reach_u, 0), min(lit[k] + reach_u + 1, width)):
            first[u] = min(first[u], max(top[k] - _BESIDE, 0))
            last[u] = max(last[u], min(bottom[k] + _BESIDE, height - 1))
    down = np.empty((3, width, height))
    for u in range(width):
        for row in range(first[u], last[u] + 1):
            begin, end = max(row - reach_v, 0), min(row + reach_v + 1, height)
            grey, skipped = light[u, begin:end], begin - row + reach_v
            for order in range(3):
                bell, total = across[order, skipped:], 0.0
                for p in range(len(grey)):
                    total += bell[p] * grey[p]
                down[order, u, row] = total
    centre, sigma = np.full(len(lit), np.nan), np.full(len(lit), np.nan)
    ratio, beside = np.empty(2 * _BESIDE + 1), np.empty(2 * _BESIDE + 1, np.int64)
    for k in range(len(lit)):
        u, best, lowest = lit[k], -1, np.inf
        for row in range(top[k], bottom[k] + 1):
            near = light[u, row] > threshold_dn
            near |= row > 0 and light[u, row - 1] > threshold_dn
            near |= row + 1 < height and light[u, row + 1] > threshold_dn
            if near:
                bend = _ridge(down, u, row, along)[0]
                if bend < lowest:
                    best, lowest = row, bend
        if best < 0:
            continue
        for i in range(2 * _BESIDE + 1):
            beside[i] = min(max(best + i - _BESIDE, 0), height - 1)
            _, by_u, by_v, slope, value = _ridge(down, u, beside[i], along)
            ratio[i] = slope / max(value, _DARK)
        _, by_u, by_v, _, value = _ridge(down, u, best, along)
        nearest, apart = -1, np.inf
        for i in range(2 * _BESIDE):
            aside = abs(beside[i] + 0.5 - best)
            whole = beside[i + 1] == beside[i] + 1
            if whole and ratio[i] > 0 and ratio[i + 1] <= 0 and aside < apart:
                nearest, apart = i, aside
        if nearest < 0 or by_v < _STEEPEST:
            continue
        change = ratio[nearest + 1] - ratio[nearest]  # of the slope over the value, in px^-2
        centre[k] = beside[nearest] - ratio[nearest] / change
        variance = _slope_variance(light, noise, u, best, along, across, by_u, by_v)
        sigma[k] = sqrt(variance) / max(value, _DARK) / abs(change)
    return centre, sigma


@compiled_sums
def _ridge(
    down: Floats, u: int, row: int, along: Floats
) -> tuple[float, float, float, float, float]:
    """Second derivative across the ridge, its normal along u and v, first derivative, the picture.

    The derivatives are in DN/px² and DN/px, the first is positive towards lower rows.
    """
    reach = along.shape[1] // 2
    value = by_u = by_v = uu = uv = vv = 0.0
    for at in range(max(u - reach, 0), min(u + reach + 1, down.shape[1])):
        bell, slope, bend = (
            along[0, at - u + reach],
            along[1, at - u + reach],
            along[2, at - u + reach],
        )
        plain, first, second = down[0, at, row], down[1, at, row], down[2, at, row]
        value += bell * plain
        by_u += slope * plain
        by_v += bell * first
        uu += bend * plain
        uv += slope * first
        vv += bell * second
    if reach == 0:  # the line is taken to run square to the column
        return vv, 0.0, 1.0, by_v, value
    bent = (uu + vv) / 2 - hypot((uu - vv) / 2, uv)
    # The eigenvector to the smaller eigenvalue is square to that to the larger one; its angle
    # lies between 0 and pi, so that its part along v is never negative.
    angle = atan2(2 * uv, uu - vv) / 2 + pi / 2
    return bent, cos(angle), sin(angle), cos(angle) * by_u + sin(angle) * by_v, value


@compiled_sums
def _slope_variance(
    light: Floats,
    noise: Floats,
    u: int,
    row: int,
    along: Floats,
    across: Floats,
    by_u: float,
    by_v: float,
) -> float:
    """Variance in DN²/px² of the derivative in a direction, each pixel's noise its own."""
    reach_u, reach_v, total = along.shape[1] // 2, across.shape[1] // 2, 0.0
    for at in range(max(u - reach_u, 0), min(u + reach_u + 1, light.shape[0])):
        plain, slope = by_v * along[0, at - u + reach_u], by_u * along[1, at - u + reach_u]
        for v in range(max(row - reach_v, 0), min(row + reach_v + 1, light.shape[1])):
            grey = light[at, v]
            weight = slope * across[0, v - row + reach_v] + plain * across[1, v - row + reach_v]
            pixel = noise[0] + noise[1] * max(grey, 0.0) + (noise[2] * grey) ** 2
            total += weight * weight * pixel
    return total
