"""A frame that a camera or a program drew along the edge of its pictures."""

import numpy as np

from lscan.records import Bytes

_WIDEST_PX = 8  # a block of JPEG: as far as cameras fill up a width that is no multiple of it
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
    if lines.shape[1] <= 2 * _WIDEST_PX + 1:
        return 0, 0
    return _depth(lines[:, : _WIDEST_PX + 1]), _depth(lines[:, : -_WIDEST_PX - 2 : -1])


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
