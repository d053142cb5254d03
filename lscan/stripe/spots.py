"""Spots: where the columns of a picture cross what may be a line; runs: spots side by side."""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from lscan.records import Floats, Ints, Mask

GROUND_PX = 61
"""What is wider than this, along the column, is ground: four FWHM of 6 px lines."""

REACH_PX = 8
"""A spot is where the picture exceeds half of its highest value so near by."""

GAP = 4
"""Columns that speckle or a dark grain may take out of a run."""

_SMOOTHING_PX = 1.0  # as wide as a narrow line: speckle must not split a spot in two
MOST_SPOTS = 32
"""Of a column: those of the most light.  In a picture of noise each of thousands of rows may hold
one, and spots are compared in pairs."""


@dataclass(frozen=True)
class Relief:
    """What stands out of the columns of a picture.

    Attributes
    ----------
    columns : (W, H) array, DN, one column of the picture a row
    smoothed : (W, H) array, DN, the columns smoothed along themselves
    ground : (W, H) array, DN, what lies beneath the lines: the smoothed column after a grey-scale
        opening, its narrow peaks cut off
    """

    columns: Floats
    smoothed: Floats
    ground: Floats


def relief_of(columns: Floats, ground_px: int = GROUND_PX, sharp: bool = False) -> Relief:
    """The columns with the ground beneath their lines.

    Parameters
    ----------
    columns : (W, H) array, DN, one column of the picture a row
    ground_px : int, odd, px, what is wider along the column is ground
    """
    smoothed = cv2.GaussianBlur(
        columns.astype(np.float32), (0, 1), sigmaX=_SMOOTHING_PX, sigmaY=_SMOOTHING_PX
    )
    shown = columns.astype(np.float32) if sharp else smoothed
    ground = cv2.morphologyEx(shown, cv2.MORPH_OPEN, np.ones((1, ground_px), np.uint8))
    return Relief(columns, smoothed.astype(float), ground.astype(float))


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
    light = relief.smoothed - ground
    around = cv2.dilate(light.astype(np.float32), np.ones((1, 2 * REACH_PX + 1), np.uint8))
    inside = ((light > around / 2) & (light > threshold_dn / 4)).astype(np.uint8)
    # Speckle breaks the flanks of wide lines: gaps of two rows are closed.
    closed = cv2.morphologyEx(inside, cv2.MORPH_CLOSE, np.ones((1, 3), np.uint8))
    edge = np.diff(np.pad(closed, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    column, top = np.nonzero(edge == 1)
    bottom = np.nonzero(edge == -1)[1]  # one row further; both are in the same order
    height = columns.shape[1]
    bounds = np.column_stack([column * height + top, column * height + bottom]).ravel()
    above = np.append((columns - ground).ravel(), 0.0)  # so that the last bound is within it
    total = np.add.reduceat(above, bounds)[::2] if len(bounds) else np.zeros(0)
    peak = np.maximum.reduceat(above, bounds)[::2] if len(bounds) else np.zeros(0)
    high = np.flatnonzero(peak > threshold_dn)
    kept = high[brightest(column[high], total[high], MOST_SPOTS)]
    return Spots(column[kept], top[kept], bottom[kept] - 1, total[kept], peak[kept])


def brightest(column: Ints, light: Floats, most: int) -> Mask:
    """(K,) mask of the spots among the ``most`` of the most light of their column.

    Parameters
    ----------
    column : (K,) array, of the spots, rising
    light : (K,) array, what they are compared by
    most : int, of a column
    """
    order = np.lexsort((-light, column))
    begin = np.searchsorted(column, column[order])  # of each spot's column, for they rise
    mask = np.zeros(len(column), dtype=bool)
    mask[order[np.arange(len(column)) - begin < most]] = True
    return mask


def pairs(column: Ints, apart: int) -> tuple[Ints, Ints]:
    """All pairs of spots, the second ``apart`` columns to the right of the first.

    Parameters
    ----------
    column : (K,) array, of the spots, rising
    apart : int, columns; with 0 the first of a pair is above the second
    """
    begin = np.searchsorted(column, column + apart, side="left")
    begin = np.maximum(begin, np.arange(len(column)) + 1)
    end = np.searchsorted(column, column + apart, side="right")
    count = np.maximum(end - begin, 0)
    first = np.repeat(np.arange(len(column)), count)
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
    open_right, open_left = np.ones(count, dtype=bool), np.ones(count, dtype=bool)
    links: list[tuple[Ints, Ints]] = []
    for apart in range(1, GAP + 1):
        first, second = pairs(spots.column, apart)
        distance = np.abs(spots.middle[first] - spots.middle[second])
        near = distance <= (spots.height[first] + spots.height[second]) / 2 + apart
        near &= open_right[first] & open_left[second]
        first, second, distance = first[near], second[near], distance[near]
        mutual = _is_least(first, distance, count) & _is_least(second, distance, count)
        first, second = first[mutual], second[mutual]
        open_right[first], open_left[second] = False, False
        links.append((first, second))
    left, right = (np.concatenate(ends) for ends in zip(*links, strict=True))
    graph = coo_array((np.ones(len(left)), (left, right)), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)


def _is_least(group: Ints, value: Floats, count: int) -> Mask:
    """Mask, same shape, of the first entry with the least value of its group of ``count``."""
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
