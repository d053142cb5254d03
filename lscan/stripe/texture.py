"""The laser's line among the texture of a lit target: chessboards, print, glare.

In the dark, what stands out of a column is the line or a reflection of it, and returns.py
chooses by light.  On a lit target white squares have more light than the line.  There a line is
told by what texture lacks: it is as narrow everywhere as the sharpest peaks of the picture are,
and goes on from column to column.
"""

import numpy as np
from scipy.ndimage import convolve1d, median_filter, uniform_filter1d

from lscan.config.rig import StripeSection
from lscan.records import Floats, GreyValues, Ints, Mask
from lscan.stripe.pieces import JUMP_PX
from lscan.stripe.ranks import medians
from lscan.stripe.spots import GAP, GROUND_PX, Relief, Spots, brightest, footprint, relief_of

_WIDE = 3.0
"""Times the line's width from which a spot is none of it.  A line as steep as JUMP_PX, beyond which
it is rather one of the rows, crosses its columns 3.2 times as wide."""

_SHARP = 1 / 3  # of the weight of each column's sharpest spots lies below the line's width
_GROUND_WIDTHS = 4  # the ground of spots.py, told from lines of the width that this picture has
_LEAST_GROUND_PX = 13
_SHARE = 0.02  # of the columns: more with texture are no accident
_CROWD = 3.0  # spots a column: more than a line, its reflection, and a speck
_LONG = 1 / 8  # of the picture: texture is in shorter runs

_MOST_RIVALS = 8  # spots a column that a path may go through
_ENOUGH = 0.35  # share of a line's light below which a spot is no rival of it, as in returns.py
_MISSED = 0.1  # what a column without a spot costs a path: less than any spot of the line gains
_NEIGHBOURS = 5
_SHORTEST = 8  # columns of a piece of a path: as far as a corner of a square reaches
_BEGIN = 12.0
"""What it costs to begin a path, or to jump: the gain of a dozen columns of line.  A piece of
texture as bright as the line would have to be as straight and as long to be taken for it."""

_BEND = np.array([1.0, -2.0, 1.0])
_BENDS = 9  # spots over which bends are averaged
_EVEN_PX, _EVEN = 1.3, 1 / 3
"""Mean bend of a path along a line, at most, in px and of its width.  Spots that scatter by half a
pixel bend by 1 px on the mean; those of noise, which JUMP_PX alone holds together, by 1.5 to 2."""

_SECOND = 0.5  # a second line is at least so many times as long as the first
_MOST_PATHS = 8


def line_width_px(spots: Spots) -> float:
    """Full width of the line at half its height, px, from the sharpest spot of each column.

    Sharpness is height in DN over width in px.  Of the widths of those spots, weighed by it, the
    lower third: where the line crosses a bright patch both are one, wider spot.

    Parameters
    ----------
    spots : Spots, px and DN; 60 if there are none
    """
    if len(spots.column) == 0:
        return float(GROUND_PX)
    sharpness = spots.peak / spots.height
    best = np.flatnonzero(brightest(spots.column, sharpness, 1))
    order = best[np.argsort(spots.height[best], kind="stable")]
    weight = sharpness[order].cumsum()
    return float(spots.height[order[np.searchsorted(weight, _SHARP * weight[-1])]])


def is_textured(
    columns: GreyValues, crest: Ints, spots: Spots, run: Ints, settings: StripeSection
) -> bool:
    """Whether the picture shows more than lines on a dark ground.

    It does where the ground itself would be taken for a line in some columns, where wide spots
    beside the line have more light, and where there is a crowd of spots, about as bright, in short
    runs.

    Parameters
    ----------
    columns : (W, H) array, DN, one column of the picture a row
    crest : (W,) array, px, row of the highest value of each
    spots : Spots, px and DN, K of them, on the usual ground
    run : (K,) array, numbers of the runs they belong to
    settings : StripeSection, threshold and the line's full width; without, that of the sharpest
        spots
    """
    width, least, threshold_dn = len(columns), _least(columns), settings.threshold_dn
    if _is_outshone(columns, crest, spots, threshold_dn):
        return True
    count = np.bincount(spots.column, minlength=width)
    several, every = np.count_nonzero(count > 1), np.count_nonzero(count)
    if several < least and len(spots.column) < _CROWD * every:
        return False
    width_px = settings.line_width_px or line_width_px(spots)
    wide = brightest(spots.column, spots.light, 1) & (spots.height > _WIDE * width_px + 1)
    wide &= spots.light > threshold_dn * spots.height  # a spot of noise has less
    if np.count_nonzero(wide & (count[spots.column] > 1)) >= least:
        return True
    most = np.zeros(width)
    np.maximum.at(most, spots.column, spots.light)
    strong = spots.light >= _ENOUGH * most[spots.column]
    crowd = strong.sum() >= _CROWD * every
    long = np.bincount(run)[run] >= _LONG * width
    return bool(crowd and 2 * (strong & long).sum() < strong.sum())


def _is_outshone(columns: GreyValues, crest: Ints, spots: Spots, threshold_dn: float) -> bool:
    """Whether the brightest pixels of many columns lie on bright ground, in no spot.

    There the ground exceeds the column's median by the threshold.
    """
    within = np.abs(spots.middle - crest[spots.column]) <= spots.height / 2 + 1
    beside = np.ones(len(columns), dtype=bool)
    beside[spots.column[within]] = False
    at = np.flatnonzero(beside)
    # The ground lies between the least and the highest pixel.
    at = at[columns[at, crest[at]] - columns[at].min(axis=1) >= threshold_dn]
    if len(at) < _least(columns):
        return False
    ground = relief_of(columns[at]).ground
    here = ground[np.arange(len(at)), crest[at]]
    beneath = np.maximum(ground.min(axis=1), medians(columns[at]))
    return bool(np.count_nonzero(here - beneath > threshold_dn) >= _least(columns))


def _least(columns: GreyValues) -> float:
    """Columns with texture that are no accident."""
    return max(_SHARE * len(columns), 2)


def ground_px(width_px: float) -> int:
    """Odd number of pixels from which on, along a column, light is ground to a line.

    Parameters
    ----------
    width_px : float, px, full width of the line
    """
    fitting = 2 * int(_GROUND_WIDTHS * width_px / 2) + 1
    return min(max(fitting, _LEAST_GROUND_PX), GROUND_PX)


def paths_of(spots: Spots, shape: tuple[int, ...], width_px: float) -> Ints:
    """(K,) number of the line that a spot belongs to, from 0 the best; -1: to none.

    A path goes through one spot of a column.  It gains by the spots' light, in units of the
    line's, and loses by what it moves from one column to the next; of all paths the one of the
    highest sum is found by dynamic programming.  Then the next through the spots left, as long as
    it is half as long as the first.

    Parameters
    ----------
    spots : Spots, px and DN, K of them
    shape : tuple of int, (W, H) of the columns; a spot at their ends is not whole
    width_px : float, px, full width of the line
    """
    count, height = shape
    path = np.full(len(spots.column), -1)
    whole = (spots.top > 0) & (spots.bottom < height - 1)
    free = np.flatnonzero(whole & (spots.height <= _WIDE * width_px + 1))
    if len(free) == 0:
        return path
    first = brightest(spots.column[free], spots.peak[free], 1)
    unit = float(np.median(spots.peak[free[first]]))
    length = count_of_pieces = 0
    for _ in range(_MOST_PATHS):
        best, piece = _pieces(spots, _best_path(spots, free, unit, count), width_px)
        if len(best) == 0 or len(best) < _SECOND * length:
            break
        path[best] = count_of_pieces + piece
        length = max(length, len(best))
        count_of_pieces += int(piece.max()) + 1
        free = free[path[free] < 0]
        if len(free) == 0:
            break
    return path


def _best_path(spots: Spots, free: Ints, unit: float, count: int) -> Ints:
    """Indices of the spots on the best path through those that are free.

    unit: light of a spot of the line, DN.  count: columns of the picture.
    """
    free = free[brightest(spots.column[free], spots.peak[free], _MOST_RIVALS)]
    gain = np.sqrt(np.minimum(spots.peak[free] / unit, 1.0)) - _ENOUGH
    table = _by_column(spots.column[free], count)
    rows = spots.middle[free][table]
    gains = np.where(table >= 0, gain[table], -np.inf)
    score, back = np.full(table.shape, -np.inf), np.full(table.shape, -1)
    rivals = table.shape[1]
    apart = np.arange(GAP, 0, -1)[:, None, None]
    top_score, top = 0.0, -1
    for i in np.flatnonzero((table >= 0).any(axis=1)):
        step = (rows[i] - rows[i - GAP : i, :, None]) / (JUMP_PX * apart)
        reached = (
            score[i - GAP : i, :, None] - np.minimum(np.abs(step), _BEGIN) - _MISSED * (apart - 1)
        )
        reached = reached.reshape(-1, rivals)
        before = reached.argmax(axis=0)
        value = reached[before, np.arange(rivals)]
        goes_on = value > top_score - _BEGIN
        score[i] = gains[i] + np.where(goes_on, value, top_score - _BEGIN)
        back[i] = np.where(goes_on, (i - GAP) * rivals + before, top)
        here = int(score[i].argmax())
        if score[i, here] > top_score:
            top_score, top = float(score[i, here]), int(i) * rivals + here
    followed: list[int] = []
    while top >= 0:
        followed.append(int(table.flat[top]))
        top = int(back.flat[top])
    return free[np.array(followed[::-1], dtype=np.int64)]


def _pieces(spots: Spots, path: Ints, width_px: float) -> tuple[Ints, Ints]:
    """The spots of a path and the number of the piece, between two jumps, that each belongs to.

    Those of pieces too short to be known from texture are left out, and those that lie off their
    neighbours on the path by more than the line's width: there it steps aside onto texture.  So are
    stretches that bend to and fro from spot to spot, as paths through noise do.
    """
    if len(path) == 0:
        return path, path
    row = spots.middle[path]
    path = path[np.abs(row - median_filter(row, _NEIGHBOURS, mode="nearest")) <= width_px]
    bend = np.minimum(np.abs(convolve1d(spots.middle[path], _BEND)), JUMP_PX)  # a jump is no noise
    path = path[uniform_filter1d(bend, _BENDS) <= max(_EVEN_PX, _EVEN * width_px)]
    column, row = spots.column[path], spots.middle[path]
    apart = np.diff(column)
    jumps = np.abs(np.diff(row)) > JUMP_PX * np.minimum(apart, GAP)
    piece = np.append(0, np.cumsum(jumps))[: len(path)]
    whole = np.bincount(piece)[piece] >= _SHORTEST
    return path[whole], piece[whole]


def _by_column(column: Ints, count: int) -> Ints:
    """(GAP + W, M) indices of the spots of each column, -1 where there are fewer than M."""
    rank = np.arange(len(column)) - np.searchsorted(column, column)
    table = np.full((count + GAP, int(rank.max()) + 1), -1)
    table[column + GAP, rank] = np.arange(len(column))
    return table


def flattened(relief: Relief, spots: Spots, kept: Mask, threshold_dn: float) -> tuple[Floats, Mask]:
    """(W, H) columns with their kept spots on an even ground, DN, and the spots' footprints.

    Within the footprint of a kept spot the ground is taken off, elsewhere all but the pixels'
    noise, by which extractors judge; the level is the ground's beneath the spot.

    Parameters
    ----------
    relief : Relief, DN
    spots : Spots, px, K of them
    kept : (K,) mask
    threshold_dn : float, DN; noise remains up to a quarter of it
    """
    columns, ground = relief.columns, relief.ground.astype(np.float64)
    level = np.median(ground, axis=1)
    middle = spots.middle.astype(np.int64)
    level[spots.column[kept]] = ground[spots.column[kept], middle[kept]]
    near = footprint(spots, kept, columns.shape)
    noise = np.clip(
        columns - relief.smoothed.astype(np.float64), -threshold_dn / 4, threshold_dn / 4
    )
    return level[:, None] + np.where(near, columns - ground, noise), near
