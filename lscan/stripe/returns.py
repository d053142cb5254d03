"""Which line is meant where a column holds several, and among the texture of a lit target.

In the dark, what stands out of a column is the line or a reflection of it, and returns.py
chooses by light.  On a lit target white squares have more light than the line.  There a line is
told by what texture lacks: it is as narrow everywhere as the sharpest peaks of the picture are,
and goes on from column to column.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import convolve1d, uniform_filter1d

from lscan.config.rig import StripeSection
from lscan.records import Floats, GreyValues, Ints, Mask, Status, Stripe, has_value, select
from lscan.stripe.loops.spots import best_path
from lscan.stripe.peaks import (
    GAP,
    GROUND_PX,
    JUMP_PX,
    REACH_PX,
    Relief,
    Spots,
    about,
    brightest,
    crests,
    footprint,
    medians,
    pairs,
    relief_of,
    running_median,
    runs_of,
    smoothed_by_width,
    spots_of,
)

# The laser's line among the texture of a lit target: chessboards, print, glare.

_WIDE = 3.0
"""Times the line's width from which a spot is none of it.  A line as steep as JUMP_PX, beyond which
it is rather one of the rows, crosses its columns 3.2 times as wide."""

_SHARP = 1 / 3  # of the weight of each column's sharpest spots lies below the line's width
_GROUND_WIDTHS = 4  # the ground of peaks.py, told from lines of the width that this picture has
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
    height = shape[1]
    path = np.full(len(spots.column), -1)
    whole = (spots.top > 0) & (spots.bottom < height - 1)
    free = np.flatnonzero(whole & (spots.height <= _WIDE * width_px + 1))
    if len(free) == 0:
        return path
    first = brightest(spots.column[free], spots.peak[free], 1)
    unit = float(np.median(spots.peak[free[first]]))
    length = count_of_pieces = 0
    for _ in range(_MOST_PATHS):
        best, piece = _pieces(spots, _best_path(spots, free, unit), width_px)
        if len(best) == 0 or len(best) < _SECOND * length:
            break
        path[best] = count_of_pieces + piece
        length = max(length, len(best))
        count_of_pieces += int(piece.max()) + 1
        free = free[path[free] < 0]
        if len(free) == 0:
            break
    return path


def _best_path(spots: Spots, free: Ints, unit: float) -> Ints:
    """Indices of the spots on the best path through those that are free.

    unit: light of a spot of the line, DN.
    """
    free = free[brightest(spots.column[free], spots.peak[free], _MOST_RIVALS)]
    gain = np.sqrt(np.minimum(spots.peak[free] / unit, 1.0)) - _ENOUGH
    path = best_path(spots.column[free], spots.middle[free], gain, GAP, JUMP_PX, _BEGIN, _MISSED)
    return free[path]


def _pieces(spots: Spots, path: Ints, width_px: float) -> tuple[Ints, Ints]:
    """The spots of a path and the number of the piece, between two jumps, that each belongs to.

    Those of pieces too short to be known from texture are left out, and those that lie off their
    neighbours on the path by more than the line's width: there it steps aside onto texture.  So are
    stretches that bend to and fro from spot to spot, as paths through noise do.
    """
    if len(path) == 0:
        return path, path
    row = spots.middle[path]
    path = path[np.abs(row - running_median(row, _NEIGHBOURS)) <= width_px]
    bend = np.minimum(np.abs(convolve1d(spots.middle[path], _BEND)), JUMP_PX)  # a jump is no noise
    path = path[uniform_filter1d(bend, _BENDS) <= max(_EVEN_PX, _EVEN * width_px)]
    column, row = spots.column[path], spots.middle[path]
    apart = np.diff(column)
    jumps = np.abs(np.diff(row)) > JUMP_PX * np.minimum(apart, GAP)
    piece = np.append(0, np.cumsum(jumps))[: len(path)]
    whole = np.bincount(piece)[piece] >= _SHORTEST
    return path[whole], piece[whole]


def flatten(relief: Relief, spots: Spots, kept: Mask, threshold_dn: float) -> tuple[Floats, Mask]:
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


# Which line is meant where a column of the picture holds several.
#
# A second laser, a mirror that shows the line again, a bright speck: each draws a line or a blob of
# its own.  Every column is cut into the spots that stand out of it (peaks.py), spots of
# neighbouring columns are linked into runs, and runs, not pixels, are chosen between.  The spots of
# the runs not chosen are then painted over, so that an extractor that looks at one column at a time
# sees one line in each.  On a lit target, whose texture stands out as well, they are chosen between
# on an even ground (below).


_WEAKER = 0.35
"""Share of another line's light below which one is taken for a reflection of it.  Where two pieces
of one line succeed each other neither reflects the other, and a piece's last column, which blur
dims, shows where it ends: "first" and "last" then go by place alone."""
_SPECK = 2.0  # a blob no longer than so many times its height is no line
_LONGER = 3.0  # unless the other is no longer than so many times the blob
_SPECKED = 0.25  # of the columns: where fewer hold specks, the run that is long goes on beside them
_RIVALS = 0.02  # spots beside others, of the columns: more are no accident
_MUCH_LONGER = 10.0  # a picture with a line has one so many times as long as an isolated blob
_TURNOVER = 8
"""Columns that two pieces of one line may share where one succeeds the other at a step: as far
as blur and an overhang reach.  There the brighter is taken column by column."""
_CLEARLY = 1.25
"""Ratio of light from which one run is the brighter.  The target's own shades and the fan's
change the light along a line by about as much, so of two nearer to each other chance decides."""
_SECOND_LINE = 0.25
"""Share of the columns with a line that must hold two for the picture to have two lines: fewer do
where one line overhangs itself."""
_MOSTLY = 0.8  # of its columns, in which a run is the line meant, or is not
_NEARER = 2.0  # times that a lone run is nearer to the one line than to the other


@dataclass(frozen=True)
class OneReturn:
    """A picture with one line in each column.

    Attributes
    ----------
    image : (H, W) array, DN, as given but for the other returns; floats where those are painted
        over, as a rule of single precision, in which a camera's grey values are exact
    crest : (W,) array, px, row of the highest value of each column of ``image``
    clipped : (H, W) mask, as given but for the other returns
    ambiguous : (W,) mask, of the columns with several lines of which none can be said to be the one
        meant
    textured : bool, whether the picture shows a lit target, on which ``image`` is made even
    """

    image: GreyValues
    crest: Ints
    clipped: Mask
    ambiguous: Mask
    textured: bool = False


def choose_return(
    image: GreyValues, settings: StripeSection, clipped: Mask, white: bool = False
) -> OneReturn:
    """The picture with only the line meant by ``settings.returns`` left in each column.

    Columns with one line come back untouched, and so does the whole picture (not copied) where
    there is nothing to choose.

    A run no longer than twice its height beside one thrice as long is a speck; one with
    less than 0.35 of another's light, in the columns they share, is a reflection, unless the
    two share so few that they are pieces of one line that takes a step.  Of those left,
    "first" takes the uppermost, "last" the lowest, "brightest" the run with the most light in
    the shared columns, if it has 1.25 times that of the next and that is not thrice as long:
    otherwise the columns are ambiguous.  A blob by itself, no longer than high, is no line even
    where there is no other, if the picture has a line ten times as long.  A line counts from
    ``threshold_dn`` above the ground near it.

    With "first" and "last" in a picture of two lines or more, a spot in a column that lacks one of
    them is given to the line that its run belongs to where all are seen, or that it lies nearer to;
    it is ambiguous where that is not clear.

    On a lit target (below), and where "first" or "last" would often be a speck, the runs are
    the narrow lines that go on from column to column, and each column is laid on an even ground.

    Fast where ``image.T`` and ``clipped.T`` are contiguous in memory.

    Parameters
    ----------
    image : (H, W) array, DN, grey values
    settings : StripeSection, threshold and which line is meant
    clipped : (H, W) mask, of the pixels at the end of the range
    white : bool, whether the picture shows white crests: between coloured things the lamps' own
        light looks like one, and light does not tell the line
    """
    columns = np.ascontiguousarray(image.T)
    crest, count = crests(columns), len(columns)
    spots = spots_of(columns, settings.threshold_dn)
    run = runs_of(spots)
    specked = settings.returns != "brightest" and _is_specked(spots, run)
    rivals = np.count_nonzero(np.diff(spots.column) == 0)
    doubtful = white and rivals >= _RIVALS * count
    if doubtful or specked or is_textured(columns, crest, spots, run, settings):
        return _line_in_texture(columns, spots, settings, clipped)
    stated_px = settings.line_width_px
    smoothed = smoothed_by_width(columns, stated_px)
    if smoothed is not columns:
        spots = spots_of(columns, settings.threshold_dn, width_px=stated_px)
        run, crest = runs_of(spots), crests(smoothed)
    choice = _choose(spots, run, _isolated_spots(spots, run), settings)
    if not choice.rejected.any():
        return OneReturn(image, crest, clipped, choice.ambiguous(count))
    at, lost = np.unique(spots.column[choice.rejected]), clipped.T.copy()
    painted = columns.astype(np.result_type(columns, np.float32))
    here = np.flatnonzero(np.isin(spots.column, at))
    there = replace(select(spots, here), column=np.searchsorted(at, spots.column[here]))
    over = footprint(there, choice.rejected[here], (len(at), columns.shape[1]))
    ground = relief_of(columns[at], width_px=stated_px).ground
    painted[at] = np.where(over, np.minimum(columns[at], ground), columns[at])
    lost[at] &= ~over
    crest[at] = crests(smoothed_by_width(painted[at], stated_px))
    return OneReturn(painted.T, crest, lost.T, choice.ambiguous(count))


def _line_in_texture(
    columns: GreyValues, seen: Spots, settings: StripeSection, clipped: Mask
) -> OneReturn:
    """The same on a lit target: the line meant on an even ground in each column.

    seen: the spots on the usual ground.  Columns whose ground is even and hold that line alone
    stay as they are.
    """
    count, threshold_dn = len(columns), settings.threshold_dn
    width_px = settings.line_width_px or line_width_px(seen)
    stated_px, size_px = settings.line_width_px, ground_px(width_px)
    relief = relief_of(columns, size_px, sharp=True, width_px=stated_px)
    spots = spots_of(columns, threshold_dn, size_px, sharp=True, width_px=stated_px)
    path = paths_of(spots, columns.shape, width_px)
    kept = path >= 0
    lines = select(spots, kept)
    run = np.unique(path[kept], return_inverse=True)[1]
    choice = _choose(lines, run, np.zeros(len(run), dtype=bool), settings)
    kept[kept] = ~choice.rejected
    ground = relief_of(columns, width_px=stated_px).ground
    even = np.ptp(ground, axis=1) <= threshold_dn / 2
    left = np.bincount(spots.column[kept], minlength=count)
    even &= (np.bincount(seen.column, minlength=count) == left) & (left <= 1)
    flat, near = flatten(relief, spots, kept, threshold_dn)
    near |= even[:, None]
    image = np.where(even[:, None], columns, flat)
    return OneReturn(
        image=image.T,
        crest=crests(smoothed_by_width(image, stated_px)),
        clipped=(np.ascontiguousarray(clipped.T) & near).T,
        ambiguous=choice.ambiguous(count),
        textured=True,
    )


def withhold(stripe: Stripe, columns: Mask, status: Status = Status.AMBIGUOUS) -> Stripe:
    """The stripe without the values of some columns, which say why.

    Parameters
    ----------
    stripe : Stripe, px, of W entries
    columns : (W,) mask, of the columns
    status : Status, what those of them say that have a value
    """
    if not columns.any():
        return stripe
    taken = columns & has_value(stripe.status)
    return replace(
        stripe,
        centre_px=np.where(taken, np.nan, stripe.centre_px),
        sigma_px=np.where(taken, np.nan, stripe.sigma_px),
        status=np.where(taken, int(status), stripe.status),
        flux=None if stripe.flux is None else np.where(taken, np.nan, stripe.flux),
    )


def _is_specked(spots: Spots, run: Ints) -> bool:
    """Whether many columns hold specks as bright as the line: first or last would often be one."""
    if not (np.diff(spots.column) == 0).any():
        return False
    length = np.bincount(run)
    speck = (length <= _SPECK * np.bincount(run, spots.height) / length)[run]
    most = np.zeros(spots.column.max() + 1)
    np.maximum.at(most, spots.column[~speck], spots.light[~speck])
    rival = speck & (most > 0)[spots.column] & (spots.light >= _WEAKER * most[spots.column])
    return len(np.unique(spots.column[rival])) > _SPECKED * len(np.unique(spots.column))


def _isolated_spots(spots: Spots, run: Ints) -> Mask:
    """(K,) mask of the spots that are blobs by themselves: hot pixels, drifting particles.

    A run no longer than it is high in a picture with one that is ten times as long, unless it
    lies beside a run that is no blob: then it may be a piece of a steep wall.
    """
    if len(run) == 0:
        return np.zeros(0, dtype=bool)
    length = np.bincount(run)
    height = np.bincount(run, spots.height) / length
    blob = (length <= height) & (_MUCH_LONGER * length <= length.max())
    if not blob.any():
        return np.zeros(len(run), dtype=bool)
    first, second = about(spots.column, np.flatnonzero(blob[run]))
    between = np.abs(spots.middle[first] - spots.middle[second])
    near = between <= (spots.height[first] + spots.height[second]) / 2 + REACH_PX
    blob[run[first[near & ~blob[run[second]]]]] = False
    return blob[run]


@dataclass(frozen=True)
class _Choice:
    """Which of K spots are not the line meant, and of which of the others that is not known."""

    spots: Spots
    rejected: Mask
    unsure: Mask

    def ambiguous(self, count: int) -> Mask:
        """(W,) columns in which several spots are left, or one of which it is not known."""
        kept = ~self.rejected
        mask = np.bincount(self.spots.column[kept], minlength=count) > 1
        mask[self.spots.column[kept & self.unsure]] = True
        return mask


def _choose(spots: Spots, run: Ints, rejected: Mask, settings: StripeSection) -> _Choice:
    """The choice between the spots (K,) of some runs; rejected: (K,) those out of question."""
    first, second = pairs(spots.column)
    there = ~rejected[first] & ~rejected[second]
    first, second = first[there], second[there]
    faint, yielding = _rejected_spots(spots, run, first, second, settings)
    rejected = rejected | faint | yielding
    unsure = np.zeros(len(run), dtype=bool)
    if settings.returns != "brightest":
        other, unsure = _told_apart(spots, run, rejected, yielding, settings.returns == "first")
        rejected |= other
    return _Choice(spots, rejected, unsure)


def _told_apart(
    spots: Spots, run: Ints, rejected: Mask, yielding: Mask, first: bool
) -> tuple[Mask, Mask]:
    """(K,) spots in columns that lack a line that are of another one, and those that may be.

    A picture has as many lines as are seen together in a quarter of its columns.

    yielding: (K,) spots that yielded to the line meant, which is the first or the last.
    """
    none = np.zeros(len(run), dtype=bool)
    shown = np.bincount(spots.column, ~rejected | yielding)
    columns = len(np.unique(spots.column))
    lines = np.sort(shown)[::-1][int(_SECOND_LINE * columns)] if columns else 0
    if lines < 2:
        return none, none
    both = shown[spots.column] >= lines
    meant = both & ~rejected
    yielding = both & yielding
    won, lost = np.bincount(run, meant), np.bincount(run, yielding)
    known = won + lost > 0
    share = np.divide(won, won + lost, out=np.full(len(won), 0.5), where=known)
    nearer = _nearness(spots, run, meant, yielding, first)
    other = np.where(known, share < 1 - _MOSTLY, nearer > _NEARER)
    sure = np.where(known, share > _MOSTLY, nearer < 1 / _NEARER)
    alone = ~both & ~rejected
    return alone & other[run], alone & ~(other | sure)[run]


def _nearness(spots: Spots, run: Ints, meant: Mask, other: Mask, first: bool) -> Floats:
    """(R,) how much farther each run is from the line meant than from the other, on the median.

    Both lines are interpolated linearly between the columns in which they are known.
    """
    lines = []
    for line in (meant, other):
        at = np.flatnonzero(line)
        at = at if first else at[::-1]  # of several others the one next to the line meant
        column, place = np.unique(spots.column[at], return_index=True)
        lines.append(np.interp(spots.column, column, spots.middle[at[place]]))
    near, far = (np.abs(spots.middle - line) for line in lines)
    ratio = near / np.maximum(far, 0.5)
    order = np.lexsort((ratio, run))
    begin = np.searchsorted(run[order], np.arange(run.max() + 1))
    return ratio[order][begin + np.bincount(run) // 2]


def _rejected_spots(
    spots: Spots, run: Ints, first: Ints, second: Ints, settings: StripeSection
) -> tuple[Mask, Mask]:
    """(K,) spots that are faint or specks beside another, and those that yield to the one meant.

    first, second: (P,) pairs of spots in the same column, the first above the second.
    """
    faint, yielding = np.zeros(len(run), dtype=bool), np.zeros(len(run), dtype=bool)
    if len(first) == 0:
        return faint, yielding
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
    faint[spot[speck | weaker]] = True
    if settings.returns == "brightest":
        # What is short and no brighter than a reflection is weaker may be one: the long line that
        # goes on beneath it does not yield.  Where two are seen in many other columns too, it is
        # a part of the brighter one.
        beside = np.bincount(run[np.append(first, second)], minlength=len(length))
        paired = len(np.unique(spots.column[first])) - beside[b]
        goes_on = (length[a] > _LONGER * length[b]) & (own >= _WEAKER * other)
        goes_on &= paired <= _SECOND_LINE * len(np.unique(spots.column))
        yields = (other >= _CLEARLY * own) & ~goes_on
    else:
        yields = np.repeat([settings.returns == "last", settings.returns == "first"], len(first))
    yielding[spot[yields & ~faint[spot] & ~faint[rival]]] = True
    return faint, yielding
