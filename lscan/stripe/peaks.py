"""What the columns of a picture hold: their peaks, and spots that may be a line."""

from dataclasses import dataclass, replace
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from lscan.config.rig import StripeSection
from lscan.records import Floats, GreyValues, Ints, Mask, Singles, Status, Stripe, has_value, select
from lscan.stripe.loops.scatter import pieces_of, running_medians, total_profile
from lscan.stripe.loops.spots import crests_of, find_spots, linked_runs, order_statistics

# Values of a rank in the columns of a picture: the highest, and the median.


def crests(columns: GreyValues) -> Ints:
    """(W,) row of the highest value of each column, the first of several equal ones.

    Parameters
    ----------
    columns : (W, H) array, DN, one column of the picture a row

    Examples
    --------
    >>> crests(np.array([[7, 3, 200, 200]], dtype=np.uint8))
    array([2])
    """
    whole = np.issubdtype(columns.dtype, np.integer)
    return crests_of(columns) if whole else columns.argmax(axis=1)


def order_statistic(columns: GreyValues, rank: int) -> Floats:
    """(W,) DN, of each column the value that ``rank`` of its pixels come before in rising order.

    Parameters
    ----------
    columns : (W, H) array, DN, one column of the picture a row; floats are rounded to single
        precision, in which a camera's grey values are exact
    rank : int, 0 for the lowest, below H

    Examples
    --------
    >>> order_statistic(np.array([[7, 3, 200, 3]], dtype=np.uint8), 2)
    array([7.])
    """
    if not np.issubdtype(columns.dtype, np.integer):
        return _float_order_statistic(columns.astype(np.float32, copy=False), rank)
    return order_statistics(columns, rank, int(columns.min()), int(columns.max()))


def _float_order_statistic(columns: Singles, rank: int) -> Floats:
    """The same of floats: of columns that hold grey values alone by counting these."""
    with np.errstate(invalid="ignore"):
        grey = columns.astype(np.uint8 if columns.min() >= 0 else np.int16)
    whole = (grey == columns).all(axis=1)
    values, others = np.empty(len(columns)), columns[~whole]
    values[~whole] = np.partition(others, rank, axis=1)[:, rank]
    if whole.any():
        values[whole] = order_statistic(grey[whole], rank)
    return values


def medians(columns: GreyValues) -> Floats:
    """(W,) DN, the median of each column, of two in the middle their mean.

    Parameters
    ----------
    columns : (W, H) array, DN, as :func:`order_statistic` takes them

    Examples
    --------
    >>> medians(np.array([[7, 3, 200, 3]], dtype=np.uint8))
    array([5.])
    """
    if not np.issubdtype(columns.dtype, np.integer):
        columns = columns.astype(np.float32)
    half = columns.shape[1] // 2
    upper = order_statistic(columns, half)
    if columns.shape[1] % 2:
        return upper
    below = columns < upper.astype(columns.dtype)[:, None]
    apart = np.flatnonzero(np.count_nonzero(below, axis=1) == half)  # the lower one is less
    lower = upper.copy()
    lower[apart] = np.where(below[apart], columns[apart], columns.min()).max(axis=1)
    return (lower + upper) / 2


def running_median(values: Floats, count: int) -> Floats:
    """(N,) median of each value and its neighbours; the end values stand for those beyond them.

    Parameters
    ----------
    values : (N,) array, of any unit
    count : int, odd, of the values that each median is of; it may exceed N

    Examples
    --------
    >>> running_median(np.array([1.0, 9.0, 2.0, 3.0]), 3)
    array([1., 2., 3., 3.])
    """
    return running_medians(values.astype(float), count // 2) if values.size else values


# Which columns of a picture have a line in them, and at which pixel it peaks.


_Value = TypeVar("_Value", bound=np.generic)


@dataclass(frozen=True)
class Peaks:
    """The columns that have a whole line in them: K of W.

    Attributes
    ----------
    columns : (K,) array, their indices
    rows : (K,) array, px, row of the nominal peak
    base : (K,) array, DN, the column's background, its median
    """

    columns: Ints
    rows: Ints
    base: Floats


def nominal_peaks(columns: GreyValues, settings: StripeSection) -> tuple[Stripe, Peaks]:
    """A stripe with peaks and statuses but no centres yet, and the columns that have a line.

    A column has a line where its highest value, the first maximum from the top, exceeds its
    median by more than ``threshold_dn``: NO_PEAK otherwise, AT_BORDER where ``span_px`` to
    either side do not fit the picture.  Highest is meant of the column smoothed as
    :func:`smoothed_by_width` does where the line's width is stated.

    Parameters
    ----------
    columns : (W, H) array, DN, one column of the picture a row
    settings : StripeSection, threshold and span

    References
    ----------
    Sec. V.B of the paper.
    """
    height = columns.shape[1]
    smoothed = smoothed_by_width(columns, settings.line_width_px)
    rows = crests(smoothed)
    base = order_statistic(columns, height // 2)
    peak = smoothed[np.arange(len(rows)), rows] - base
    width = len(rows)
    border = (rows < settings.span_px) | (rows >= height - settings.span_px)
    status = np.full(width, int(Status.OK), dtype=np.int64)
    status[border] = Status.AT_BORDER
    status[peak <= settings.threshold_dn] = Status.NO_PEAK
    empty = np.full(width, np.nan)
    stripe = Stripe("columns", empty, empty.copy(), peak, status)
    found = np.flatnonzero(status == Status.OK)
    return stripe, Peaks(found, rows[found], base[found])


def clipped_middles(clipped: Mask, peaks: Peaks) -> tuple[Floats, Ints]:
    """(K,) px, the middles of the clipped pixels about the peaks, and how many there are.

    The peak itself, and 0, where it is not clipped.

    Parameters
    ----------
    clipped : (W, H) mask, one column of the picture a row
    peaks : Peaks, of K of the columns
    """
    middles, count = peaks.rows.astype(float), np.zeros(len(peaks.rows), dtype=int)
    at = np.flatnonzero(clipped[peaks.columns, peaks.rows])
    dark, place = ~clipped[peaks.columns[at]], np.arange(clipped.shape[1])
    rows = peaks.rows[at, None]
    first = np.where(dark & (place < rows), place, -1).max(axis=1) + 1
    last = np.where(dark & (place > rows), place, len(place)).min(axis=1) - 1
    middles[at], count[at] = (first + last) / 2, last - first + 1
    return middles, count


def smoothing_px(width_px: float | None) -> float:
    """Standard deviation over which the columns of a wide line are smoothed: half the line's own.

    0 where no width is stated, and where that is less than the pixel over which every line is
    smoothed when it is told from its ground.

    Parameters
    ----------
    width_px : float or None, px, full width of the line at half its height, as it is stated
    """
    sigma_px = (width_px or 0.0) / (2 * FWHM)
    return sigma_px if sigma_px > _SMOOTHING_PX else 0.0


def smoothed_by_width(columns: GreyValues, width_px: float | None) -> GreyValues:
    """The columns (W, H) smoothed along themselves where a wide line's width is stated.

    Speckle then neither splits the line nor has a crest of its own; a Gaussian line is wider by an
    eighth.  Else the columns come back as they are.

    Parameters
    ----------
    columns : (W, H) array, DN, one column of the picture a row
    width_px : float or None, px, as :func:`smoothing_px` takes it
    """
    sigma_px = smoothing_px(width_px)
    if not sigma_px:
        return columns
    single = columns.astype(np.float32)
    return np.asarray(cv2.GaussianBlur(single, (0, 1), sigmaX=sigma_px), np.float32)


def all_windows(columns: NDArray[_Value], length: int) -> NDArray[_Value]:
    """(W, H - n + 1, n) view of all windows of n pixels, in a tenth of the time of NumPy's own.

    Parameters
    ----------
    columns : (W, H) array, one column of the picture a row
    length : int, n, at most H
    """
    columns = np.ascontiguousarray(columns)
    (width, height), (across, along) = columns.shape, columns.strides
    shape, strides = (width, height - length + 1, length), (across, along, along)
    every = np.ndarray(shape, columns.dtype, columns.data, strides=strides)
    every.flags.writeable = False
    return every


def windows(columns: NDArray[Any], at: Ints, rows: Ints, steps: Ints | int) -> Floats:
    """Pixels (K, n) of some columns about a row of each; beyond an edge its pixel is repeated.

    Parameters
    ----------
    columns : (W, H) array, one column of the picture a row, of any type; of a mask 0 and 1 come
    at : (K,) array, indices of the columns
    rows : (K,) array, px, the middle row of each
    steps : (n,) array or int, px, from the middle row; an integer: up to so many to either side
    """
    height = columns.shape[1]
    if isinstance(steps, int):
        begin, end = rows - steps, rows + steps
        if len(rows) and begin.min() >= 0 and end.max() < height:
            every = all_windows(columns, 2 * steps + 1)
            return every[at, begin].astype(np.float64, copy=False)
        steps = np.arange(-steps, steps + 1)
    inside = np.minimum(np.maximum(rows[:, None] + steps, 0), height - 1)
    inside += height * at[:, None]
    return columns.reshape(-1).take(inside).astype(np.float64, copy=False)


def stripe_at(stripe: Stripe, peaks: Peaks, offset: Floats, sigma_px: Floats, kept: Mask) -> Stripe:
    """The stripe with centres beside the peaks, NO_PEAK where they are not kept.

    Parameters
    ----------
    stripe : Stripe, px, of W entries
    peaks : Peaks, of K columns
    offset : (K,) array, px, of the centre from the peak
    sigma_px : (K,) array, px, standard uncertainty of the centre
    kept : (K,) mask, of the columns that have a centre
    """
    centre_px, sigma = stripe.centre_px.copy(), stripe.sigma_px.copy()
    status = stripe.status.copy()
    at = peaks.columns[kept]
    status[peaks.columns[~kept]] = Status.NO_PEAK
    centre_px[at] = (peaks.rows + offset)[kept]
    sigma[at] = sigma_px[kept]
    return replace(stripe, centre_px=centre_px, sigma_px=sigma, status=status)


def clipped_near(stripe: Stripe, clipped: Mask, span_px: int) -> Ints:
    """Indices of the stripe's entries that have a clipped pixel near the centre.

    Parameters
    ----------
    stripe : Stripe, px, of N entries
    clipped : (N, L) mask, of the pixels along the line's normal of each entry
    span_px : int, px, to either side of the centre
    """
    if not clipped.any():
        return np.zeros(0, dtype=np.int64)
    valued = np.flatnonzero(has_value(stripe.status))
    middle = np.rint(stripe.centre_px[valued]).astype(int)
    return valued[windows(clipped, valued, middle, span_px).any(axis=1)]


# How wide the laser line is in a picture.


_REACH_PX = 30
FWHM = float(2 * np.sqrt(2 * np.log(2)))
"""Full width at half height of a Gaussian, of its standard deviation."""
_NARROWEST_PX = 0.5  # a line that falls into one pixel shows half a pixel's width
_TURNS, _WIDER = 3, 1.1  # a line whose width grows by less in a turn is as wide as it seemed


def line_width(columns: GreyValues, at: Ints, crest: Ints, stated_px: float | None = None) -> float:
    """Standard deviation in px, along the columns, of a Gaussian as wide as the line.

    The columns are laid over each other with their brightest pixels together; the width is
    that of their mean profile at half its height above its lowest value, over 2.355.  A
    clipped crest widens it, as a bright line's is to be.  Never below 0.5 px.  The brightest
    grain of a line's speckle is as narrow as a grain: where the columns smoothed over that width,
    laid over each other likewise, show a wider line, it is that, and so on.

    Parameters
    ----------
    columns : (W, H) array, DN, one column of the picture a row
    at : (K,) array, indices of the columns that have a line, at least one
    crest : (K,) array, px, row of the highest value of each of those
    stated_px : float, optional, px, full width at half height, where that is known
    """
    if stated_px is not None:
        return max(stated_px / FWHM, _NARROWEST_PX)
    reach = min(_REACH_PX, columns.shape[1] - 1)
    width = _profile_width(total_profile(columns, at, crest, reach) / len(at))
    for _ in range(_TURNS):
        crest = smoothed_crests(columns, at, crest, width)
        wider = _profile_width(total_profile(columns, at, crest, reach) / len(at))
        if wider < _WIDER * width:
            break
        width = wider
    return width


def smoothed_crests(columns: GreyValues, at: Ints, crest: Ints, width_px: float) -> Ints:
    """(K,) px, the brightest pixels of columns smoothed over ``width_px``, near those crests.

    Noise, speckle and clipping move the brightest pixel about; this one stays near the centre.

    Parameters
    ----------
    columns, at, crest : as :func:`line_width` takes them
    width_px : float, px, the line's standard deviation; looked at is one and a half of it, and a
        pixel, to either side
    """
    near, beyond = int(np.ceil(1.5 * width_px)) + 1, int(np.ceil(3 * width_px))
    seen = windows(columns, at, crest, near + beyond).astype(np.float32)
    smoothed = np.asarray(cv2.GaussianBlur(seen, (0, 1), sigmaX=width_px))
    found: Ints = crest - near + smoothed[:, beyond : beyond + 2 * near + 1].argmax(axis=1)
    return found


def _profile_width(profile: Floats) -> float:
    """The same of a profile (n,) with the brightest pixel in the middle."""
    reach = len(profile) // 2
    half = (profile[reach] + profile.min()) / 2
    fwhm = _reach(profile[reach:], half) + _reach(profile[reach::-1], half)
    return max(fwhm / FWHM, _NARROWEST_PX)


def _reach(flank: Floats, level: float) -> float:
    """Pixels from the first of a flank to where it first falls to a level, or to its end."""
    low = flank <= level
    at = int(low.argmax())
    if not low[at]:
        return float(len(flank) - 1)
    return at - float((level - flank[at]) / (flank[at - 1] - flank[at])) if at else 0.0


# Light of a line's core above the ground beside it: what shows where the line ends.


CORE_PX = 2  # on either side of the centre: more would take in what walls beside a line throw back
BESIDE_CORE_PX = (4, 6)
"""First and last pixel, on either side, that give the ground: clear of a line of 1.2 px, near
enough that a wall or a halo is as bright there as beneath the line."""


def core_flux(stripe: Stripe, light: GreyValues) -> Floats:
    """(N,) light within CORE_PX of the line's centre above the ground beside it, DN.

    NaN where the stripe has no value, and where no light is left above the ground.

    The ground is the mean of the pixels at GROUND_PX on both sides.  The halo of light that
    water scatters is as bright there as beneath the line; a lit wall that hangs from the line's
    end fills one half of the core and one of the two sides.  Both would otherwise fill the foot
    of the fall of light at that end, which shows where the line ends, and move it outwards.

    Parameters
    ----------
    stripe : Stripe, px, of N entries
    light : (N, L) array, DN, a row for each entry of the stripe
    """
    flux = np.full(len(stripe.status), np.nan)
    valued = np.flatnonzero(has_value(stripe.status))
    row = np.rint(stripe.centre_px[valued]).astype(int)
    steps = np.abs(np.arange(-BESIDE_CORE_PX[1], BESIDE_CORE_PX[1] + 1))
    beside, core = steps >= BESIDE_CORE_PX[0], steps <= CORE_PX
    weights = core * beside.sum() - beside * core.sum()  # whole: of even light nothing is left
    total = windows(light, valued, row, BESIDE_CORE_PX[1]) @ weights / beside.sum()
    flux[valued] = np.where(total > 0, total, np.nan)
    return flux


# What an edge of the target's texture along the line does to the line's centre.


_BESIDE = ((1.5, 2.5), (2.5, 4.5))
"""Where the ground beside the line is seen, in standard deviations of the line from its centre: in
the flanks, which are symmetric where no edge crosses them, and beyond."""

_ROUNDING_DN = 0.5  # a ground of 0 DN has been anything up to that: no edge is sharper


def doubt_beside_edge(
    stripe: Stripe, light: GreyValues, ground: GreyValues, threshold_dn: float
) -> Stripe:
    """The stripe with sigma_px enlarged where the target is brighter on one side of the line.

    A line half on white and half on black is seen displaced towards the white.  Where the white,
    r times as bright, begins d standard deviations from the middle, the line's flank is there
    r exp(-d² / 2) times as bright as its crest, and is taken for it up to d = sqrt(2 ln r).
    A centroid, to which the black contributes as well, is displaced by less than (r - 1) / (r + 1)
    of that (from r = 1.4 on; before, by less than 0.14 standard deviations), which is what is
    allowed for.  The target under other light shows r.

    Parameters
    ----------
    stripe : Stripe, px, of N entries
    light : (N, L) array, DN, the line, one row for each entry of the stripe
    ground : (N, L) array, DN, the target; light of the line's own is symmetric
    threshold_dn : float, DN, what a darker ground says nothing against

    References
    ----------
    The limit is derived above; a uniform distribution up to it on either side, JCGM 100:2008,
    sec. 4.3.7.
    """
    at = np.flatnonzero(has_value(stripe.status))
    if len(at) == 0:
        return stripe
    width_px = line_width(light, at, crests(light)[at])
    row = np.rint(stripe.centre_px[at]).astype(np.int64)
    reach_px = np.zeros(len(at))
    least_dn = max(threshold_dn / 4, _ROUNDING_DN)
    for first, last in _BESIDE:
        beside = np.arange(int(np.ceil(first * width_px)), int(np.ceil(last * width_px)) + 1)
        above, below = (windows(ground, at, row, side).mean(axis=1) for side in (-beside, beside))
        # Colours less each other may leave a negative ground.
        one, other = np.abs(above) + least_dn, np.abs(below) + least_dn
        contrast, ratio = np.abs(one - other) / (one + other), np.abs(np.log(one / other))
        reach_px = np.maximum(reach_px, contrast * np.sqrt(2 * ratio) * width_px)
    sigma_px = stripe.sigma_px.copy()
    sigma_px[at] = np.hypot(sigma_px[at], reach_px / np.sqrt(3))
    return replace(stripe, sigma_px=sigma_px)


# The pieces of a stripe: stretches of neighbouring columns between gaps and jumps.


JUMP_PX = 3.0
"""A line that moves further than this from one column to the next has jumped: another surface
begins there.  It is the slope (72 degrees) above which a line is rather one of the rows."""


def pieces(stripe: Stripe) -> Ints:
    """(N,) number of the piece each column belongs to, from 0; -1 where there is no value.

    A piece ends where a column has no value and where the centre moves by more than JUMP_PX.

    Parameters
    ----------
    stripe : Stripe, px, of N entries
    """
    return pieces_of(has_value(stripe.status), stripe.centre_px, JUMP_PX)


def neighbours(piece: Ints, steps: Ints) -> tuple[Ints, Mask]:
    """(N, n) entries some steps from each, and the mask of those of the same piece.

    Beyond the ends it is the entry at the end, which is not in the mask.

    Parameters
    ----------
    piece : (N,) array, as :func:`pieces` numbers them
    steps : (n,) array, entries
    """
    at = np.arange(len(piece))[:, None] + steps
    inside = np.clip(at, 0, len(piece) - 1)
    return inside, (at == inside) & (piece[inside] == piece[:, None]) & (piece[:, None] >= 0)


# Spots: where the columns of a picture cross what may be a line; runs: spots side by side.


GROUND_PX = 61
"""What is wider than this, along the column, is ground: four FWHM of 6 px lines."""

_HELD_WIDTHS = 2.5

REACH_PX = 8
"""A spot is where the picture exceeds half of its highest value so near by."""

GAP = 4
"""Columns that speckle or a dark grain may take out of a run."""

_SMOOTHING_PX = 1.0  # as wide as a narrow line: speckle must not split a spot in two
_BELL = np.asarray(cv2.getGaussianKernel(9, _SMOOTHING_PX, cv2.CV_32F), np.float32).ravel()
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
    width_px: float | None = None,
) -> Relief:
    """The columns with the ground beneath their lines.

    Parameters
    ----------
    columns : (W, H) array, DN, one column of the picture a row
    ground_px : int, odd, px, what is wider along the column is ground
    sharp : bool, whether the ground is that of the columns as they are, not smoothed
    width_px : float, optional, px, full width of the line, where it is stated: no ground is
        narrower than two and a half times that, down to 1.3 % of a Gaussian's height
    """
    single = smoothed_by_width(columns, width_px).astype(np.float32, copy=False)
    blurred = cv2.GaussianBlur(single, (0, 1), sigmaX=_SMOOTHING_PX, sigmaY=_SMOOTHING_PX)
    smoothed = np.asarray(cv2.transpose(blurred), np.float32)
    opened = np.ascontiguousarray(single.T) if sharp else smoothed
    along = np.ones((_ground_px(ground_px, width_px), 1), np.uint8)
    ground = np.asarray(cv2.morphologyEx(opened, cv2.MORPH_OPEN, along), np.float32)
    return Relief(columns, smoothed.T, ground.T)


def _ground_px(ground_px: int, width_px: float | None) -> int:
    return max(ground_px, 2 * int(_HELD_WIDTHS * (width_px or 0) / 2) + 1)


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


def spots_of(
    columns: GreyValues,
    threshold_dn: float,
    ground_px: int = GROUND_PX,
    sharp: bool = False,
    width_px: float | None = None,
) -> Spots:
    """The spots of all columns whose highest value exceeds the ground by the threshold.

    Parameters
    ----------
    columns : (W, H) array, DN, one column of the picture a row
    threshold_dn : float, DN
    ground_px, sharp, width_px : as :func:`relief_of` takes them
    """
    opened = smoothed_by_width(columns, width_px)
    if opened is not columns or columns.dtype != np.uint8:
        columns, opened = columns.astype(np.float32), opened.astype(np.float32)
    size_px = _ground_px(ground_px, width_px)
    place, strength = find_spots(columns, opened, threshold_dn, size_px, sharp, _BELL, REACH_PX)
    spots = Spots(*place, *strength)
    return select(spots, brightest(spots.column, spots.light, MOST_SPOTS))


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
    return linked_runs(spots.column, spots.top, spots.bottom, GAP)


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
