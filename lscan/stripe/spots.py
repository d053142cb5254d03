"""Spots: where the columns of a picture cross what may be a line; runs: spots side by side."""

from dataclasses import dataclass

import cv2
import numpy as np

from lscan.records import Floats, GreyValues, Ints, Mask, Singles, select
from lscan.stripe.peaks import all_windows

GROUND_PX = 61
"""What is wider than this, along the column, is ground: four FWHM of 6 px lines."""

REACH_PX = 8
"""A spot is where the picture exceeds half of its highest value so near by."""

GAP = 4
"""Columns that speckle or a dark grain may take out of a run."""

_SMOOTHING_PX = 1.0  # as wide as a narrow line: speckle must not split a spot in two
_SEEN_PX = GROUND_PX - 1 + 4  # to either side of a pixel: what its ground depends on, smoothed
_ROOM_PX = 16
"""To either side of a stretch of bright pixels, where the feet of its spots are looked for.  A line
of half the threshold's light is no spot, so that few feet lie far from bright pixels."""
_SURE_PX = _ROOM_PX - REACH_PX - 3  # a foot so far out is found as in the whole column
MOST_SPOTS = 32
"""Of a column: those of the most light.  In a picture of noise each of thousands of rows may hold
one, and spots are compared in pairs."""


@dataclass(frozen=True)
class Relief:
    """What stands out of the columns of a picture.

    In memory the columns' pixels of one row lie together: what is done along short columns takes
    many columns in one step.

    Attributes
    ----------
    columns : (W, H) array, DN, one column of the picture a row
    smoothed : (W, H) array, DN, the columns smoothed along themselves
    ground : (W, H) array, DN, what lies beneath the lines: the smoothed column after a grey-scale
        opening, its narrow peaks cut off
    """

    columns: GreyValues
    smoothed: Singles
    ground: Singles


def relief_of(
    columns: GreyValues,
    ground_px: int = GROUND_PX,
    sharp: bool = False,
    rows: slice = slice(None),
) -> Relief:
    """The columns with the ground beneath their lines.

    Parameters
    ----------
    columns : (W, H) array, DN, one column of the picture a row
    ground_px : int, odd, px, what is wider along the column is ground
    sharp : bool, whether the ground is that of the columns as they are, not smoothed
    rows : slice, of the columns, which are wanted
    """
    single = columns.astype(np.float32)
    blurred = cv2.GaussianBlur(single, (0, 1), sigmaX=_SMOOTHING_PX, sigmaY=_SMOOTHING_PX)
    smoothed = np.asarray(cv2.transpose(blurred), np.float32)
    opened = np.ascontiguousarray(single.T) if sharp else smoothed
    ground = _opened(opened, ground_px, rows)
    return Relief(columns[:, rows], smoothed[rows].T, ground.T)


def _opened(values: Singles, size: int, rows: slice) -> Singles:
    """Some of (H, W) rows after a grey-scale opening over ``size`` of them, an odd number.

    Edges cut it short.  The extreme of so many rows is that of two parts that overlap, each found
    from half as many.
    """
    first, last, _ = rows.indices(len(values))
    reach, half = size - 1, size // 2
    whole = first < reach or last + reach > len(values)
    values = values if whole else values[first - reach : last + reach]
    for extreme, nothing in ((np.minimum, np.inf), (np.maximum, -np.inf)):
        if whole:
            padded = np.full((len(values) + 2 * half, values.shape[1]), nothing, np.float32)
            padded[half : half + len(values)] = values
            values = padded
        done = 1
        while done < size:
            step = min(done, size - done)
            values = extreme(values[:-step], values[step:])
            done += step
    return values[rows] if whole else values


@dataclass(frozen=True)
class Spots:
    """Where the columns cross lines: K spots, column by column, each from the top.

    Attributes
    ----------
    column : (K,) array
    top, bottom : (K,) array, px, first row and last, where it has half its light
    light : (K,) array, DN, sum of the grey values above the ground between them
    peak : (K,) array, DN, the highest of them
    """

    column: Ints
    top: Ints
    bottom: Ints
    light: Floats
    peak: Floats

    @property
    def height(self) -> Ints:
        """(K,) in px."""
        return self.bottom - self.top + 1

    @property
    def middle(self) -> Floats:
        """(K,) row."""
        return (self.top + self.bottom) / 2


def spots_of(relief: Relief, threshold_dn: float) -> Spots:
    """The spots of all columns whose highest value exceeds the ground by the threshold.

    Parameters
    ----------
    relief : Relief, DN, of W columns
    threshold_dn : float, DN
    """
    columns, ground = relief.columns, relief.ground
    light = relief.smoothed.T - ground.T
    around = np.asarray(cv2.dilate(light, np.ones((2 * REACH_PX + 1, 1), np.uint8)))
    inside = np.asarray((light > around / 2) & (light > threshold_dn / 4), np.uint8)
    # Speckle breaks the flanks of wide lines: gaps of two rows are closed.
    closed = cv2.morphologyEx(inside, cv2.MORPH_CLOSE, np.ones((3, 1), np.uint8))
    count, height = columns.shape
    apart = np.zeros(count * (height + 1) + 1, dtype=np.int8)  # nothing between two columns
    apart[1:].reshape(count, height + 1)[:, :-1] = cv2.transpose(closed)
    edge = np.diff(apart)
    column, top = np.divmod(np.flatnonzero(edge > 0), height + 1)
    bottom = np.flatnonzero(edge < 0) % (height + 1)  # one row further; both in the same order
    bounds = np.column_stack([column * height + top, column * height + bottom]).ravel()
    above = np.append((columns - ground).ravel(), 0.0)  # so that the last bound is within it
    total = np.add.reduceat(above, bounds)[::2] if len(bounds) else np.zeros(0)
    peak = np.maximum.reduceat(above, bounds)[::2] if len(bounds) else np.zeros(0)
    high = np.flatnonzero(peak > threshold_dn)
    kept = high[brightest(column[high], total[high], MOST_SPOTS)]
    return Spots(column[kept], top[kept], bottom[kept] - 1, total[kept], peak[kept])


def spots_near(columns: GreyValues, threshold_dn: float) -> Spots | None:
    """The spots that :func:`spots_of` finds in the columns, looked for about bright pixels alone.

    No ground lies below the least pixel of its column, so that every spot holds a pixel that
    exceeds that by the threshold.  Such pixels are brought together in stretches, and each stretch
    is looked at in a window that holds all that its spots depend on.

    None where that is no less than the picture, and where spots reach beyond their windows.

    Parameters
    ----------
    columns : (W, H) array, DN, one column of the picture a row
    threshold_dn : float, DN
    """
    height = columns.shape[1]
    column, top, bottom = _bright_stretches(columns, threshold_dn)
    if len(column) == 0:
        none = np.zeros(0, dtype=np.int64)
        return Spots(none, none, none, np.zeros(0), np.zeros(0))
    length = int((bottom - top).max()) + 1 + 2 * (_ROOM_PX + _SEEN_PX)
    if length > height or length * len(column) > columns.size:
        return None
    start = np.clip(top - _ROOM_PX - _SEEN_PX, 0, height - length)
    first = max(int((top - start).min()) - _ROOM_PX, 0)
    seen = all_windows(columns, length)[column, start]
    last = int((bottom - start).max()) + _ROOM_PX
    spots = spots_of(relief_of(seen, rows=slice(first, last + 1)), threshold_dn)
    where, moved = spots.column, (start + first)[spots.column]
    found = Spots(column[where], spots.top + moved, spots.bottom + moved, spots.light, spots.peak)
    own = (found.top <= bottom[where]) & (found.bottom >= top[where])
    over = (found.top < top[where] - _SURE_PX) & (found.top > 0)
    over |= (found.bottom > bottom[where] + _SURE_PX) & (found.bottom < height - 1)
    crowded = len(where) > 0 and np.bincount(found.column).max() >= MOST_SPOTS
    return None if crowded or (over & own).any() else select(found, own)


def _bright_stretches(columns: GreyValues, threshold_dn: float) -> tuple[Ints, Ints, Ints]:
    """Column, first and last row, (K,) each, of stretches of pixels that a spot may hold.

    Two that are nearer to each other than twice _ROOM_PX are one.
    """
    # A grey value less than the threshold: the ground is of single precision.
    least = columns.min(axis=1) + max(threshold_dn - 1, 0.0)
    limit = np.minimum(least, columns.max()).astype(columns.dtype)
    column, row = np.divmod(np.flatnonzero(columns > limit[:, None]), columns.shape[1])
    last = np.flatnonzero((np.diff(column) > 0) | (np.diff(row) > 2 * _ROOM_PX))
    begin, end = np.append(0, last + 1)[: len(row)], np.append(last, len(row) - 1)[: len(row)]
    return column[begin], row[begin], row[end]


def brightest(column: Ints, light: Floats, most: int) -> Mask:
    """(K,) mask of the spots among the ``most`` of the most light of their column.

    Parameters
    ----------
    column : (K,) array, of the spots, rising
    light : (K,) array, what they are compared by
    most : int, of a column
    """
    if len(column) == 0 or np.bincount(column).max() <= most:
        return np.ones(len(column), dtype=bool)
    order = np.lexsort((-light, column))
    begin = np.searchsorted(column, column[order])  # of each spot's column, for they rise
    mask = np.zeros(len(column), dtype=bool)
    mask[order[np.arange(len(column)) - begin < most]] = True
    return mask


def pairs(column: Ints) -> tuple[Ints, Ints]:
    """All pairs of spots of one column, the first above the second.

    Parameters
    ----------
    column : (K,) array, of the spots, rising
    """
    if (np.diff(column) > 0).all():  # one in each column
        return column[:0], column[:0]
    first, second = _within(column, column, column)
    below = second > first
    return first[below], second[below]


def about(column: Ints, chosen: Ints) -> tuple[Ints, Ints]:
    """All pairs of one of the chosen spots and one in another column, at most GAP from it.

    Parameters
    ----------
    column : (K,) array, of the spots, rising
    chosen : (C,) array, indices among the K
    """
    here = column[chosen]
    first, second = _within(column, here - GAP, here + GAP)
    aside = column[second] != here[first]
    return chosen[first[aside]], second[aside]


def _within(column: Ints, least: Ints, most: Ints) -> tuple[Ints, Ints]:
    """Indices of all pairs of a range from ``least`` to ``most`` and a rising column in it."""
    begin, end = np.searchsorted(column, least), np.searchsorted(column, most, side="right")
    count = end - begin
    first = np.repeat(np.arange(len(least)), count)
    within = np.arange(len(first)) - np.repeat(np.cumsum(count) - count, count)
    return first, begin[first] + within


def runs_of(spots: Spots) -> Ints:
    """(K,) number of the run each spot belongs to.

    Two spots are linked where each is the other's nearest and their rows overlap, or would
    with one more row on either side for each column between them.

    Parameters
    ----------
    spots : Spots, px, K of them
    """
    count = len(spots.column)
    column, middle, height = spots.column, spots.middle, spots.height
    open_right, open_left = np.ones(count, dtype=bool), np.ones(count, dtype=bool)
    before = np.arange(count)  # the spot to the left that each is linked to; itself without one
    for apart in range(1, GAP + 1):
        left, right = np.flatnonzero(open_right), np.flatnonzero(open_left)
        wanted = column[left] + apart
        first, second = _within(column[right], wanted, wanted)
        if len(first) == 0:
            continue
        first, second = left[first], right[second]
        distance = np.abs(middle[first] - middle[second])
        near = distance <= (height[first] + height[second]) / 2 + apart
        first, second, distance = first[near], second[near], distance[near]
        mutual = _is_least(first, distance) & _is_least(second, distance)
        first, second = first[mutual], second[mutual]
        open_right[first], open_left[second] = False, False
        before[second] = first
    # Stretches of spots that are each linked to the one before in the list, then runs of these.
    begin = np.flatnonzero(before != np.arange(count) - 1)
    stretch = np.repeat(np.arange(len(begin)), np.diff(np.append(begin, count)))
    first_of = stretch[before[begin]]
    while (first_of[first_of] != first_of).any():  # on to the first of each run, in doubling steps
        first_of = first_of[first_of]
    number = np.cumsum(first_of == np.arange(len(begin))) - 1
    return number[first_of][stretch]


def _is_least(group: Ints, value: Floats) -> Mask:
    """Mask, same shape, of the first entry with the least value of its group."""
    if (np.diff(group) > 0).all():  # one in each
        return np.ones(len(group), dtype=bool)
    order = np.lexsort((value, group))
    _, first = np.unique(group[order], return_index=True)
    least = np.zeros(len(group), dtype=bool)
    least[order[first]] = True
    return least


def footprint(spots: Spots, over: Mask, shape: tuple[int, ...]) -> Mask:
    """Mask (W, H) of the spots marked in ``over``, and of their feet.

    At half its height a line is as high as its spot; one and a half times that to either side
    (3.5 standard deviations of a Gaussian) it is gone.  Between two spots of a column each has
    the half that is nearer to it.

    Parameters
    ----------
    spots : Spots, px, K of them
    over : (K,) mask
    shape : tuple of int, (W, H) of the columns
    """
    foot = np.ceil(1.5 * spots.height).astype(np.int64)
    low, high = np.maximum(spots.top - foot, 0), np.minimum(spots.bottom + foot + 1, shape[1])
    above = np.flatnonzero(np.diff(spots.column) == 0)  # the next spot is in the same column
    middle = (spots.bottom[above] + spots.top[above + 1] + 1) // 2
    high[above] = np.minimum(high[above], middle)
    low[above + 1] = np.maximum(low[above + 1], middle)
    edge = np.zeros((shape[0], shape[1] + 1), dtype=np.int8)
    np.add.at(edge, (spots.column[over], low[over]), 1)
    np.add.at(edge, (spots.column[over], high[over]), -1)
    return np.cumsum(edge[:, :-1], axis=1, dtype=np.int8) > 0
