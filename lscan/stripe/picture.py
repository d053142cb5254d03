"""A picture laid out for stripe extraction: one row in memory for each entry of the stripe."""

from dataclasses import dataclass
from functools import reduce
from typing import cast

import cv2
import numpy as np

from lscan.config.rig import LineChannel
from lscan.errors import InputError
from lscan.records import Axis, Bytes, Floats, GreyValues, Ints, Mask
from lscan.stripe.noise import constant_variance

# A frame that a camera or a program drew along the edge of its pictures.


_WIDEST_FRAME_PX = 8  # a block of JPEG: as far as cameras fill up a width that is no multiple of it
_EVEN_DN, _EVEN_SHARE = 8, 0.9  # grey values of a drawn frame differ by what lossy coding does
_STEP_DN = 16  # a frame as dark as the picture is beside it does no harm


def frame_px(lines: Bytes) -> tuple[int, int]:
    """Pixels that a bright frame covers at the beginning and at the end of a picture's lines.

    A frame is even along the whole edge of the picture and brighter than the pixels beside
    it, at most 8 px wide.  It would be the highest value of every line that holds no brighter one,
    at the picture's border.  A laser's line that runs along the edge is uneven.

    Parameters
    ----------
    lines : (N, L) array, uint8, DN, pixels from one edge of the picture to the other
    """
    if lines.shape[1] <= 2 * _WIDEST_FRAME_PX + 1:
        return 0, 0
    return _depth(lines[:, : _WIDEST_FRAME_PX + 1]), _depth(lines[:, : -_WIDEST_FRAME_PX - 2 : -1])


def without_frame(lines: Bytes, frame: tuple[int, int]) -> Bytes:
    """The lines with the pixel beside the frame in place of the frame's.

    Parameters
    ----------
    lines : (N, L) array, DN
    frame : tuple of int, px, as :func:`frame_px` gives it
    """
    first, last = frame
    if first == last == 0:
        return lines
    inside: Bytes = lines[:, first : lines.shape[1] - last]
    return np.pad(inside, ((0, 0), frame), mode="edge")


def _depth(edge: Bytes) -> int:
    """Pixels of the frame in (N, n) pixels from the edge inwards."""
    if int(edge.max()) <= _STEP_DN:  # darker than any frame
        return 0
    level = np.median(edge, axis=0)
    even = (np.abs(edge - level) <= _EVEN_DN).mean(axis=0) >= _EVEN_SHARE
    ends = even[:-1].cumprod().astype(bool) & (level[:-1] - level[1:] > _STEP_DN)
    return int(np.flatnonzero(ends)[-1]) + 1 if ends.any() else 0


# Where a camera's range ends: at 255 DN, or at the plateau that a picture shows below it.


CLIPPED_DN = 255
"""Highest value an 8-bit picture can hold: such a pixel may have seen any amount of light."""

_NEAR_END_DN = 250  # pictures that reach so far are clipped at 255 or not at all
_LEAST_PLATEAU_DN = 32  # below it a plateau is darkness
_STRAY = 1e-4  # share of the pixels that lossy coding or a hot pixel may put above the plateau
_SPREAD_DN = 6  # by which lossy coding spreads a plateau
_PILED = 3.0
"""Times that a plateau's three values hold more pixels than four values farther down.  At the
smooth crest of a line that is not clipped they hold 1.3 times as many: the width of a parabola
at the depth d below its top goes with the root of d."""

_FLAT_PX, _WIDEST_PLATEAU_PX = (
    3,
    41,
)  # pixels across a clipped crest: fewer may be chance, more no line
_OVERSHOOT = 1.1  # of the plateau: where the flanks of a crest clipped on fewer pixels meet
_FAINT_DN = 4.0  # reading noise and rounding: a fainter flank says no more than that it is dark
_FEWEST = 8  # crests


def clipping_level(lines: Bytes) -> int:
    """The grey value from which pixels are clipped: CLIPPED_DN unless the picture shows another.

    A camera whose range ends below 255 DN, as gain and coding can make it, shows a plateau: many
    pixels have nearly the same highest value, few have values a little less, and the crest of
    a line is flat over several pixels, or its flanks rise as if to a higher crest.

    Parameters
    ----------
    lines : (N, L) array, uint8, DN, the pixels across the line, one row for each entry of the
        stripe
    """
    highest = lines.max(axis=1)
    least = _within_highest(highest, lines.size)
    if least >= _NEAR_END_DN:
        return CLIPPED_DN
    # Values farther down than the plateau and its surroundings do not count.
    limit = max(least - 2 * _SPREAD_DN, 0)
    high = lines[highest >= limit]
    count = np.bincount(high[high >= limit], minlength=CLIPPED_DN + 1)
    above = np.cumsum(count[::-1])[::-1]  # pixels of each value or more
    top = int(np.flatnonzero(above > _STRAY * lines.size)[-1])
    if top >= _NEAR_END_DN or top < _LEAST_PLATEAU_DN:
        return CLIPPED_DN
    mode = top - _SPREAD_DN + int(count[top - _SPREAD_DN : top + 1].argmax())
    piled = count[mode - 1 : mode + 2].sum() > _PILED * count[mode - 6 : mode - 2].sum()
    if piled and (_has_flat_crests(lines, mode) or _has_cut_crests(lines, mode)):
        return _foot(count, mode)
    return CLIPPED_DN


def _within_highest(highest: Bytes, pixels: int) -> int:
    """A grey value that more than _STRAY of the pixels reach, by the highest of each line."""
    stray = int(_STRAY * pixels)
    return 0 if stray >= len(highest) else int(np.partition(highest, -stray - 1)[-stray - 1])


def _foot(count: Ints, mode: int) -> int:
    """The lowest value of the plateau: down to where a tenth of its pixels are left."""
    level = mode
    while level > mode - _SPREAD_DN // 2 and 10 * count[level - 1] >= count[mode]:
        level -= 1
    return level


def _has_flat_crests(lines: Bytes, level: int) -> bool:
    """Whether most crests that reach the level stay there for some pixels, but not for many."""
    high = (lines >= level - 2).astype(np.uint8)
    wide = cv2.morphologyEx(high, cv2.MORPH_OPEN, np.ones((1, _WIDEST_PLATEAU_PX), np.uint8))
    crest = np.asarray(cv2.subtract(high, wide), np.uint8)
    flat = cv2.erode(crest, np.ones((1, _FLAT_PX), np.uint8)).any(axis=1).sum()
    return bool(flat >= _FEWEST and 2 * flat >= crest.any(axis=1).sum())


def _has_cut_crests(lines: Bytes, level: int) -> bool:
    """Whether the flanks of most crests that reach the level rise as if to a far higher crest.

    A line narrower than _FLAT_PX is clipped on one or two pixels.  The two pixels on either side
    of them are taken to lie on a Gaussian, whose logarithm is a parabola.
    """
    high = lines >= level - 2
    reach = np.flatnonzero(high.any(axis=1))
    first = high[reach].argmax(axis=1)
    last = high.shape[1] - 1 - high[reach, ::-1].argmax(axis=1)
    narrow = (last - first < _FLAT_PX) & (first >= 2) & (last < high.shape[1] - 2)
    reach, first, last = reach[narrow], first[narrow], last[narrow]
    if len(reach) < _FEWEST:
        return False
    places = np.stack([first - 2, first - 1, last + 1, last + 2], axis=1)
    flanks = np.log(np.maximum(lines[reach[:, None], places], _FAINT_DN))
    inner = (last - first) / 2 + 1  # from the crest's middle; the outer pixels are one farther
    outside, inside = flanks[:, [0, 3]].mean(axis=1), flanks[:, [1, 2]].mean(axis=1)
    bend = (inside - outside) / (2 * inner + 1)
    tilt = (flanks[:, 2] - flanks[:, 1]) / (2 * inner)
    crest = inside + bend * inner**2 + tilt**2 / (4 * np.maximum(bend, 1e-6))
    return bool(np.median(crest) > np.log(_OVERSHOOT * level))


# A picture laid out for stripe extraction: one row in memory for each entry of the stripe.


_PLANES: dict[LineChannel, tuple[int, ...]] = {
    "red": (0,), "green": (1,), "blue": (2,),
    "red-excess": (0,), "green-excess": (1,), "blue-excess": (2,),
    "cyan-excess": (1, 2), "magenta-excess": (0, 2),
}  # fmt: skip
"""The colours that a channel's line has.  There is no yellow: no laser has it, but wood."""

_EXCESSES = tuple(channel for channel in _PLANES if channel.endswith("-excess"))
_CREST_PX = 31  # of a clipped crest, white in the middle: twice that of a line of 15 px
_WHITE = 0.9  # of the range
_DIPPED = 0.75  # of the excess on either side: where less is left in the middle, that is white
_WHITER = 2.0  # times the excess: where the darkest colour's crest is so high, that is white too
_COLOURED_DN = 16  # excess beside a crest: less is what lossy coding makes of white
_RIM_PX = 3
_BROAD_PX = 61  # what is wider is no line (spots.py)

_UPPER, _LEAST_LINE_DN, _SIGMAS = 0.75, 12.0, 6.0  # of faint_threshold


@dataclass(frozen=True)
class PictureLines:
    """The pixels along which the line is looked for, entry by entry of the stripe.

    Attributes
    ----------
    channel : str, which was read, never "auto"
    grey : (N, L) array, DN, the chosen channel: uint8, int16 for the excess of a colour, float
        where a background was subtracted; row i is column i of the picture (``axis="columns"``)
        or its row i (``axis="rows"``)
    clipped : (N, L) mask, of the pixels at the end of the camera's range, in any colour that is
        part of the channel
    clipping_dn : int, DN, grey value at which the range ends
    white : (N, L) mask or None, of the crests in which the excess is made up from the other colours
    others : (N, L) array or None, uint8, DN, what was taken off for the excess of a colour: the
        brighter of the other two, or the one that a mixed colour lacks
    """

    channel: LineChannel
    grey: GreyValues
    clipped: Mask
    clipping_dn: int
    white: Mask | None = None
    others: Bytes | None = None


def lines_of(
    picture: Bytes,
    channel: LineChannel,
    axis: Axis,
    where: str = "picture",
    clipping_dn: int | None = None,
) -> PictureLines:
    """The lines of a picture, without the frame that may be drawn around it.

    Parameters
    ----------
    picture : (H, W) or (H, W, 3) array, uint8, DN, grey or RGB
    channel : str, "red", "green", "blue", or "grey", which weighs the colours 0.299 R + 0.587 G +
        0.114 B; "red-excess" and its like, the colour less the brighter of the two others;
        "cyan-excess", the darker of green and blue less red, and "magenta-excess", that of red and
        blue less green; "auto", as :func:`strongest_excess`; not used in a picture that is grey
        already
    axis : str, "columns" or "rows"
    where : str, how the message names the picture
    clipping_dn : int, optional, DN, grey value at which the camera's range ends; found from the
        picture (clipping.py) if left out

    Raises
    ------
    InputError
        For another shape or type.

    Notes
    -----
    A line that is clipped in all colours is white in the middle, where no colour exceeds the
    others.  There the excess is at least what it is beside the white: pixels clipped in the
    line's own colour are raised to that, and marked as clipped.

    References
    ----------
    The weights are those of ITU-R BT.601.
    """
    check_picture(picture, where)
    if channel == "auto":
        channel = strongest_excess(picture, axis)
    grey, brightest = _read(picture, channel, axis)
    frame = frame_px(brightest)
    grey, brightest = without_frame(grey, frame), without_frame(brightest, frame)
    level = clipping_level(brightest) if clipping_dn is None else clipping_dn
    clipped = brightest >= level
    if picture.ndim == 2 or channel not in _EXCESSES:
        return PictureLines(channel, grey, clipped, level)
    others, least = (without_frame(one, frame) for one in _others(picture, channel, axis))
    excess, white = _excess(grey, others, least, level)
    return PictureLines(channel, excess, clipped | white, level, white, others)


def strongest_excess(picture: Bytes, axis: Axis) -> LineChannel:
    """The excess of the colour whose narrow peaks are the highest; grey where there is no colour.

    The highest narrow peak of each line of pixels is taken, what is wider than 61 px cut off,
    and the mean over the lines.  Cameras see many green lasers in blue as well, and violet ones in
    red: little is left of one colour's excess then, and much of the mixed one's.

    Parameters
    ----------
    picture : (H, W) or (H, W, 3) array, uint8, DN, grey or RGB
    axis : str, "columns" or "rows"
    """
    if picture.ndim == 2 or bool((picture == picture[..., :1]).all()):
        return "grey"
    strongest, highest = _EXCESSES[0], 0.0
    for channel in _EXCESSES:
        own, _ = _read(picture, channel, axis)
        excess, _ = _excess(own, *_others(picture, channel, axis), clipping_level(own))
        if np.maximum(excess.max(axis=1), 0).mean() > highest:  # no peak is higher than its crest
            height = _heights(excess).mean()
            if height > highest:
                strongest, highest = channel, height
    return strongest


def faint_threshold(excess: GreyValues) -> float:
    """Half the line's height in DN, its height being that of the upper quarter of narrow peaks.

    At least 12 DN, and six standard deviations of the noise: what a colour's excess holds beside a
    line.

    Parameters
    ----------
    excess : (N, L) array, DN, the excess of the line's colour
    """
    noise_dn = np.sqrt(constant_variance(excess))
    half = np.quantile(_heights(excess), _UPPER) / 2
    return float(max(half, _LEAST_LINE_DN, _SIGMAS * noise_dn))


def _heights(excess: GreyValues) -> Floats:
    """(N,) DN, the highest narrow peak of each line of pixels."""
    positive = np.maximum(excess, 0)  # dark squares have less of another colour
    narrow = cv2.morphologyEx(positive, cv2.MORPH_TOPHAT, np.ones((1, _BROAD_PX), np.uint8))
    return np.asarray(narrow.max(axis=1), dtype=float)


def check_picture(picture: Bytes, where: str) -> None:
    """Refuse what is no picture of one pixel or more.

    Parameters
    ----------
    picture : (H, W) or (H, W, 3) array, uint8, DN; anything else is refused
    where : str, how the message names the picture

    Raises
    ------
    InputError
        For another shape or type, and for an empty picture.
    """
    pixels = np.asarray(picture)
    shaped = pixels.ndim == 2 or (pixels.ndim == 3 and pixels.shape[2] == 3)
    if pixels is not picture or pixels.dtype != np.uint8 or not shaped or pixels.size == 0:
        found = f"{pixels.dtype} {pixels.shape}" if pixels is picture else type(picture).__name__
        allowed = "uint8 array of shape (H, W) or (H, W, 3)"
        raise InputError("is not a picture", where=where, value=found, allowed=allowed)


def check_pair(image: Bytes, background: Bytes | None) -> None:
    """Refuse a picture that is none, and a background that is not one of the same shape.

    Parameters
    ----------
    image : (H, W) or (H, W, 3) array, uint8, DN
    background : array, optional, same shape, the same view with the laser off

    Raises
    ------
    InputError
        For another shape or type of either.
    """
    check_picture(image, "image")
    if background is None:
        return
    check_picture(background, "background")
    if background.shape != image.shape:
        what, allowed = "is not of the picture's shape", str(image.shape)
        raise InputError(what, where="background", value=background.shape, allowed=allowed)


def _read(picture: Bytes, channel: LineChannel, axis: Axis) -> tuple[Bytes, Bytes]:
    """(N, L) grey values of a sensor's channel, and of the brightest colour that is part of it."""
    if picture.ndim == 2:
        grey = brightest = _across(picture, axis)
    elif channel == "grey":
        grey = _across(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), axis)
        red, green, blue = cv2.split(picture)
        brightest = _across(cv2.max(cv2.max(red, green), blue), axis)
    else:
        own = [cv2.extractChannel(picture, plane) for plane in _PLANES[channel]]
        grey = brightest = _across(reduce(cv2.min, own), axis)
    return grey, brightest


def _others(picture: Bytes, channel: LineChannel, axis: Axis) -> tuple[Bytes, Bytes]:
    """(N, L) grey values of the brightest and the darkest colour that is not the channel's."""
    others = [cv2.extractChannel(picture, k) for k in range(3) if k not in _PLANES[channel]]
    return _across(reduce(cv2.max, others), axis), _across(reduce(cv2.min, others), axis)


def _excess(own: Bytes, others: Bytes, least: Bytes, clipping_dn: int) -> tuple[GreyValues, Mask]:
    """(N, L) colour less the others, raised where the crest is white, and mask of those crests.

    A white crest with the line's colour on both sides is raised to what the colour is there, and
    by what it exceeds its surroundings in the other colours: those are clipped last, and show where
    the middle is.  White is where the excess dips, and where the crest is far higher in each of the
    other colours than the excess, as that of a camera whose colours fade towards the end of its
    range.  The rim of a white crest, up to _RIM_PX wide, is part of it: its colour is no more that
    of the line than the middle's.
    """
    excess = own.astype(np.int16) - others
    # Pixels beside clipped ones are white as well: coding and blur take them below the end.
    bright = own >= _WHITE * clipping_dn
    lines = np.flatnonzero(bright.any(axis=1))
    if len(lines) == 0:
        return excess, bright
    at = np.flatnonzero(bright.any(axis=0))
    # Twice as far as a crest reaches nothing beyond counts, and nothing beyond is changed.
    part = slice(max(at[0] - 2 * _CREST_PX, 0), at[-1] + 2 * _CREST_PX + 1)
    crest = np.zeros_like(bright)
    excess[lines, part], crest[lines, part] = _raised(
        excess[lines, part], others[lines, part], least[lines, part], bright[lines, part]
    )
    return excess, crest


def _raised(
    excess: GreyValues, others: Bytes, least: Bytes, bright: Mask
) -> tuple[GreyValues, Mask]:
    """The same of a part of the lines, ``bright`` where a colour nears the end of its range."""
    near = cv2.dilate(bright.astype(np.uint8), np.ones((1, 3), np.uint8)) > 0
    across = np.ones((1, _CREST_PX), np.uint8)
    closed = cv2.morphologyEx(excess, cv2.MORPH_CLOSE, across)
    coloured = closed > _COLOURED_DN
    dipped = near & (_DIPPED * closed > excess) & coloured
    faded = bright & (least > _WHITER * closed) & coloured & ~dipped
    raised = closed + np.where(dipped, cv2.morphologyEx(others, cv2.MORPH_TOPHAT, across), 0)
    if len(lines := np.flatnonzero(faded.any(axis=1))):
        whiter = cv2.morphologyEx(least[lines], cv2.MORPH_TOPHAT, across)
        faded[lines] &= whiter > _WHITER * closed[lines]
        raised[lines] += np.where(faded[lines], whiter, 0)
    white = dipped | faded
    crest = cv2.dilate(white.astype(np.uint8), np.ones((1, 2 * _RIM_PX + 1), np.uint8)) > 0
    return np.where(near, raised, excess), crest


def _across(plane: object, axis: Axis) -> Bytes:
    pixels = np.asarray(plane, dtype=np.uint8)
    turned = cv2.transpose(pixels) if axis == "columns" else np.ascontiguousarray(pixels)
    return cast(Bytes, turned)
