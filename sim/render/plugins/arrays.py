"""NumPy's arrays as Dr.Jit's, copied to memory that kernels may read.

Dr.Jit reads an array of NumPy's in place, and whole vectors of it: up to 15 numbers behind its end,
where there may be no memory of the process.  It also compiles a kernel of its own where an array
begins elsewhere in a cache line.  So every array goes through here.
"""

from collections.abc import Iterable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

VECTOR = 16  # numbers of 4 bytes: those of a cache line, and of the longest vector


def floats(values: ArrayLike) -> mi.Float:
    """The numbers of an array, row by row.

    Parameters
    ----------
    values : array of any shape
    """
    return mi.Float(_roomy(values, np.float32))


def indices(values: ArrayLike) -> mi.UInt32:
    """The integers of an array, row by row.

    Parameters
    ----------
    values : array of any shape, 0 to 2**32 - 1
    """
    return mi.UInt32(_roomy(values, np.uint32))


def long_indices(values: ArrayLike) -> mi.UInt64:
    """The integers of an array, row by row.

    Parameters
    ----------
    values : array of any shape, 0 to 2**64 - 1
    """
    return mi.UInt64(_roomy(values, np.uint64))


def vectors(rows: ArrayLike) -> mi.Vector3f:
    """The columns of three rows.

    Parameters
    ----------
    rows : (3, N) array
    """
    return mi.Vector3f(*map(floats, np.asarray(rows)))


def _roomy(values: ArrayLike, kind: DTypeLike) -> NDArray[Any]:
    """A copy that begins where a cache line does and ends well within memory of its own."""
    flat = np.ravel(values)
    room = np.empty(flat.size + 2 * VECTOR, kind)
    first = -(room.ctypes.data // room.itemsize) % VECTOR
    copy = room[first : first + flat.size]
    copy[:] = flat
    return copy


# Numbers that may change between frames or rigs without a kernel being compiled anew.


def opaque(value: float) -> mi.Float:
    """The number as a Dr.Jit value that kernels read from memory."""
    return dr.opaque(mi.Float, float(value))


def opaque_vector(values: Iterable[float]) -> mi.Vector3f:
    """Three numbers as an opaque vector."""
    return mi.Vector3f(*(opaque(value) for value in values))
