"""Which line is meant where a column of the picture holds several.

A second laser, a mirror that shows the line again, a bright speck: each draws a line or a blob
of its own.  Every column is cut into the spots that stand out of it, spots of neighbouring
columns are linked into runs, and runs, not pixels, are chosen between.  The spots of the runs
not chosen are then painted over, so that an extractor that looks at one column at a time sees
one line in each.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from lscan.config.rig import StripeSection
from lscan.records import Floats, Ints, Mask, Status, Stripe, has_value

_SMOOTHING_PX = 1.0  # as wide as a narrow line: speckle must not split a spot in two
_REACH_PX = 8  # a spot is where the picture exceeds half of its highest value so near by
_GROUND_PX = 61  # what is wider than this, along the column, is ground: four FWHM of 6 px lines
_GAP = 4  # columns that speckle or a dark grain may take out of a run
_WEAKER = 0.35
"""Share of another line's light below which one is taken for a reflection of it.  Where two pieces
of one line succeed each other neither reflects the other, and a piece's last column, which blur
dims, shows where it ends: "first" and "last" then go by place alone."""
_MOST_SPOTS = 32
"""Of a column: those of the most light.  In a picture of noise each of thousands of rows may hold
one, and spots are compared in pairs."""
_SPECK = 2.0  # a blob no longer than so many times its height is no line
_LONGER = 3.0  # unless the other is no longer than so many times the blob
_MUCH_LONGER = 10.0  # a picture with a line has one so many times as long as an isolated blob
_TURNOVER = 8
"""Columns that two pieces of one line may share where one succeeds the other at a step: as far
as blur and an overhang reach.  There the brighter is taken column by column."""
_CLEARLY = 1.25
"""Ratio of light from which one run is the brighter.  The target's own shades and the fan's
change the light along a line by about as much, so of two nearer to each other chance decides."""


@dataclass(frozen=True)
class OneReturn:
    """A picture with one line in each column.

    Attributes
    ----------
    image : (H, W) array, DN, as given but for the other returns
    clipped : (H, W) mask, as given but for the other returns
    ambiguous : (W,) mask, of the columns with several lines of which none can be said to be the one
        meant
    """

    image: Floats
    clipped: Mask
    ambiguous: Mask


def choose_return(image: Floats, settings: StripeSection, clipped: Mask) -> OneReturn:
    """The picture with only the line meant by ``settings.returns`` left in each column.

    Columns with one line come back untouched, and so does the whole picture (not copied) where
    there is nothing to choose.

    A run no longer than twice its height beside one thrice as long is a speck; one with
    less than 0.35 of another's light, in the columns they share, is a reflection, unless the
    two share so few that they are pieces of one line that takes a step.  Of those left,
    "first" takes the uppermost, "last" the lowest, "brightest" the run with the most light in
    the shared columns, if it has 1.25 times that of the next: otherwise the columns are
    ambiguous.  A blob by itself, no longer than high, is no line even where there is no
    other, if the picture has a line ten times as long.  A line counts from ``threshold_dn``
    above the ground near it.

    Fast where ``image.T`` and ``clipped.T`` are contiguous in memory.

    Parameters
    ----------
    image : (H, W) array, DN, grey values
    settings : StripeSection, threshold and which line is meant
    clipped : (H, W) mask, of the pixels at the end of the range
    """
    columns = np.ascontiguousarray(image.T)
    smoothed, ground = _flattened(columns)
    spots = _spots(columns, smoothed, ground, settings.threshold_dn)
    run = _runs(spots)
    rejected = _isolated(spots, run)
    first, second = _pairs(spots.column, 0)
    if len(first) == 0 and not rejected.any():
        return OneReturn(image, clipped, np.zeros(len(columns), dtype=bool))
    there = ~rejected[first] & ~rejected[second]
    rejected |= _rejected(spots, run, first[there], second[there], settings)
    left = np.bincount(spots.column[~rejected], minlength=len(columns))
    ambiguous = left > 1
    over = _footprint(spots, rejected, columns.shape)
    painted = np.where(over, np.minimum(columns, ground), columns)
    return OneReturn(painted.T, (np.ascontiguousarray(clipped.T) & ~over).T, ambiguous)


def withhold(stripe: Stripe, ambiguous: Mask) -> Stripe:
    """The stripe without the values of the ambiguous columns, which say AMBIGUOUS.

    Parameters
    ----------
    stripe : Stripe, px, of W entries
    ambiguous : (W,) mask, of the columns
    """
    taken = ambiguous & has_value(stripe.status)
    return replace(
        stripe,
        centre_px=np.where(taken, np.nan, stripe.centre_px),
        sigma_px=np.where(taken, np.nan, stripe.sigma_px),
        status=np.where(taken, int(Status.AMBIGUOUS), stripe.status),
    )


@dataclass(frozen=True)
class _Spots:
    """Where the columns cross lines: K spots, column by column, each from the top.

    column: (K,).  top, bottom: (K,) first row and last, where it has half its light.
    light: (K,) sum of the grey values above the ground between them, in DN.
    """

    column: Ints
    top: Ints
    bottom: Ints
    light: Floats

    @property
    def height(self) -> Ints:
        """(K,) in px."""
        return self.bottom - self.top + 1

    @property
    def middle(self) -> Floats:
        """(K,) row."""
        return (self.top + self.bottom) / 2


def _flattened(columns: Floats) -> tuple[Floats, Floats]:
    """The columns (W, H) smoothed along themselves, and the ground beneath their lines, in DN.

    The ground is the smoothed column after a grey-scale opening: its narrow peaks cut off.
    """
    smoothed = cv2.GaussianBlur(
        columns.astype(np.float32), (0, 1), sigmaX=_SMOOTHING_PX, sigmaY=_SMOOTHING_PX
    )
    ground = cv2.morphologyEx(smoothed, cv2.MORPH_OPEN, np.ones((1, _GROUND_PX), np.uint8))
    return smoothed.astype(float), ground.astype(float)


def _spots(columns: Floats, smoothed: Floats, ground: Floats, threshold_dn: float) -> _Spots:
    """The spots of all columns (W, H) whose highest value exceeds the ground by the threshold."""
    light = smoothed - ground
    around = cv2.dilate(light.astype(np.float32), np.ones((1, 2 * _REACH_PX + 1), np.uint8))
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
    kept = high[_brightest(column[high], total[high])]
    return _Spots(column[kept], top[kept], bottom[kept] - 1, total[kept])


def _brightest(column: Ints, light: Floats) -> Mask:
    """(K,) mask of the spots among the _MOST_SPOTS of the most light of their column."""
    order = np.lexsort((-light, column))
    begin = np.searchsorted(column, column[order])  # of each spot's column, for they rise
    mask = np.zeros(len(column), dtype=bool)
    mask[order[np.arange(len(column)) - begin < _MOST_SPOTS]] = True
    return mask


def _pairs(column: Ints, apart: int) -> tuple[Ints, Ints]:
    """All pairs of spots, the second ``apart`` columns to the right of the first.

    column: (K,) of the spots, rising.  With ``apart`` 0 the first is above the second.
    """
    begin = np.searchsorted(column, column + apart, side="left")
    begin = np.maximum(begin, np.arange(len(column)) + 1)
    end = np.searchsorted(column, column + apart, side="right")
    count = np.maximum(end - begin, 0)
    first = np.repeat(np.arange(len(column)), count)
    within = np.arange(len(first)) - np.repeat(np.cumsum(count) - count, count)
    return first, begin[first] + within


def _runs(spots: _Spots) -> Ints:
    """(K,) number of the run each spot belongs to.

    Two spots are linked where each is the other's nearest and their rows overlap, or would
    with one more row on either side for each column between them.
    """
    count = len(spots.column)
    open_right, open_left = np.ones(count, dtype=bool), np.ones(count, dtype=bool)
    links: list[tuple[Ints, Ints]] = []
    for apart in range(1, _GAP + 1):
        first, second = _pairs(spots.column, apart)
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


def _isolated(spots: _Spots, run: Ints) -> Mask:
    """(K,) mask of the spots that are blobs by themselves: hot pixels, drifting particles.

    A run no longer than it is high in a picture with one that is ten times as long, unless it
    lies beside a run that is no blob: then it may be a piece of a steep wall.
    """
    if len(run) == 0:
        return np.zeros(0, dtype=bool)
    length = np.bincount(run)
    height = np.bincount(run, spots.height) / length
    blob = (length <= height) & (_MUCH_LONGER * length <= length.max())
    beside = np.zeros(len(length), dtype=bool)
    for apart in range(1, _GAP + 1):
        first, second = _pairs(spots.column, apart)
        between = np.abs(spots.middle[first] - spots.middle[second])
        near = between <= (spots.height[first] + spots.height[second]) / 2 + _REACH_PX
        a, b = run[first[near]], run[second[near]]
        beside[a] |= ~blob[b]
        beside[b] |= ~blob[a]
    return (blob & ~beside)[run]


def _is_least(group: Ints, value: Floats, count: int) -> Mask:
    """Mask, same shape, of the first entry with the least value of its group of ``count``."""
    order = np.lexsort((value, group))
    _, first = np.unique(group[order], return_index=True)
    least = np.zeros(len(group), dtype=bool)
    least[order[first]] = True
    return least


def _rejected(spots: _Spots, run: Ints, first: Ints, second: Ints, settings: StripeSection) -> Mask:
    """(K,) mask of the spots to which another one in their column is preferred.

    first, second: (P,) pairs of spots in the same column, the first above the second.
    """
    length = np.bincount(run)
    height = np.bincount(run, spots.height) / length
    # Each pair both ways round: a spot of run ``a`` and its rival of run ``b``.
    spot, rival = np.concatenate([first, second]), np.concatenate([second, first])
    a, b = run[spot], run[rival]
    # The light of either run in the columns that they share, or in each column by itself.
    _, pair = np.unique(a * len(length) + b, return_inverse=True)
    shared = np.bincount(pair)[pair]
    succeed = (shared <= _TURNOVER) & (2 * shared <= np.minimum(length[a], length[b]))
    own = np.where(succeed, spots.light[spot], np.bincount(pair, spots.light[spot])[pair])
    other = np.roll(own, len(first))
    speck = ~succeed & (length[a] <= _SPECK * height[a]) & (length[b] > _LONGER * length[a])
    by_light = ~succeed | (settings.returns == "brightest")
    weaker = ~np.roll(speck, len(first)) & by_light & (own < _WEAKER * other)
    rejected = np.zeros(len(run), dtype=bool)
    rejected[spot[speck | weaker]] = True
    if settings.returns == "brightest":
        yields = other >= _CLEARLY * own
    else:
        yields = np.repeat([settings.returns == "last", settings.returns == "first"], len(first))
    rejected[spot[yields & ~rejected[spot] & ~rejected[rival]]] = True
    return rejected


def _footprint(spots: _Spots, over: Mask, shape: tuple[int, int]) -> Mask:
    """Mask (W, H) of the spots marked in ``over`` (K,), and of their feet.

    At half its height a line is as high as its spot; one and a half times that to either side
    (3.5 standard deviations of a Gaussian) it is gone.  Between two spots of a column each has
    the half that is nearer to it.
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
