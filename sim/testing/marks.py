"""What a test picture carries in its pixels: which exposure it is, when and where it was taken."""

import struct
import zlib
from dataclasses import astuple, dataclass

import numpy as np

from lscan.records import Bytes

_FIELDS = struct.Struct("<Qdd?")
_CHECK = struct.Struct("<I")
LENGTH = _FIELDS.size + _CHECK.size


@dataclass(frozen=True)
class ExposureMark:
    """One exposure.  counter: no two exposures have the same.

    exposed_s: on the machine's monotonic clock.  head_mm: where the head truly stood, counted
    from the switch.  moving: whether it moved.
    """

    counter: int
    exposed_s: float
    head_mm: float
    moving: bool


def draw_mark(image: Bytes, mark: ExposureMark) -> None:
    """Write the mark, with its CRC-32, into the first pixels of the top row.

    image: (H, W, 3) uint8, W at least LENGTH.  All colours get the same bytes, so that it
    does not matter in which order they are kept.
    """
    data = _FIELDS.pack(*astuple(mark))
    data += _CHECK.pack(zlib.crc32(data))
    image[0, :LENGTH] = np.frombuffer(data, np.uint8)[:, None]


def read_mark(image: Bytes) -> ExposureMark | None:
    """The mark of a picture; None where it carries none that is whole.

    Parameters
    ----------
    image : (H, W, 3) uint8 array
    """
    if image.ndim != 3 or image.shape[1] < LENGTH:
        return None
    first = image[0, :LENGTH]
    if (first != first[:, :1]).any():
        return None
    data = first[:, 0].tobytes()
    if zlib.crc32(data[: _FIELDS.size]) != _CHECK.unpack(data[_FIELDS.size :])[0]:
        return None
    return ExposureMark(*_FIELDS.unpack(data[: _FIELDS.size]))
