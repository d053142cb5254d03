"""Picture files: read strictly, written whole or not at all; colour is RGB everywhere else."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from lscan.disk import read_bytes, write_atomically
from lscan.errors import InputError
from lscan.records import Bytes

FORMATS = "PNG, JPEG, BMP, TIFF or WebP, 8 bit"


def read_picture(path: Path) -> Bytes:
    """The picture in a file, (H, W) grey or (H, W, 3) RGB uint8.

    Raises InputError where the file is missing, is no picture, or is not of 8 bit.
    """
    data = np.frombuffer(read_bytes(path), np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    if image is None:
        raise InputError("is not a picture that can be read", where=path, allowed=FORMATS)
    if image.dtype != np.uint8:
        raise InputError("has the wrong depth", where=path, value=str(image.dtype), allowed=FORMATS)
    if image.ndim == 2 or image.shape[2] == 1:
        return image.reshape(image.shape[:2])
    if image.shape[2] == 4:
        image = image[..., :3]
    return np.ascontiguousarray(image[..., ::-1])


def write_picture(path: Path, image: Bytes) -> None:
    """Write (H, W) grey or (H, W, 3) RGB to ``path``, in the format its ending names."""
    stored = image[..., ::-1] if image.ndim == 3 else image
    try:
        done, data = cv2.imencode(path.suffix or ".png", np.ascontiguousarray(stored))
    except cv2.error:
        done = False
    if not done:
        raise InputError("unknown picture format", where=path, allowed=".png, .jpg, .bmp, .tif")
    write_atomically(path, data.tobytes())
