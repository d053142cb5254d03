"""Picture files: read strictly, written whole or not at all; colour is RGB everywhere else.

All that decodes a stranger's picture does it here, once its header says that it is not too large.
"""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import ExifTags, Image

from lscan.errors import InputError
from lscan.files.disk import read_bytes, write_atomically
from lscan.files.headers import PictureHeader, read_header
from lscan.records import Bytes

FORMATS = "PNG, JPEG, BMP, TIFF or WebP, 8 bit"
MOST_PX = 2**25
"""Of a picture whose size no rig states; finding a line in it takes 60 bytes a pixel."""
MOST_BYTES = 4 * MOST_PX + 2**20
"""Of a picture's file: four channels of 8 bit, stored plainly, and what stands around them."""


def read_picture(path: Path) -> Bytes:
    """The picture in a file, (H, W) grey or (H, W, 3) RGB uint8.

    Parameters
    ----------
    path : Path, a file of FORMATS

    Raises
    ------
    InputError
        The file is missing, is no picture, is not of 8 bit, or is larger than ``MOST_PX``, which is
        known before it is decoded.
    """
    data = read_bytes(path, MOST_BYTES)
    header = read_header(data)
    if header is not None and header.depth_bits != 8:
        value = f"{header.depth_bits} bit"
        raise InputError("has the wrong depth", where=path, value=value, allowed=FORMATS)
    if header is not None and too_large(header):
        raise InputError(
            "is too large a picture",
            where=path,
            value=f"{header.width_px} by {header.height_px} px",
            allowed=f"{MOST_PX} px in all, as 8192 by 4096",
        )
    image = None if header is None else decode(data)
    if image is None:
        raise InputError("is not a picture that can be read", where=path, allowed=FORMATS)
    return image if image.ndim == 2 else _rgb(image)


def display_turn(path: Path) -> str:
    """How viewers turn the picture that is taken as it is stored; empty where they do not.

    Parameters
    ----------
    path : Path, a file that ``read_picture`` has read

    References
    ----------
    CIPA DC-008 (Exif 2.32), 4.6.4.A, tag Orientation.
    """
    with Image.open(io.BytesIO(read_bytes(path, MOST_BYTES))) as picture:
        return _TURNS.get(picture.getexif().get(ExifTags.Base.Orientation, 1), "")


_TURNS = {
    2: "mirrored",
    3: "turned by 180 degrees",
    4: "mirrored and turned by 180 degrees",
    5: "mirrored and turned by 90 degrees to the left",
    6: "turned by 90 degrees to the right",
    7: "mirrored and turned by 90 degrees to the right",
    8: "turned by 90 degrees to the left",
}


def read_png(
    data: bytes, where: object, size_px: tuple[int, int] | None = None, *, whose: str = ""
) -> Bytes:
    """The picture, (H, W) grey or (H, W, 3) RGB uint8, of a PNG file that lscan wrote.

    Parameters
    ----------
    data : bytes, of the file
    where : the file, for the error
    size_px : tuple or None, (width, height), px, that it must have; None: ``MOST_PX`` at most
    whose : str, who states that size, such as ", as in the rig", for the error

    Raises
    ------
    InputError
        It is no PNG of 8 bit, or of another size, which is known before it is decoded.
    """
    header, image = read_header(data), None
    if header is not None and (header.format, header.depth_bits) == ("PNG", 8):
        size = header.width_px, header.height_px
        if size_px is not None and size != size_px:
            value, allowed = "{} by {} px".format(*size), "{} by {} px".format(*size_px)
            raise InputError("wrong picture size", where=where, value=value,
                             allowed=f"{allowed}{whose}")  # fmt: skip
        image = decode(data) if size_px is not None or not too_large(header) else None
    if image is None or image.shape[2:] not in ((), (3,)):
        what = "is not an 8-bit grey or RGB picture, or too large"
        raise InputError(what, where=where, allowed=f"PNG of {MOST_PX} px at most")
    return image if image.ndim == 2 else _rgb(image)


def _rgb(image: Bytes) -> Bytes:
    """(H, W, 3) of what OpenCV decoded, without alpha; NumPy would take four times as long."""
    code = cv2.COLOR_BGRA2RGB if image.shape[2] == 4 else cv2.COLOR_BGR2RGB
    return np.asarray(cv2.cvtColor(image, code), dtype=np.uint8)


def too_large(header: PictureHeader) -> bool:
    """Whether a picture has more than ``MOST_PX`` pixels.

    Parameters
    ----------
    header : PictureHeader, its size, px
    """
    return header.width_px * header.height_px > MOST_PX


def decode(data: bytes | Bytes, flags: int = cv2.IMREAD_UNCHANGED) -> Bytes | None:
    """The picture of a file whose header has been looked at, colour as BGR.

    Parameters
    ----------
    data
        The whole file.
    flags
        As ``cv2.imdecode`` takes them.

    Returns
    -------
    (H, W), (H, W, 3) or (H, W, 4) uint8, or None
        None where it cannot be decoded, or not to 8 bit.
    """
    try:
        image: Any = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:  # such as of sizes that OpenCV itself refuses
        return None
    return image if image is not None and image.dtype == np.uint8 else None


def encoded(
    image: Bytes, ending: str, parameters: Sequence[int] = (), where: object = None
) -> bytes:
    """The file of a picture in a format.

    Parameters
    ----------
    image : (H, W) grey or (H, W, 3) RGB uint8 array
    ending : str, of the format, such as ".png"
    parameters : sequence, as ``cv2.imencode`` takes them
    where : the file, for the error

    Raises
    ------
    InputError
        There is no such format, or it cannot hold a picture of that shape.
    """
    bgr = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    try:
        done, data = cv2.imencode(ending, bgr, parameters)
    except cv2.error:
        done = False
    if not done and not cv2.haveImageWriter(f"x{ending}"):
        allowed = ".png, .jpg, .bmp, .tif, .webp"
        raise InputError("unknown picture format", where=where, allowed=allowed)
    if not done:
        raise InputError(f"a picture cannot be written as {ending}", where=where, value=image.shape)
    return data.tobytes()


def write_picture(path: Path, image: Bytes) -> None:
    """Write a picture in the format that the file's ending names; PNG without one.

    Parameters
    ----------
    path : Path, the file; replaced where it is there
    image : (H, W) grey or (H, W, 3) RGB uint8 array

    Raises
    ------
    InputError
        There is no such format, it cannot hold a picture of that shape, or the disk refuses.
    """
    write_atomically(path, encoded(image, path.suffix or ".png", where=path))
