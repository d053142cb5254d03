"""Numbers that may change between frames or rigs without a kernel being compiled anew."""

from collections.abc import Iterable

import drjit as dr
import mitsuba as mi


def opaque(value: float) -> mi.Float:
    """The number as a Dr.Jit value that kernels read from memory."""
    return dr.opaque(mi.Float, float(value))


def opaque_vector(values: Iterable[float]) -> mi.Vector3f:
    """Three numbers as an opaque vector."""
    return mi.Vector3f(*(opaque(value) for value in values))
