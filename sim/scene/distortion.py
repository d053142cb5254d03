"""Whether a lens images its whole picture, or its distortion folds before the border.

A distortion polynomial has no inverse far off the axis.  A place of the picture is imaged where
the straight way to it from the axis can be followed in undistorted tangents, along which two
things are positive: the Jacobian's determinant of the whole distortion, and the growth of its
radial part, beyond whose turn neither truth nor instrument follow a lens.

Tangents are complex here, z = x + i y.  With q = |z|2 and P = p2 + i p1 the distortion (Brown
1971, Conrady 1919, as OpenCV writes it) is z R(q) + conj(P) z2 + 2 P q.  Its derivatives by z and
by conj(z) are a = R + q R' + 4 Re(conj(P) z), which is real, and b = z2 R' + 2 P z; the
determinant is a2 - |b|2.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from lscan.records import Floats
from sim.scene.instrument import Lens

Complexes = NDArray[np.complex128]

ALONG_BORDER = 17  # places on each side of the picture, its corners among them
STEPS = 16  # of the way from the axis to each place
# Iterations a step, at most: each halves the error close to a fold, and leaves two thirds of it
# where the distortion hardly grows: 3e-6 in the end.
NEWTON = 32
BETWEEN = np.arange(1, 5).reshape(-1, 1) / 4  # where the way is looked at within a step
FOUND_PX = 1e-3


@lru_cache(maxsize=256)  # a scene is read many times
def is_folded(lens: Lens, width_px: int, height_px: int) -> bool:
    """Whether the distortion folds somewhere in the picture, its outermost edge included.

    Parameters
    ----------
    lens : Lens, whose distortion is meant
    width_px, height_px : int, px, of the picture
    """
    border = _border(lens, width_px, height_px)
    found = np.zeros_like(border)
    with np.errstate(all="ignore"):  # beyond a fold Newton's method goes anywhere, or to NaN
        for part in np.arange(1, STEPS + 1) / STEPS:
            before = found
            for _ in range(NEWTON):
                found = found - (step := _newton_step(lens, found, part * border))
                if not (np.abs(step) * lens.focal_px > FOUND_PX).any():
                    break  # most lenses settle in a few
            off_px = np.abs(_distorted(lens, found) - part * border) * lens.focal_px
            least = _least_growth(lens, before + BETWEEN * (found - before))
            if not (np.all(off_px < FOUND_PX) and np.all(least > 0)):
                return True
    return False


def _border(lens: Lens, width_px: int, height_px: int) -> Complexes:
    """(N,) distorted tangents of the picture's edge."""
    u = np.linspace(-0.5, width_px - 0.5, ALONG_BORDER)
    v = np.linspace(-0.5, height_px - 0.5, ALONG_BORDER)
    sides = [u + 1j * v[0], u + 1j * v[-1], u[0] + 1j * v, u[-1] + 1j * v]
    return np.asarray((np.concatenate(sides) - complex(*lens.centre_px)) / lens.focal_px)


def _terms(lens: Lens, z: Complexes) -> tuple[Floats, Floats, Floats, complex]:
    """q, R, R' and P."""
    q = z.real**2 + z.imag**2
    radial = 1 + q * (lens.k1 + q * (lens.k2 + q * lens.k3))
    return q, radial, lens.k1 + q * (2 * lens.k2 + q * 3 * lens.k3), complex(lens.p2, lens.p1)


def _distorted(lens: Lens, z: Complexes) -> Complexes:
    q, radial, _, decentring = _terms(lens, z)
    return z * radial + decentring.conjugate() * z**2 + 2 * decentring * q


def _derivatives(lens: Lens, z: Complexes) -> tuple[Floats, Complexes]:
    """By z and by conj(z)."""
    q, radial, slope, decentring = _terms(lens, z)
    by_z = radial + q * slope + 4 * (decentring.conjugate() * z).real
    return by_z, z**2 * slope + 2 * decentring * z


def _newton_step(lens: Lens, z: Complexes, distorted: Complexes) -> Complexes:
    """By how much z is too large, to first order."""
    by_z, by_conjugate = _derivatives(lens, z)
    off = _distorted(lens, z) - distorted
    return (by_z * off - by_conjugate * off.conj()) / (by_z**2 - np.abs(by_conjugate) ** 2)


def _least_growth(lens: Lens, z: Complexes) -> Floats:
    """The Jacobian's determinant, or the growth of the distorted radius where that is less."""
    by_z, by_conjugate = _derivatives(lens, z)
    q, radial, slope, _ = _terms(lens, z)
    return np.minimum(by_z**2 - np.abs(by_conjugate) ** 2, radial + 2 * q * slope)
