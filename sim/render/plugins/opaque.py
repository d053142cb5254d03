"""Numbers that may change between frames or rigs without a kernel being compiled anew."""

from collections.abc import Iterable

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from lscan.records import Floats

ALIGNED = 16  # numbers: where memory begins elsewhere, kernels of their own are compiled for it


def opaque(value: float) -> mi.Float:
    """The number as a Dr.Jit value that kernels read from memory."""
    return dr.opaque(mi.Float, float(value))


def opaque_vector(values: Iterable[float]) -> mi.Vector3f:
    """Three numbers as an opaque vector."""
    return mi.Vector3f(*(opaque(value) for value in values))


def aligned(values: Floats | NDArray[np.float32]) -> mi.Float:
    """The values of an array, row by row, for the one kernel that all such arrays share."""
    room = np.empty(values.size + ALIGNED, np.float32)
    first = -(room.ctypes.data // room.itemsize) % ALIGNED
    copy = room[first : first + values.size]
    copy[:] = np.ravel(values)
    return mi.Float(copy)
