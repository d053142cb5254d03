"""The picture as the search wants it: one grey value a pixel, marks bright, ground level."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from lscan.board.centre import window_sigma
from lscan.config.rig import Channel
from lscan.errors import InputError
from lscan.records import Floats, Mask

Image = NDArray[np.float32]

BLUR_PX = 0.7  # typical of a sharp picture: lens and pixel
SMALLEST_PX = 16  # as for cameras in rig.py
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


def reduced(bright: Image, reduction: int) -> Image:
    """The picture with squares of pixels averaged; what is left over at its far edges is cut off.

    Parameters
    ----------
    bright : (H, W) array, grey values
    reduction : int, pixels a side of a square
    """
    if reduction == 1:
        return bright
    height, width = (length // reduction for length in bright.shape)
    whole = bright[: height * reduction, : width * reduction]
    return whole.reshape(height, reduction, width, reduction).mean(axis=(1, 3), dtype=np.float32)


def working_reduction(bright: Image, dot_radius_px: float) -> int:
    """By how much a large picture may be reduced without losing what its dots show.

    Parameters
    ----------
    bright : (H, W) array, grey values
    dot_radius_px : float, px, of the control dots
    """
    return max(1, min(reduction_of(bright), int(dot_radius_px / WORKING_RADIUS_PX)))


def enlarged(small: Image, shape: tuple[int, ...]) -> Image:
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


def prepare(bright: Image, dot_radius_px: float) -> BoardPicture:
    """The picture levelled and smoothed for dots of about one radius.

    The ground is the median over a window of three dot diameters, then smoothed: a slope of
    the light would shift every maximum by the slope over the curvature (about 0.01 px for 2:1
    across the picture), and with the ground at 0 a dot close to the picture's edge can be
    completed with zeros.

    Parameters
    ----------
    bright : (H, W) array, grey values, marks bright
    dot_radius_px : float, px, of the control dots
    """
    ground = _ground(bright, dot_radius_px)
    gain = _gain(ground)
    flat: Image = (bright - ground) * gain
    sigma = float(window_sigma(np.array([dot_radius_px]))[0])
    smooth = np.asarray(
        cv2.GaussianBlur(flat, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT), dtype=np.float32
    )
    return BoardPicture(flat, smooth, gain, gain * np.float32(noise_of(bright)))


def _gain(ground: Image) -> Image:
    """What brings the plate to its median brightness, within a factor of four; 1 if it is dark.

    The contrast of dark marks is that of the light on the plate: where it falls to one side it
    draws the marks' maxima to the other, by a quarter of the radius squared times its relative
    slope.  A dark plate's grey value does not show the light.
    """
    usual = float(np.median(ground))
    if usual >= 0:
        return np.ones_like(ground)
    return np.clip(usual / np.minimum(ground, usual / 4), 0.25, 4.0).astype(np.float32)


def _ground(bright: Image, dot_radius_px: float) -> Image:
    """(H, W) the ground; of a large picture with large dots, from a smaller copy: it is smooth."""
    reduction = working_reduction(bright, dot_radius_px)
    small = reduced(bright, reduction)
    window = 2 * int(np.ceil(GROUND_WINDOW * dot_radius_px / reduction)) + 1
    low, high = float(small.min()), float(small.max())
    step = max(high - low, 1e-6) / 255
    median = cv2.medianBlur(np.round((small - low) / step).astype(np.uint8), window)
    smoothed = cv2.GaussianBlur(median.astype(np.float32), (0, 0), window / 4)
    return enlarged(smoothed * np.float32(step) + np.float32(low), bright.shape)
