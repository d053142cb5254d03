"""The picture as the search wants it, and the centre of a mark in it."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from lscan.board.loops import fit_marks
from lscan.config.rig import Channel
from lscan.errors import InputError
from lscan.records import Floats, Ints, Mask

# The centre of a mark: the maximum of a second-order polynomial fitted about it.
#
# The paper fits z = a + b x + c y + d x^2 + e x y + f y^2 to the region around the brightest
# pixel and takes its maximum (Sec. III.1).  How large a region, and how weighted, decides the
# accuracy.  Here the weights are a Gaussian about the maximum itself, and the fit is repeated
# until the maximum stays.  With these weights b, c and d, e, f are the first and second
# derivatives of the picture smoothed by the same Gaussian, so each fit is a Newton step towards
# the top of the smoothed dot, which is round where the dot itself is flat.
#
# For a disc of radius r in white noise the scatter of that top is least at sigma = r / sqrt(2),
# where it is within 5 % of the Cramér-Rao bound of a dot blurred by 0.7 px (r = 2.75 px):
# scatter = noise / amplitude * exp(q) / (sqrt(2 pi) 2 q), q = r^2 / (2 sigma^2), least at q = 1.


SMALLEST_SIGMA_PX = 0.9  # a narrower Gaussian is not sampled well enough by whole pixels
REACH = 4.0  # of sigma: the weights beyond are below 0.04 %
WIDER = 1.6
MOST_MOVED = 0.1  # of the window's sigma: perspective and neighbours move a dot by half of that
MOST_MOVED_SIGMAS = 6.0
STEPS = 6  # Newton's steps
STEPS_FROM_NEAR = 3  # from a start good to a tenth of a pixel


@dataclass(frozen=True)
class Centres:
    """Maxima of the fitted polynomials, N marks; where not round the numbers mean nothing.

    Attributes
    ----------
    points : (N, 2) array, px, of (u, v)
    height : (N,) array, grey values, polynomial at its maximum
    sigma_px : (N,) array, px, standard uncertainty of u and of v
    round : (N,) mask, whether the polynomial has a maximum, near the start, and is not a ridge
    """

    points: Floats
    height: Floats
    sigma_px: Floats
    round: Mask


def window_sigma(radius_px: Floats) -> Floats:
    """(N,) Gaussian sigma, px, of the window that fits discs.

    Parameters
    ----------
    radius_px : (N,) array, px, of the discs
    """
    return np.maximum(np.asarray(radius_px) / np.sqrt(2), SMALLEST_SIGMA_PX)


def disc_height(radius_px: Floats, blur_px: float = 0.0) -> Floats:
    """(N,) height of the smoothed disc at its middle, as a part of the disc's contrast.

    The integral of a Gaussian over a disc: 1 - exp(-r^2 / (2 s^2)), where s joins the window's
    sigma and the picture's blur.

    Parameters
    ----------
    radius_px : (N,) array, px, of the discs
    blur_px : float, px, Gaussian sigma of the picture's blur

    Examples
    --------
    >>> disc_height(np.array([4.0])).round(3)
    array([0.632])
    """
    radius = np.asarray(radius_px)
    variance = window_sigma(radius) ** 2 + blur_px**2
    return 1 - np.exp(-(radius**2) / (2 * variance))


def fit_centres(
    flat: NDArray[np.floating],
    start: Floats,
    sigma: Floats,
    noise: NDArray[np.floating],
    steps: int = STEPS,
    saddles: bool = False,
    kind: Ints | None = None,
) -> Centres:
    """Maxima near ``start`` of second-order polynomials fitted to the picture, or saddles.

    Parameters
    ----------
    flat : (H, W) array, grey values, marks bright on a ground of 0; beyond its edge it counts as 0
    start : (N, 2) array, px, (u, v) of the brightest pixels
    sigma : (N,) array, px, from ``window_sigma``
    noise : (H, W) array, standard deviation of each grey value, independent from pixel to pixel
    steps : int, of Newton's method; the search is content with fewer
    saddles : bool, look for the corners of a chessboard instead.  Two dark and two bright squares
        that meet are the same seen from their corner but for the sign, so it is where the gradient
        vanishes under a Gaussian of any size and any blur.  ``round`` then says that it is a
        saddle, no more than five times as steep one way as the other.
    kind : (N,) array, optional, number of each mark's kind: those of one are seen in windows as
        large as their widest needs; all by default

    References
    ----------
    Sec. III.1 of the paper, with Gaussian weights as the module's text says.
    """
    if len(start) == 0:
        return Centres(np.empty((0, 2)), np.empty(0), np.empty(0), np.empty(0, bool))
    kind = np.zeros(len(start), np.int64) if kind is None else kind
    widest = np.zeros(kind.max() + 1)
    np.maximum.at(widest, kind, sigma)
    reach = np.ceil(REACH * widest[kind]).astype(np.int64) + 1
    return Centres(*fit_marks(flat, noise, start, sigma, reach, steps, saddles))


def stand_alone(
    flat: NDArray[np.floating],
    centres: Centres,
    sigma: Floats,
    noise: NDArray[np.floating],
    kind: Ints | None = None,
) -> Mask:
    """(N,) mask of the marks whose centre stays where it is in a window 1.6 times as wide.

    Dirt beside a mark, or a smear that joins it to another, draws the wider window further.

    Parameters
    ----------
    flat : (H, W) array, grey values, as for ``fit_centres``
    centres : Centres, px, that ``fit_centres`` found
    sigma : (N,) array, px, of the windows it used
    noise : (H, W) array, grey values, as for ``fit_centres``
    kind : (N,) array, optional, as for ``fit_centres``
    """
    wider = fit_centres(flat, centres.points, WIDER * sigma, noise, STEPS_FROM_NEAR, kind=kind)
    moved = np.linalg.norm(wider.points - centres.points, axis=1)
    own = np.hypot(wider.sigma_px, centres.sigma_px)
    return wider.round & (moved <= MOST_MOVED * sigma + MOST_MOVED_SIGMAS * own)


# The picture as the search wants it: one grey value a pixel, marks bright, ground level.


Image = NDArray[np.float32]

BLUR_PX = 0.7  # typical of a sharp picture: lens and pixel
SMALLEST_PX = 16  # as for cameras in config/rig.py
CHANNELS = {"red": (1, 0, 0), "green": (0, 1, 0), "blue": (0, 0, 1), "grey": (0.299, 0.587, 0.114)}
IMMERKAER = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], dtype=np.float32)
LARGE_PX = 3_000_000  # pixels: of a larger picture a smaller copy shows where things are; ours
GROUND_WINDOW = 3.0  # of the dot's diameter: wide enough that a dot is the smaller part
WORKING_RADIUS_PX = 3.0  # dots of this radius in a smaller copy still show what large ones do


@dataclass(frozen=True)
class BoardPicture:
    """A picture ready for measuring.

    Attributes
    ----------
    flat : (H, W) array, grey values, marks bright (for dark marks it is the paper's negative), with
        the ground subtracted so that the plate is about 0 everywhere.  Dark marks are brought
        to one contrast by the light on the plate about them.
    smooth : (H, W) array, ``flat`` smoothed to the size of the control dots; its brightest pixel is
        the middle of a dot even where a single pixel of noise is brighter
    gain : (H, W) array, by which that has multiplied the grey values
    noise : (H, W) array, standard deviation of each value of ``flat``
    """

    flat: Image
    smooth: Image
    gain: Image
    noise: Image

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in px."""
        return self.flat.shape[1], self.flat.shape[0]

    def noise_at(self, points: Floats) -> Floats:
        """(N,) noise of the pixels nearest to some places, grey values.

        Parameters
        ----------
        points : (N, 2) array, px, of (u, v)
        """
        last = np.array(self.size) - 1
        column, row = np.clip(np.rint(points), 0, last).astype(np.int64).T
        return self.noise[row, column].astype(float)

    def wholly_in_view(self, points: Floats, radius_px: Floats | float) -> Mask:
        """(...) mask of the blurred discs that lie in the picture.

        Parameters
        ----------
        points : (..., 2) array, px, (u, v) of their centres
        radius_px : (...) array or float, px
        """
        u, v = points[..., 0], points[..., 1]
        # The outermost pixels reach half a pixel further; so does, and more, the blurred rim.
        radius = np.asarray(radius_px) - 0.5 + BLUR_PX
        width, height = self.size
        inside_u = (u >= radius) & (u <= width - 1 - radius)
        return inside_u & (v >= radius) & (v <= height - 1 - radius)


def bright_marks(image: NDArray[Any], channel: Channel, marks: str) -> Image:
    """(H, W) grey values with bright marks: the picture, or its negative for dark marks.

    Parameters
    ----------
    image : (H, W) or (H, W, 3) array, grey or RGB, integer or float
    channel : str, ignored for grey pictures; "grey" is the luma of ITU-R BT.601 (0.299, 0.587,
        0.114)
    marks : str, "dark" or "bright"

    Raises
    ------
    InputError
        For another shape, a picture smaller than 16 px, or values that are not finite numbers.
    """
    array = np.asarray(image)
    if array.ndim not in (2, 3) or (array.ndim == 3 and array.shape[2] != 3):
        raise InputError("not a picture", where="image", value=array.shape, allowed="(H, W[, 3])")
    if min(array.shape[:2]) < SMALLEST_PX:
        allowed = f"at least {SMALLEST_PX} px a side"
        raise InputError("picture too small", where="image", value=array.shape, allowed=allowed)
    if not (np.issubdtype(array.dtype, np.integer) or np.issubdtype(array.dtype, np.floating)):
        raise InputError("not a picture", where="image", value=str(array.dtype), allowed="numbers")
    with np.errstate(over="ignore"):  # beyond single precision is infinite
        single = array.astype(np.float32)
    if not np.isfinite(single).all():
        raise InputError("holds values that are not finite", where="image")
    grey = np.ascontiguousarray(_one_channel(single, channel))
    return grey if marks == "bright" else -grey


def _one_channel(array: Image, channel: Channel) -> Image:
    if array.ndim == 2:
        return array
    if channel not in CHANNELS:
        allowed = ", ".join(CHANNELS)
        raise InputError("no such channel", where="channel", value=channel, allowed=allowed)
    return array @ np.array(CHANNELS[channel], dtype=np.float32)


def reduction_of(bright: Image) -> int:
    """By how much a large picture may be reduced to see where things are; 1 for any other.

    Parameters
    ----------
    bright : (H, W) array, grey values
    """
    return int(np.ceil(np.sqrt(bright.size / LARGE_PX)))


def shrink(bright: Image, reduction: int) -> Image:
    """The picture with squares of pixels averaged; what is left over at its far edges is cut off.

    Parameters
    ----------
    bright : (H, W) array, grey values
    reduction : int, pixels a side of a square
    """
    if reduction == 1:
        return bright
    height, width = (length // reduction for length in bright.shape)
    rows = np.asarray(sum(bright[k : height * reduction : reduction] for k in range(reduction)))
    total = sum(rows[:, k : width * reduction : reduction] for k in range(reduction))
    return np.asarray(total / np.float32(reduction**2))


def working_reduction(bright: Image, dot_radius_px: float) -> int:
    """By how much a large picture may be reduced without losing what its dots show.

    Parameters
    ----------
    bright : (H, W) array, grey values
    dot_radius_px : float, px, of the control dots
    """
    return max(1, min(reduction_of(bright), int(dot_radius_px / WORKING_RADIUS_PX)))


def enlarge(small: Image, shape: tuple[int, ...]) -> Image:
    """A reduced picture at full size again, interpolated; itself where it has that size.

    Parameters
    ----------
    small : (h, w) array
    shape : tuple of int, (H, W)
    """
    if small.shape == shape:
        return small
    full = cv2.resize(small, shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(full, dtype=np.float32)


def noise_of(bright: Image) -> float:
    """Standard deviation of the noise, in grey values; at least that of 8-bit rounding.

    The mask below is blind to edges and slopes and has norm 6; the median of its absolute
    response, rather than the mean of the article, keeps the marks out.  0.6745 is the median of
    |N(0, 1)|.

    Parameters
    ----------
    bright : (H, W) array, grey values

    References
    ----------
    Immerkær, "Fast noise variance estimation", CVIU 64 (1996).
    """
    response = cv2.filter2D(bright, cv2.CV_32F, IMMERKAER)[1:-1, 1:-1]
    some = response[:: reduction_of(bright)]  # of a large picture
    return max(float(np.median(np.abs(some))) / 0.6745 / 6, rounding_of(bright))


def rounding_of(bright: Image) -> float:
    """Standard deviation that rounding to 1/255 of the picture's range gives a grey value.

    Parameters
    ----------
    bright : (H, W) array, grey values
    """
    return max(float(np.ptp(bright)), 1e-6) / 255 / float(np.sqrt(12))


def prepare(bright: Image, dot_radius_px: float, noise: float) -> BoardPicture:
    """The picture levelled and smoothed for dots of about one radius.

    The ground is the median over a window of three dot diameters, then smoothed: a slope of
    the light would shift every maximum by the slope over the curvature (about 0.01 px for 2:1
    across the picture), and with the ground at 0 a dot close to the picture's edge can be
    completed with zeros.

    Parameters
    ----------
    bright : (H, W) array, grey values, marks bright
    dot_radius_px : float, px, of the control dots
    noise : float, standard deviation of a grey value
    """
    small = _ground(bright, dot_radius_px)
    ground = enlarge(small, bright.shape)
    gain = _gain(ground, float(np.median(small)))
    flat = bright - ground
    flat *= gain
    sigma = float(window_sigma(np.array([dot_radius_px]))[0])
    smooth = np.asarray(
        cv2.GaussianBlur(flat, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT), dtype=np.float32
    )
    return BoardPicture(flat, smooth, gain, gain * np.float32(noise))


def _gain(ground: Image, usual: float) -> Image:
    """What brings the plate to its usual brightness, within a factor of four; 1 if it is dark.

    The contrast of dark marks is that of the light on the plate: where it falls to one side it
    draws the marks' maxima to the other, by a quarter of the radius squared times its relative
    slope.  A dark plate's grey value does not show the light.
    """
    if usual >= 0:
        return np.ones_like(ground)
    gain = np.minimum(ground, usual / 4)
    return np.clip(np.divide(usual, gain, out=gain), 0.25, 4.0, out=gain)


def _ground(bright: Image, dot_radius_px: float) -> Image:
    """The ground; of a large picture with large dots, of a smaller copy: it is smooth."""
    reduction = working_reduction(bright, dot_radius_px)
    small = shrink(bright, reduction)
    window = 2 * int(np.ceil(GROUND_WINDOW * dot_radius_px / reduction)) + 1
    low, high = float(small.min()), float(small.max())
    step = max(high - low, 1e-6) / 255
    median = cv2.medianBlur(np.round((small - low) / step).astype(np.uint8), window)
    smoothed = cv2.GaussianBlur(median.astype(np.float32), (0, 0), window / 4)
    return smoothed * np.float32(step) + np.float32(low)
