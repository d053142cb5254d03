"""A picture laid out for stripe extraction: one row in memory for each entry of the stripe."""

from dataclasses import dataclass
from typing import cast

import cv2
import numpy as np

from lscan.config.rig import Channel
from lscan.errors import InputError
from lscan.records import Axis, Bytes, Mask

CLIPPED_DN = 255
"""Highest value an 8-bit camera can give: such a pixel may have seen any amount of light."""

_PLANE_OF: dict[Channel, int] = {"red": 0, "green": 1, "blue": 2}


@dataclass(frozen=True)
class PictureLines:
    """The pixels along which the line is looked for, entry by entry of the stripe.

    Attributes
    ----------
    grey : (N, L) array, uint8, DN, the chosen channel; row i is column i of the picture
        (``axis="columns"``) or its row i (``axis="rows"``)
    clipped : (N, L) mask, of the pixels at the end of the camera's range, in any colour that is
        part of the channel
    """

    grey: Bytes
    clipped: Mask


def lines_of(picture: Bytes, channel: Channel, axis: Axis, where: str = "picture") -> PictureLines:
    """The lines of a picture.

    Parameters
    ----------
    picture : (H, W) or (H, W, 3) array, uint8, DN, grey or RGB
    channel : str, "red", "green", "blue", or "grey", which weighs the colours 0.299 R + 0.587 G +
        0.114 B; not used in a picture that is grey already
    axis : str, "columns" or "rows"
    where : str, how the message names the picture

    Raises
    ------
    InputError
        For another shape or type.

    References
    ----------
    The weights are those of ITU-R BT.601.
    """
    check_picture(picture, where)
    if picture.ndim == 2:
        grey = brightest = _across(picture, axis)
    elif channel == "grey":
        grey = _across(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), axis)
        red, green, blue = cv2.split(picture)
        brightest = _across(cv2.max(cv2.max(red, green), blue), axis)
    else:
        grey = brightest = _across(cv2.extractChannel(picture, _PLANE_OF[channel]), axis)
    return PictureLines(grey, brightest >= CLIPPED_DN)


def check_picture(picture: Bytes, where: str) -> None:
    """Refuse what is no picture of one pixel or more.

    Parameters
    ----------
    picture : (H, W) or (H, W, 3) array, uint8, DN
    where : str, how the message names the picture

    Raises
    ------
    InputError
        For another shape or type, and for an empty picture.
    """
    shaped = picture.ndim == 2 or (picture.ndim == 3 and picture.shape[2] == 3)
    if picture.dtype != np.uint8 or not shaped or picture.size == 0:
        raise InputError(
            "is not a picture",
            where=where,
            value=f"{picture.dtype} {picture.shape}",
            allowed="uint8 of shape (H, W) or (H, W, 3)",
        )


def _across(plane: object, axis: Axis) -> Bytes:
    pixels = np.asarray(plane, dtype=np.uint8)
    turned = cv2.transpose(pixels) if axis == "columns" else np.ascontiguousarray(pixels)
    return cast(Bytes, turned)
