"""Where a column of a picture may hold the line: ranks, spots, their runs, the best path."""

from typing import Any

import numpy as np

from lscan.files.compiling import compiled, compiled_order
from lscan.records import Floats, GreyValues, Ints, Singles

# Ranks of the pixels of a column (stripe/peaks.py).


@compiled_order
def crests_of(columns: GreyValues) -> Ints:
    """(W,) row of the highest value of each column, as ``peaks.crests``, of whole numbers.

    Parameters
    ----------
    columns : (W, H) array, DN, one column of the picture a row
    """
    rows = np.zeros(len(columns), np.int64)
    for c in range(len(columns)):
        grey = columns[c]
        highest, p = _greatest(grey), 0
        while p + _ROWS <= len(grey) and _greatest(grey[p : p + _ROWS]) < highest:
            p += _ROWS
        while grey[p] < highest:
            p += 1
        rows[c] = p
    return rows


@compiled_order
def order_statistics(columns: GreyValues, rank: int, least: int, most: int) -> Floats:
    """(W,) DN, of each column the value that ``peaks.order_statistic`` says, of whole numbers.

    To count the pixels up to a grey value takes a thirtieth of a partial sort.  The search begins
    at the column before and goes from there in steps twice as long each.

    Parameters
    ----------
    columns : (W, H) array, DN, one column of the picture a row
    rank : int, 0 for the lowest, below H
    least, most : int, DN, of all pixels
    """
    values, middle = np.empty(len(columns)), least
    for c in range(len(columns)):
        low, high, step = least, most, 1
        while low < high:
            if _count_up_to(columns[c], middle) > rank:
                high = middle
                middle = max(middle - step, (low + high) // 2)
            else:
                low = middle + 1
                middle = min(middle + step, (low + high) // 2)
            step *= 2
        values[c] = middle = low
    return values


@compiled_order
def _count_up_to(values: GreyValues, limit: int) -> int:
    count = np.int32(0)  # a short one, so that many pixels are compared at a time
    for p in range(len(values)):
        count += np.int32(values[p] <= limit)
    return int(count)


@compiled_order
def _greatest(values: GreyValues) -> float:
    """A camera's grey values are compared many at a time, floats are not."""
    found = values[0]
    for p in range(len(values)):
        found = max(found, values[p])
    return found


@compiled_order
def _least(values: GreyValues) -> float:
    found = values[0]
    for p in range(len(values)):
        found = min(found, values[p])
    return found


# Spots across a column (stripe/peaks.py).


_ROOM_PX = 16
"""To either side of a stretch of bright pixels, where the feet of its spots are looked for.  A line
of half the threshold's light is no spot, so that few feet lie far from bright pixels."""
_ROWS = 32  # a column is searched for bright pixels so many at a time
_CLOSED_PX = 2  # speckle breaks the flanks of wide lines by so much
_HIGHEST = np.float32(np.finfo(np.float32).max)


@compiled_order
def find_spots(
    columns: GreyValues,
    opened: GreyValues,
    threshold_dn: float,
    ground_px: int,
    sharp: bool,
    bell: Singles,
    reach_px: int,
) -> tuple[Ints, Floats]:
    """Column, top and bottom (3, K), light and peak (2, K) of the spots of ``peaks.spots_of``.

    No ground lies below the least pixel of its column, so that every spot holds a pixel that
    exceeds that by the threshold.  Such pixels are brought together in stretches, and each stretch
    is looked at with all that its spots depend on.

    Parameters
    ----------
    columns : (W, H) array, uint8 or single precision, DN, one column of the picture a row
    opened : (W, H) array, DN, the same, or smoothed: of which the ground is found
    threshold_dn : float, DN, by which a spot exceeds the ground
    ground_px : int, odd, px, what is wider is ground
    sharp : bool, whether the ground is that of the columns not smoothed with ``bell``
    bell : (2 n + 1,) array, weights of a symmetric smoothing
    reach_px : int, px, a spot is where the light exceeds half of its highest value so near by
    """
    width, height = columns.shape
    half, feather = ground_px // 2, len(bell) // 2
    room = height + 4 * half + 2 * reach_px + 2 * feather + _ROWS
    smooth, ground = np.empty(room, np.float32), np.empty(room, np.float32)
    light, one, other = ground.copy(), ground.copy(), ground.copy()
    inside = np.zeros(room, np.bool_)
    place, strength, count = np.empty((3, width), np.int64), np.empty((2, width)), 0
    faint = np.float32(threshold_dn / 4)
    for c in range(width):
        grey, base = columns[c], opened[c]
        limit = _least(base) + max(threshold_dn - 1, 0.0)
        bottom, whole, before = -1, False, count
        while True:
            if whole:
                first, end = 0, height
            else:
                top, bottom = _bright_stretch(grey, bottom + 1, limit)
                if top == height:
                    break
                first, end = max(top - _ROOM_PX, 0), min(bottom + _ROOM_PX + 1, height)
            near, beyond = max(first - reach_px, 0), min(end + reach_px, height)
            outer, last = max(near - 2 * half, 0), min(beyond + 2 * half, height)
            _smoothed(base, outer, last, bell, one, smooth)
            # What the ground is the opening of: the least about each pixel, of these the highest.
            begin, after = max(near - half, 0), min(beyond + half, height)
            if sharp:
                _framed(base, 0, begin - half, after + half, 1.0, one)
            else:
                seen = smooth[: last - outer]
                _framed(seen, outer, begin - half, after + half, 1.0, one)
            least = _least_of_windows(one, other, after - begin + 2 * half, ground_px)
            _framed(least[: after - begin], begin, near - half, beyond + half, -1.0, light)
            size = beyond - near
            minus_ground = _least_of_windows(light, ground, size + 2 * half, ground_px)
            lit = smooth[near - outer : beyond - outer]
            for p in range(size):
                lit[p] += minus_ground[p]
            _framed(lit, near, first - reach_px, end + reach_px, -1.0, one)
            around = _least_of_windows(one, other, end - first + 2 * reach_px, 2 * reach_px + 1)
            here = lit[first - near : end - near]
            for p in range(end - first):
                inside[p] = (here[p] > faint) & (2 * here[p] > -around[p])
            inside[end - first] = False
            cut, begin, after = False, -1, -1
            for p in range(first, end + 1):
                if inside[p - first]:
                    begin, after = p if begin < 0 else begin, p + 1
                elif begin >= 0 and (p == end or p - after >= _CLOSED_PX):
                    begin = 0 if begin == 1 else begin
                    after = height if after == height - 1 else after
                    total, peak = 0.0, -_HIGHEST
                    for q in range(begin, after):
                        above = grey[q] + minus_ground[q - near]
                        total += above
                        peak = max(peak, above)
                    if peak > threshold_dn:
                        cut |= 0 < first >= begin - _CLOSED_PX
                        cut |= height > end <= after + _CLOSED_PX
                        if count == place.shape[1]:
                            place, strength = _doubled(place), _doubled(strength)
                        place[0, count], place[1, count], place[2, count] = c, begin, after - 1
                        strength[0, count], strength[1, count] = total, peak
                        count += 1
                    begin = -1
            if whole:
                break
            if cut:  # a spot reaches farther than was looked
                whole, count = True, before
    return place[:, :count], strength[:, :count]


@compiled_order
def _bright_stretch(grey: GreyValues, start: int, limit: float) -> tuple[int, int]:
    """First and last of the next pixels above the limit, none farther from the next than two rooms.

    The length of the column where there is none.
    """
    height, p = len(grey), start
    while p < height:
        if p + _ROWS <= height and not _greatest(grey[p : p + _ROWS]) > limit:
            p += _ROWS
        elif grey[p] > limit:
            break
        else:
            p += 1
    top = bottom = p
    while p < min(bottom + 2 * _ROOM_PX + 1, height):
        bottom = p if grey[p] > limit else bottom
        p += 1
    return top, bottom


@compiled_order
def _smoothed(
    column: GreyValues, first: int, end: int, bell: Singles, spare: Singles, out: Singles
) -> None:
    """Some pixels of a column, smoothed; it is mirrored about its end pixels."""
    half, last, count = len(bell) // 2, len(column) - 1, end - first
    _framed(column, 0, first - half, end + half, 1.0, spare)
    for p in range(first - half, 0):
        spare[p - first + half] = column[min(-p, last)]
    for p in range(last + 1, end + half):
        spare[p - first + half] = column[max(2 * last - p, 0)]
    middle = spare[half:]
    for i in range(count):
        out[i] = bell[half] * middle[i]
    for k in range(1, half + 1):
        before, after, weight = spare[half - k :], spare[half + k :], bell[half + k]
        for i in range(count):
            out[i] += weight * (before[i] + after[i])


@compiled_order
def _framed(
    values: GreyValues, begin: int, first: int, end: int, sign: float, out: Singles
) -> None:
    """Pixels from ``first`` to ``end``, of values that start at ``begin``; beyond them the highest.

    So the least of a window is that of the part of it that there is.
    """
    inner, outer = max(first, begin), min(end, begin + len(values))
    out[: inner - first] = _HIGHEST
    out[outer - first : end - first] = _HIGHEST
    here, there, factor = values[inner - begin :], out[inner - first :], np.float32(sign)
    for i in range(outer - inner):
        there[i] = factor * here[i]


@compiled_order
def _least_of_windows(values: Singles, spare: Singles, count: int, size: int) -> Singles:
    """The least of each window of ``size`` of so many values, in one of the two arrays.

    Of windows twice as long each time.
    """
    have, turned = 1, False
    while have < size:
        step = min(have, size - have)
        count -= step
        if turned:
            _lesser(spare, spare[step:], values, count)
        else:
            _lesser(values, values[step:], spare, count)
        turned, have = not turned, have + step
    return spare if turned else values


@compiled_order
def _lesser(one: Singles, other: Singles, out: Singles, count: int) -> None:
    for i in range(count):
        out[i] = one[i] if one[i] < other[i] else other[i]


@compiled
def _doubled(table: Any) -> Any:
    """A table (n, K) with room for twice as many columns."""
    longer = np.empty((len(table), 2 * table.shape[1]), table.dtype)
    for i in range(len(table)):  # to assign a slice takes six seconds to compile
        for k in range(table.shape[1]):
            longer[i, k] = table[i, k]
    return longer


# Runs of spots side by side (stripe/peaks.py).


@compiled
def linked_runs(column: Ints, top: Ints, bottom: Ints, gap: int) -> Ints:
    """(K,) number of the run each spot belongs to, as ``peaks.runs_of`` says.

    Parameters
    ----------
    column, top, bottom : (K,) array, px, of the spots, columns rising
    gap : int, most columns from a spot to the next of its run
    """
    count = len(column)
    before = np.full(count, -1)  # the spot to the left that each is linked to
    is_open = np.ones(count, np.bool_)  # to the right
    for apart in range(1, gap + 1):
        to_right, to_left = np.full(count, -1), np.full(count, -1)
        right_px, left_px = np.full(count, np.inf), np.full(count, np.inf)
        begin = 0
        for k in range(count):
            while begin < count and column[begin] < column[k] + apart:
                begin += 1
            j = begin
            while j < count and column[j] == column[k] + apart:
                distance = abs(top[k] + bottom[k] - top[j] - bottom[j]) / 2
                height = bottom[k] - top[k] + bottom[j] - top[j] + 2
                if is_open[k] and before[j] < 0 and distance <= height / 2 + apart:
                    if distance < right_px[k]:
                        right_px[k], to_right[k] = distance, j
                    if distance < left_px[j]:
                        left_px[j], to_left[j] = distance, k
                j += 1
        for k in range(count):
            j = to_right[k]
            if j >= 0 and to_left[j] == k:
                before[j], is_open[k] = k, False
    run, runs = np.empty(count, np.int64), 0
    for k in range(count):
        if before[k] < 0:
            run[k], runs = runs, runs + 1
        else:
            run[k] = run[before[k]]
    return run


# The best path through spots (stripe/returns.py).


@compiled
def best_path(
    column: Ints,
    middle: Floats,
    gain: Floats,
    gap: int,
    jump_px: float,
    begin: float,
    missed: float,
) -> Ints:
    """Indices of the spots on the path of the highest sum, by dynamic programming.

    Parameters
    ----------
    column, middle : (K,) array, px, of the spots, columns rising
    gain : (K,) array, what a path gains by each
    gap : int, most columns from a spot to the next of its path
    jump_px : float, px a column, by which a path moves at the price of 1
    begin : float, the price of another beginning, and the most that a move costs
    missed : float, the price of a column without a spot

    References
    ----------
    R. Bellman, Dynamic Programming, Princeton 1957: of the best path every beginning is best.
    """
    count = len(column)
    score, back = np.empty(count), np.full(count, -1)
    top_score, top, first, oldest = 0.0, -1, 0, 0
    while first < count:
        end = first
        while end < count and column[end] == column[first]:
            end += 1
        while column[oldest] < column[first] - gap:
            oldest += 1
        for k in range(first, end):
            best = top_score - begin
            back[k] = top
            for j in range(oldest, first):
                apart = column[k] - column[j]
                move = min(abs(middle[k] - middle[j]) / (jump_px * apart), begin)
                value = score[j] - move - missed * (apart - 1)
                if value > best:
                    best, back[k] = value, j
            score[k] = gain[k] + best
        for k in range(first, end):
            if score[k] > top_score:
                top_score, top = score[k], k
        first = end
    length, k = 0, top
    while k >= 0:
        length, k = length + 1, back[k]
    path = np.empty(length, np.int64)
    for place in range(length - 1, -1, -1):
        path[place], top = top, back[top]
    return path
