"""How far the centres scatter along a line, and the light across it."""

from math import exp, hypot, sqrt

import numpy as np

from lscan.files.compiling import compiled, compiled_sums
from lscan.records import Floats, GreyValues, Ints, Mask

# How far values scatter along a line, and the light across it (stripe/scatter.py,
# stripe/picture.py).


@compiled
def third_differences(values: Floats, run: Ints, lag: int) -> tuple[Ints, Floats]:
    """Of four values ``lag`` entries apart in one piece: the first one's index, their difference.

    Parameters
    ----------
    values : (N,) array, of any unit
    run : (N,) array, number of the piece that each belongs to, -1 for none
    lag : int, entries
    """
    at, found, count = np.empty(len(run), np.int64), np.empty(len(run)), 0
    for i in range(len(run) - 3 * lag):
        one = run[i]
        if one >= 0 and run[i + lag] == one == run[i + 2 * lag] and run[i + 3 * lag] == one:
            at[count] = i
            found[count] = values[i] - values[i + 3 * lag]
            found[count] += 3 * (values[i + 2 * lag] - values[i + lag])
            count += 1
    return at[:count], found[:count]


@compiled
def _sort(values: Floats) -> None:
    """Sort a few values in place; numba's own takes seconds to compile."""
    for n in range(1, len(values)):
        value, place = values[n], n
        while place > 0 and values[place - 1] > value:
            values[place] = values[place - 1]
            place -= 1
        values[place] = value


@compiled
def running_medians(values: Floats, half: int) -> Floats:
    """(N,) median of each value and so many on either side, as ``peaks.running_median``.

    Parameters
    ----------
    values : (N,) array, of any unit, N > 0, without NaN
    half : int, values; beyond the ends the end values count
    """
    size, last = 2 * half + 1, len(values) - 1
    rising, medians = np.empty(size), np.empty(len(values))
    for k in range(size):  # those about the value before the first
        rising[k] = values[min(max(k - half - 1, 0), last)]
    _sort(rising)
    for n in range(len(values)):
        gone, new = values[max(n - 1 - half, 0)], values[min(n + half, last)]
        place = 0
        while rising[place] < gone:
            place += 1
        while place < size - 1 and rising[place + 1] < new:
            rising[place] = rising[place + 1]
            place += 1
        while place > 0 and rising[place - 1] > new:
            rising[place] = rising[place - 1]
            place -= 1
        rising[place] = new
        medians[n] = rising[half]
    return medians


@compiled
def pieces_of(valued: Mask, centre: Floats, jump_px: float) -> Ints:
    """(N,) number of the piece that ``peaks.pieces`` gives each column.

    Parameters
    ----------
    valued : (N,) mask, of the columns that have a value
    centre : (N,) array, px
    jump_px : float, px, by which a line moves to the next column at most
    """
    piece, number = np.full(len(centre), -1), -1
    for n in range(len(centre)):
        if valued[n]:
            goes_on = n > 0 and valued[n - 1] and abs(centre[n] - centre[n - 1]) <= jump_px
            number += 0 if goes_on else 1
            piece[n] = number
    return piece


@compiled
def end_doubts(
    run: Ints, centre: Floats, variance: Floats, ln_flux: Floats, near: int, reach: int
) -> Floats:
    """(N,) px, what ``scatter._end_doubt`` says, from the variance across the line in px².

    Parameters
    ----------
    run : (N,) array, number of the piece each column belongs to, -1 for none
    centre, variance, ln_flux : (N,) array, of the line, px, px² and of DN; NaN where not known
    near, reach : int, columns from an end, between which its slope and width are taken
    """
    doubt, last = np.zeros(len(run)), len(run) - 1
    inner = np.empty(reach - near)
    first = 0
    while first <= last:
        final = first
        while final < last and run[final + 1] == run[first]:
            final += 1
        size = min(reach, final - first + 1)
        for step in (1, -1):
            end = first if step == 1 else final
            if run[first] < 0 or size < 2 * near or end in (0, last):
                continue
            for i in range(near, size):
                inner[i - near] = variance[end + step * i]
            seen = inner[: size - near]
            unknown = seen.sum()  # NaN where one of them is
            _sort(seen)
            middle = (seen[(len(seen) - 1) // 2] + seen[len(seen) // 2]) / 2 + 0 * unknown
            slope = centre[end + step * (size - 1)] - centre[end + step * near]
            scale = abs(slope / (size - 1 - near)) * middle / sqrt(3)
            before = 0.0
            for i in range(size - 1):
                at = end + step * i
                fall = ln_flux[at + step] - ln_flux[at]
                fall = 0.0 if fall <= 0 else fall  # NaN stays
                mean = fall if i == 0 else (before + fall) / 2
                doubt[at] = hypot(doubt[at], scale * (fall if fall >= mean else mean))
                before = fall
        first = final + 1
    return doubt


@compiled
def count_second_differences(columns: GreyValues, most: int) -> Ints:
    """How often each size of I[i-1] - 2 I[i] + I[i+1] along the columns occurs, from 0 to ``most``.

    Parameters
    ----------
    columns : (W, H) array, whole DN, one column of the picture a row
    most : int, DN, the greatest there can be
    """
    count, other = np.zeros(most + 1, np.int64), np.zeros(most + 1, np.int64)
    for c in range(len(columns)):
        grey = columns[c]
        before, here = np.int64(grey[0]), np.int64(grey[min(1, len(grey) - 1)])
        for p in range(2, len(grey)):
            after = np.int64(grey[p])
            size = abs(before - 2 * here + after)
            if p % 2:  # most sizes are alike, and one counter would wait for itself
                count[size] += 1
            else:
                other[size] += 1
            before, here = here, after
    return count + other


@compiled
def total_profile(columns: GreyValues, at: Ints, rows: Ints, reach: int) -> Floats:
    """(2 reach + 1,) DN, sum of the pixels about a row of each of some columns.

    Parameters
    ----------
    columns : (W, H) array, DN, one column of the picture a row
    at, rows : (K,) array, px, the columns and the middle row of each
    reach : int, px; beyond the picture its last pixel is repeated
    """
    total, last = np.zeros(2 * reach + 1), columns.shape[1] - 1
    for k in range(len(at)):
        begin = rows[k] - reach
        if begin >= 0 and begin + 2 * reach <= last:
            grey = columns[at[k], begin : begin + 2 * reach + 1]
            for p in range(2 * reach + 1):
                total[p] += grey[p]
        else:
            for p in range(2 * reach + 1):
                total[p] += columns[at[k], min(max(begin + p, 0), last)]
    return total


@compiled
def core_variance(sizes: Floats, counts: Ints, least: float, cuts: int, kept: float) -> float:
    """The variance that ``picture.robust_variance`` says, of rising sizes; 0 of none.

    Parameters
    ----------
    sizes : (N,) array, rising, of any unit
    counts : (N,) array, how often there is each
    least : float, where the search starts if most values agree
    cuts : int, turns
    kept : float, share of a normal distribution's variance that lies within 3 sigma
    """
    whole, up_to, middle = counts.sum(), 0, 0.0
    for n in range(len(sizes)):
        for rank in ((whole - 1) // 2, whole // 2):
            middle += sizes[n] / 2 if up_to <= rank < up_to + counts[n] else 0.0
        up_to += counts[n]
    variance = max((1.4826 * middle) ** 2, least) if whole else 0.0
    for _ in range(cuts):
        limit, total, inside = 3 * sqrt(variance), 0.0, 0
        for n in range(len(sizes)):
            if sizes[n] > limit:
                break
            total += counts[n] * sizes[n] ** 2
            inside += counts[n]
        if inside == 0:
            break
        variance = total / inside / kept
    return variance


_STEPS = 4  # from a pixel beside the line, to a hundredth of a pixel


@compiled_sums
def weighted_moments(columns: GreyValues, at: Ints, centre: Floats, scale: float) -> Floats:
    """(3, K) of the light about some centres, weighted with a Gaussian about its own middle.

    Its middle, px, NaN where there is none; its variance over the Gaussian's; and its sum, DN.
    The ground taken off is the mean of the two outermost pixels on either side.

    Parameters
    ----------
    columns : (W, H) array, DN, one column of the picture a row
    at : (K,) array, indices of the columns
    centre : (K,) array, px, where the search begins
    scale : float, px, the Gaussian's standard deviation
    """
    found = np.full((3, len(at)), np.nan)
    reach, last = int(np.ceil(3 * scale)) + 2, columns.shape[1] - 1
    light = np.empty(2 * reach + 1)
    for k in range(len(at)):
        row = round(centre[k])
        for p in range(2 * reach + 1):
            light[p] = columns[at[k], min(max(row + p - reach, 0), last)]
        ground = (light[0] + light[1] + light[-2] + light[-1]) / 4
        middle = centre[k] - row
        for _ in range(_STEPS):
            total, first, second = 0.0, 0.0, 0.0
            for p in range(2 * reach + 1):
                off = p - reach - middle
                weighted = exp(-0.5 * (off / scale) ** 2) * (light[p] - ground)
                total += weighted
                first += weighted * off
                second += weighted * off * off
            if total <= 0:
                break
            found[1, k], found[2, k] = second / total / scale**2, total
            middle += scale * min(max(2 * first / total / scale, -1.0), 1.0)
        if total > 0:
            found[0, k] = row + middle
        else:
            found[1:, k] = np.nan
    return found


# What makes pixels scatter about a fitted line (stripe/picture.py).


@compiled_sums
def shot_and_speckle(square: Floats, light: Floats, constant: float) -> tuple[float, float]:
    """DN of variance per DN of light, and speckle, that ``picture.scatter_noise`` finds.

    Parameters
    ----------
    square : (N,) array, DN², on average the variance
    light : (N,) array, DN
    constant : float, DN²
    """
    shot, speckle = 0.0, 0.0
    for turn in range(4):
        # The normal equations of square - constant = shot light + speckle² light².
        one, both, two, first, second = 0.0, 0.0, 0.0, 0.0, 0.0
        for p in range(len(light)):
            grey = light[p]
            variance = constant + shot * max(grey, 0.0) + (speckle * grey) ** 2
            # Nothing is known of the line's part yet at the first turn: all squares count.
            core = turn == 0 or square[p] <= 25 * variance
            root = 1 / max(variance, 1e-3 * grey**2) if core else 0.0
            weight, rest = (root * grey) ** 2, square[p] - constant
            one, both, two = one + weight, both + weight * grey, two + weight * grey**2
            first, second = first + root**2 * grey * rest, second + weight * rest
        shot, speckled = _non_negative(one, both, two, first, second)
        speckle = min(sqrt(speckled), 1.0)
    return shot, speckle


@compiled
def _non_negative(
    one: float, both: float, two: float, first: float, second: float
) -> tuple[float, float]:
    """The least squares solution, neither part below 0, of two normal equations."""
    found = one * two - both * both
    x, y = (first * two - second * both) / found, (second * one - first * both) / found
    if found > 0 and x >= 0 and y >= 0:
        return x, y
    x, y = max(first / one, 0.0) if one > 0 else 0.0, max(second / two, 0.0) if two > 0 else 0.0
    return (
        (x, 0.0) if x * first > y * second else (0.0, y)
    )  # what each takes off the sum of squares
