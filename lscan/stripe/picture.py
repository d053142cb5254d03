"""A picture as stripe extraction takes it: laid out by columns, its clipping, its noise."""

from dataclasses import dataclass
from functools import reduce
from typing import cast

import cv2
import numpy as np

from lscan.config.rig import LineChannel, NoiseSection
from lscan.errors import InputError
from lscan.files.pictures import colour_shift_px, grey_dn, step_of
from lscan.records import Axis, Floats, GreyValues, Ints, Mask, Picture
from lscan.stripe.loops.scatter import core_variance, count_second_differences, shot_and_speckle

# The noise of a picture: as the rig file states it, or estimated from that picture alone.
#
# Three terms make up the variance of a pixel.  One is the same everywhere (reading noise,
# rounding, the ground's own light), seen in the pixels away from the line.  Shot noise grows in
# proportion to the light of the line; speckle, whose deviation (not variance) is proportional
# to the light, with its square.  Those two are seen in how pixels scatter about a fitted line
# (:func:`scatter_noise`), and distinguished by pixels of different light.
#
# The paper's extractors fit no line.  For them one term stands for both, seen in how much the
# line's brightness jumps from one column to the next (:func:`line_variance_per_dn`): photon
# noise follows it exactly; speckle and the target's own texture are stated too large by it:
# their weight is at the line's crest, where a pixel hardly moves the centroid.


ROUNDING_VARIANCE = 1 / 12
"""Variance of rounding to whole digital numbers, DN²: a uniform distribution one DN wide."""

_SECOND_DIFFERENCE_GAIN = 6.0
"""Variance of I[i-1] - 2 I[i] + I[i+1] over that of I, for independent pixels: 1 + 4 + 1."""

_COLUMNS_SAMPLED = 64
_FEWEST_TRIPLES = 16
_CUTS, _KEPT = 3, 0.97334  # of robust_variance, which says where they come from


@dataclass(frozen=True)
class Noise:
    """Variance of a pixel: ``constant + per_dn · (light + veil) + (speckle · light)²``.

    Attributes
    ----------
    constant : float, DN², at least that of rounding
    per_dn : float, DN² of variance for each DN of light above the background
    speckle : float, contrast of the laser's speckle in one pixel

    References
    ----------
    docs/explanation/physics.md, sections 4 (speckle) and 5 (noise, after EMVA 1288).
    """

    constant: float
    per_dn: float
    speckle: float = 0.0

    def variance(self, light: Floats, veil: Floats | float = 0.0) -> Floats:
        """Variance in DN², same shape as ``light``.

        Parameters
        ----------
        light : array, DN, the line's grey values above the ground
        veil : array or float, DN, by how much the ground under the line is brighter than the
            picture's: water's scattered light, which has shot noise but no speckle
        """
        variance: Floats = np.maximum(light + veil, 0.0)
        variance *= self.per_dn
        variance += self.constant
        variance += np.square(self.speckle * light)
        return variance


def stated_noise(section: NoiseSection, base: float) -> Noise:
    """The noise that the rig file states, for a picture of a known background.

    Parameters
    ----------
    section : NoiseSection, of the rig file
    base : float, DN, background of the picture
    """
    gain = section.dn_per_electron
    return Noise(section.read_dn**2 + gain * max(base, 0.0), gain, section.speckle)


def difference_noise(section: NoiseSection, dark_dn: float) -> NoiseSection:
    """The noise of a picture from which another was taken off.

    Reading noise comes in twice, and so does the shot noise of the light in both.

    Parameters
    ----------
    section : NoiseSection, of one picture
    dark_dn : float, DN, mean grey value of the picture taken off
    """
    variance = 2 * (section.read_dn**2 + section.dn_per_electron * max(dark_dn, 0.0))
    return section.model_copy(update={"read_dn": variance**0.5})


def constant_variance(columns: GreyValues) -> float:
    """Variance in DN² of the pixels away from the line.

    Second differences along the columns cancel the background and its slope; the line's own are
    outliers and are cut off.  Neighbouring pixels must have independent noise: a picture that was
    smoothed or strongly compressed states too little.

    Parameters
    ----------
    columns : (W, H) array, DN, one column of the picture a row
    """
    sample = columns[sample_of(len(columns))]
    step_dn = step_of(sample)
    in_steps: GreyValues = sample if step_dn == 1 else sample / np.float32(step_dn)
    with np.errstate(invalid="ignore"):
        grey: GreyValues = in_steps.astype(np.int16 if step_dn == 1 else np.int32)
    rounding = ROUNDING_VARIANCE * step_dn**2
    least = _SECOND_DIFFERENCE_GAIN * rounding
    if (grey == in_steps).all():
        count = count_second_differences(grey, 2 * int(np.ptp(grey)))
        sizes = step_dn * np.arange(len(count), dtype=float)
        variance = core_variance(sizes, count, least, _CUTS, _KEPT)
    else:  # those of single precision are rounded
        variance = robust_variance(np.diff(sample.astype(np.float64), n=2, axis=1), least)
    return max(variance / _SECOND_DIFFERENCE_GAIN, rounding)


def sample_of(count: int) -> slice:
    """The columns that the noise is estimated from: 64 to 127 of them, evenly; all of fewer.

    Parameters
    ----------
    count : int, columns there are
    """
    return slice(None, None, max(1, count // _COLUMNS_SAMPLED))


def line_variance_per_dn(light: Floats, at: Ints, constant: float) -> float:
    """Variance per DN of light on the line, in DN, from the scatter between columns.

    0 where fewer than 16 triples of neighbouring columns have a line, or where half of the windows
    have no light.  Columns that are clipped scatter less than the light does.

    Parameters
    ----------
    light : (K, n) array, DN, above the background in the window of each column that has a line
    at : (K,) array, the columns' indices, rising
    constant : float, DN², as in :class:`Noise`
    """
    together = (at[2:] - at[:-2]) == 2
    if np.count_nonzero(together) < _FEWEST_TRIPLES:
        return 0.0
    sums = light.sum(axis=1)
    typical = float(np.median(sums))
    if typical <= 0:
        return 0.0
    least = _SECOND_DIFFERENCE_GAIN * ROUNDING_VARIANCE
    scatter = robust_variance(np.diff(sums, n=2)[together], least) / _SECOND_DIFFERENCE_GAIN
    return max(scatter - light.shape[1] * constant, 0.0) / typical


def line_noise(columns: GreyValues, light: Floats, at: Ints) -> Noise:
    """The noise of a picture in which no line is fitted.

    Parameters
    ----------
    columns : (W, H) array, DN, one column of the picture a row
    light, at : as :func:`line_variance_per_dn` takes them
    """
    constant = constant_variance(columns)
    return Noise(constant, line_variance_per_dn(light, at, constant))


def scatter_noise(square: Floats, light: Floats, constant: float) -> Noise:
    """The noise that makes pixels scatter so about a fitted line.

    Least squares of ``square - constant`` on light and light², neither term below 0,
    weighted by the inverse square of the variance: that of a normal residual's square is
    twice the variance squared.  Thrice, as the weights need the result; squares beyond 25
    times their expectation (5 sigma) are left out.

    Parameters
    ----------
    square : (N,) array, DN², on average the variance of the noise (fit.py)
    light : (N,) array, DN, the line's fitted grey values, 0 or more
    constant : float, DN², as in :class:`Noise`, known from elsewhere
    """
    return Noise(constant, *shot_and_speckle(square, light, constant))


def robust_variance(values: GreyValues, least: float = 0.0) -> float:
    """Variance about zero of the normal core of ``values``, what lies outside 3 sigma cut off.

    Starts from the median absolute deviation and cuts thrice; a normal distribution cut at
    3 sigma keeps 0.97334 of its variance (1 - 6 phi(3) / (2 Phi(3) - 1)).

    Parameters
    ----------
    values : array, of any shape and unit
    least : float, a variance there is in any case, where the search starts if most values agree
    """
    sizes = np.sort(np.abs(np.asarray(values, dtype=float)), axis=None)
    return core_variance(sizes, np.ones(len(sizes), np.int64), least, _CUTS, _KEPT)


# Whether a picture was compressed in blocks, as JPEG and MJPEG do, whatever file it comes in.
#
# No noise of single pixels holds in such a picture.  Its dark parts have none, and beside a line
# the coder leaves ripples, and colours of half the resolution, far above the noise of the flank's
# little light: a fit that trusts the camera's noise, its speckle above all, follows them.


_BLOCK = 8  # px, of JPEG's transform
_FEWEST_BLOCKS = 16  # blocks along the line
_MOST_DN = 8  # a greater step is one of the target's, or a hot pixel's
_BEYOND_CHANCE = 5.0  # standard deviations
_STANDS_OUT = 1.1  # times the next: a colour filter's steps are large at every second pixel


def is_coded(grey: GreyValues) -> bool:
    """Whether the steps from pixel to pixel are the greatest at the bounds of blocks of eight.

    At one of the eight places that a block's bound can have the step must be the greatest in more
    blocks than by chance, in which an eighth of them have it there; and its mean must stand out.

    Parameters
    ----------
    grey : (N, L) array, DN, the pixels across the line, entry by entry: along L it crosses the
        line, whose own steps are in every block alike

    References
    ----------
    The steps at the blocks' bounds tell them: Fan and de Queiroz, Identification of bitmap
    compression history: JPEG detection and quantizer estimation, IEEE Trans. Image Process. 12,
    230 (2003).

    Examples
    --------
    >>> import numpy as np
    >>> is_coded(np.random.default_rng(1).integers(0, 9, (640, 480)))
    False
    """
    every = grey[:, ::2]
    every = every.astype(np.int16) if np.issubdtype(every.dtype, np.integer) else every
    steps: Floats = np.minimum(np.abs(np.diff(every, axis=0)), _MOST_DN).mean(axis=1)
    blocks = len(steps) // _BLOCK
    if blocks < _FEWEST_BLOCKS:
        return False
    steps = steps[: blocks * _BLOCK].reshape(blocks, _BLOCK)
    means = steps.mean(axis=0)
    others, bound = means.argsort()[-2:]
    greatest = np.count_nonzero(steps[:, [bound]] > np.delete(steps, bound, axis=1), axis=1)
    chance = 1 / _BLOCK
    doubt = np.sqrt(chance * (1 - chance) / blocks)
    share = np.mean(greatest == _BLOCK - 1)
    return bool(
        share > chance + _BEYOND_CHANCE * doubt and means[bound] > _STANDS_OUT * means[others]
    )


# A picture laid out for stripe extraction: one row in memory for each entry of the stripe.


# A frame that a camera or a program drew along the edge of its pictures.


_WIDEST_FRAME_PX = 8  # a block of JPEG: as far as cameras fill up a width that is no multiple of it
_EVEN_DN, _EVEN_SHARE = 8, 0.9  # grey values of a drawn frame differ by what lossy coding does
_STEP_DN = 16  # a frame as dark as the picture is beside it does no harm


def frame_px(lines: GreyValues) -> tuple[int, int]:
    """Pixels that a bright frame covers at the beginning and at the end of a picture's lines.

    A frame is even along the whole edge of the picture and brighter than the pixels beside
    it, at most 8 px wide.  It would be the highest value of every line that holds no brighter one,
    at the picture's border.  A laser's line that runs along the edge is uneven.

    Parameters
    ----------
    lines : (N, L) array, DN, pixels from one edge of the picture to the other
    """
    if lines.shape[1] <= 2 * _WIDEST_FRAME_PX + 1:
        return 0, 0
    return _depth(lines[:, : _WIDEST_FRAME_PX + 1]), _depth(lines[:, : -_WIDEST_FRAME_PX - 2 : -1])


def without_frame(lines: GreyValues, frame: tuple[int, int]) -> GreyValues:
    """The lines with the pixel beside the frame in place of the frame's.

    Parameters
    ----------
    lines : (N, L) array, DN
    frame : tuple of int, px, as :func:`frame_px` gives it
    """
    first, last = frame
    if first == last == 0:
        return lines
    inside = lines[:, first : lines.shape[1] - last]
    return np.pad(inside, ((0, 0), frame), mode="edge")


def _depth(edge: GreyValues) -> int:
    """Pixels of the frame in (N, n) pixels from the edge inwards."""
    if int(edge.max()) <= _STEP_DN:  # darker than any frame
        return 0
    level = np.median(edge, axis=0)
    even = (np.abs(edge - level) <= _EVEN_DN).mean(axis=0) >= _EVEN_SHARE
    ends = even[:-1].cumprod().astype(bool) & (level[:-1] - level[1:] > _STEP_DN)
    return int(np.flatnonzero(ends)[-1]) + 1 if ends.any() else 0


# Where a camera's range ends: at 255 DN, or at the plateau that a picture shows below it.


CLIPPED_DN = 255
"""Highest value an 8-bit picture can hold, and from where on a deeper one counts as clipped: such
a pixel may have seen any amount of light."""

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
_FEWEST_CRESTS = 8  # crests


def clipping_level(lines: GreyValues) -> int:
    """The grey value from which pixels are clipped: CLIPPED_DN unless the picture shows another.

    A camera whose range ends below 255 DN, as gain and coding can make it, shows a plateau: many
    pixels have nearly the same highest value, few have values a little less, and the crest of
    a line is flat over several pixels, or its flanks rise as if to a higher crest.  But for what
    lossy coding spreads, the values end there: those of a level line between two rows of a colour
    filter, whose highest pixels are equal, do not.

    Parameters
    ----------
    lines : (N, L) array, DN, the pixels across the line, one row for each entry of the stripe
    """
    lines = lines.astype(np.uint8, copy=False)
    highest = lines.max(axis=1)
    stray = int(_STRAY * lines.size)  # pixels that say nothing of the range's end
    least = 0 if stray >= len(highest) else int(np.partition(highest, -stray - 1)[-stray - 1])
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
    if not (piled and (_has_flat_crests(lines, mode) or _has_cut_crests(lines, mode))):
        return CLIPPED_DN
    # Crests that are equal but for their noise go on above it.
    if top > mode and not is_coded(lines):
        return CLIPPED_DN
    level = mode  # the plateau goes down to where a tenth of its pixels are left
    while level > mode - _SPREAD_DN // 2 and 10 * count[level - 1] >= count[mode]:
        level -= 1
    return level


def _has_flat_crests(lines: GreyValues, level: int) -> bool:
    """Whether most crests that reach the level stay there for some pixels, but not for many."""
    high = (lines >= level - 2).astype(np.uint8)
    wide = cv2.morphologyEx(high, cv2.MORPH_OPEN, np.ones((1, _WIDEST_PLATEAU_PX), np.uint8))
    crest = np.asarray(cv2.subtract(high, wide), np.uint8)
    flat = cv2.erode(crest, np.ones((1, _FLAT_PX), np.uint8)).any(axis=1).sum()
    return bool(flat >= _FEWEST_CRESTS and 2 * flat >= crest.any(axis=1).sum())


def _has_cut_crests(lines: GreyValues, level: int) -> bool:
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
    if len(reach) < _FEWEST_CRESTS:
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
_BROAD_PX = 61  # what is wider is no line (peaks.py)

_UPPER, _LEAST_LINE_DN, _SIGMAS = 0.75, 12.0, 6.0  # of faint_threshold


@dataclass(frozen=True)
class PictureLines:
    """The pixels along which the line is looked for, entry by entry of the stripe.

    Attributes
    ----------
    channel : str, which was read, never "auto"
    grey : (N, L) array, DN, the chosen channel: uint8, int16 for the excess of a colour and where
        a background was subtracted, float32 of a picture of more than 8 bits; row i is column i of
        the picture (``axis="columns"``) or its row i (``axis="rows"``)
    clipped : (N, L) mask, of the pixels at the end of the camera's range, in any colour that is
        part of the channel
    clipping_dn : int, DN, grey value at which the range ends
    white : (N, L) mask or None, of the crests in which the excess is made up from the other colours
    others : (N, L) array or None, DN, what was taken off: for the excess of a colour the brighter
        of the other two, or the one that a mixed colour lacks; else the background picture
    shift_px : float, px, how far the line may lie aside, as ``colour_shift_px`` says
    """

    channel: LineChannel
    grey: GreyValues
    clipped: Mask
    clipping_dn: int
    white: Mask | None = None
    others: GreyValues | None = None
    shift_px: float = 0.0


def lines_of(
    picture: Picture,
    channel: LineChannel,
    axis: Axis,
    where: str = "picture",
    clipping_dn: int | None = None,
) -> PictureLines:
    """The lines of a picture, without the frame that may be drawn around it.

    Parameters
    ----------
    picture : (H, W) or (H, W, 3) array, uint8 or uint16, grey or RGB
    channel : str, "red", "green", "blue", or "grey", which weighs the colours 0.299 R + 0.587 G +
        0.114 B; "red-excess" and its like, the colour less the brighter of the two others;
        "cyan-excess", the darker of green and blue less red, and "magenta-excess", that of red and
        blue less green; "auto", as :func:`strongest_excess`; not used in a picture that is grey
        already
    axis : str, "columns" or "rows"
    where : str, how the message names the picture
    clipping_dn : int, optional, DN, grey value at which the camera's range ends; found from the
        picture if left out

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
    grey, brightest = _sensor_lines(picture, channel, axis)
    frame = frame_px(brightest)
    grey, brightest = without_frame(grey, frame), without_frame(brightest, frame)
    level = clipping_level(brightest) if clipping_dn is None else clipping_dn
    clipped, shift_px = brightest >= level, colour_shift_px(picture, channel, axis)
    if picture.ndim == 2 or channel not in _EXCESSES:
        return PictureLines(channel, grey, clipped, level, shift_px=shift_px)
    others, least = (without_frame(one, frame) for one in _others(picture, channel, axis))
    excess, white = _excess(grey, others, least, level)
    return PictureLines(channel, excess, clipped | white, level, white, others, shift_px)


def strongest_excess(picture: Picture, axis: Axis) -> LineChannel:
    """The excess of the colour whose narrow peaks are the highest; grey where there is no colour.

    The highest narrow peak of each line of pixels is taken, what is wider than 61 px cut off,
    and the mean over the lines.  Cameras see many green lasers in blue as well, and violet ones in
    red: little is left of one colour's excess then, and much of the mixed one's.

    Parameters
    ----------
    picture : (H, W) or (H, W, 3) array, uint8 or uint16, grey or RGB
    axis : str, "columns" or "rows"
    """
    if picture.ndim == 2 or bool((picture == picture[..., :1]).all()):
        return "grey"
    strongest, highest = _EXCESSES[0], 0.0
    for channel in _EXCESSES:
        own, _ = _sensor_lines(picture, channel, axis)
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


def check_picture(picture: Picture, where: str) -> None:
    """Refuse what is no picture of one pixel or more.

    Parameters
    ----------
    picture : (H, W) or (H, W, 3) array, uint8 or uint16; anything else is refused
    where : str, how the message names the picture

    Raises
    ------
    InputError
        For another shape or type, and for an empty picture.
    """
    pixels = np.asarray(picture)
    shaped = pixels.ndim == 2 or (pixels.ndim == 3 and pixels.shape[2] == 3)
    whole = pixels is picture and pixels.dtype in (np.uint8, np.uint16)
    if not whole or not shaped or pixels.size == 0:
        found = f"{pixels.dtype} {pixels.shape}" if pixels is picture else type(picture).__name__
        allowed = "uint8 or uint16 array of shape (H, W) or (H, W, 3)"
        raise InputError("is not a picture", where=where, value=found, allowed=allowed)


def check_pair(image: Picture, background: Picture | None) -> None:
    """Refuse a picture that is none, and a background that is not one of the same shape and type.

    Parameters
    ----------
    image : (H, W) or (H, W, 3) array, uint8 or uint16
    background : array, optional, same shape and type, the same view with the laser off

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
    if background.dtype != image.dtype:
        what, allowed = "is not of the picture's type", str(image.dtype)
        raise InputError(what, where="background", value=background.dtype, allowed=allowed)


def _sensor_lines(
    picture: Picture, channel: LineChannel, axis: Axis
) -> tuple[GreyValues, GreyValues]:
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


def _others(picture: Picture, channel: LineChannel, axis: Axis) -> tuple[GreyValues, GreyValues]:
    """(N, L) grey values of the brightest and the darkest colour that is not the channel's."""
    others = [cv2.extractChannel(picture, k) for k in range(3) if k not in _PLANES[channel]]
    return _across(reduce(cv2.max, others), axis), _across(reduce(cv2.min, others), axis)


def _excess(
    own: GreyValues, others: GreyValues, least: GreyValues, clipping_dn: int
) -> tuple[GreyValues, Mask]:
    """(N, L) colour less the others, raised where the crest is white, and mask of those crests.

    A white crest with the line's colour on both sides is raised to what the colour is there, and
    by what it exceeds its surroundings in the other colours: those are clipped last, and show where
    the middle is.  White is where the excess dips, and where the crest is far higher in each of the
    other colours than the excess, as that of a camera whose colours fade towards the end of its
    range.  The rim of a white crest, up to _RIM_PX wide, is part of it: its colour is no more that
    of the line than the middle's.
    """
    excess = less(own, others)
    # Pixels beside clipped ones are white as well: coding and blur take them below the end.
    bright = own >= _WHITE * clipping_dn
    lines = np.flatnonzero(bright.any(axis=1))
    if len(lines) == 0:
        return excess, bright
    at = np.flatnonzero(bright.any(axis=0))
    # Twice as far as a crest reaches nothing beyond counts, and nothing beyond is changed.
    part = slice(max(at[0] - 2 * _CREST_PX, 0), at[-1] + 2 * _CREST_PX + 1)
    crest = np.zeros_like(bright)
    excess[lines, part], crest[lines, part] = _raise_excess(
        excess[lines, part], others[lines, part], least[lines, part], bright[lines, part]
    )
    return excess, crest


def _raise_excess(
    excess: GreyValues, others: GreyValues, least: GreyValues, bright: Mask
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


def less(grey: GreyValues, other: GreyValues) -> GreyValues:
    """The difference of two pictures' grey values, which may be below nought; same shape.

    Parameters
    ----------
    grey, other : array, DN, uint8, or single precision of deeper pictures
    """
    return (grey.astype(np.int16) if grey.dtype == np.uint8 else grey) - other


def _across(plane: object, axis: Axis) -> GreyValues:
    pixels = grey_dn(cast(Picture, plane))
    turned = cv2.transpose(pixels) if axis == "columns" else np.ascontiguousarray(pixels)
    return cast(GreyValues, turned)
