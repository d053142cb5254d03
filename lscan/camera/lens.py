"""Brown-Conrady distortion and its inverse (Brown 1971, Conrady 1919; OpenCV's notation)."""

from functools import lru_cache

import numpy as np

from lscan.camera.model import CameraModel
from lscan.records import Floats

SMALL_STEP = 1e-10  # tangents; a Newton step this small leaves an error at float64's rounding
MOST_STEPS = 50


def distort(camera: CameraModel, tangents: Floats) -> Floats:
    """(N, 2) distorted tangents; NaN beyond the radius at which the radial distortion folds back.

    Parameters
    ----------
    camera : CameraModel, whose k1, k2, k3, p1 and p2 count
    tangents : (N, 2) array, x/z and y/z of directions in air, camera frame
    """
    inside = np.hypot(*tangents.T) < fold_radius(camera)
    x, y = np.where(inside[:, None], tangents, np.nan).T
    return np.column_stack(_bent(camera, x, y, *_radial(camera, x, y)))


def undistort(camera: CameraModel, distorted: Floats) -> Floats:
    """(N, 2) tangents that ``distort`` takes to given ones; NaN where nothing is imaged there.

    By Newton's method from the distorted tangents.

    Parameters
    ----------
    camera : CameraModel, whose k1, k2, k3, p1 and p2 count
    distorted : (N, 2) array, pixels less the centre, over the focal length
    """
    tangents = distorted
    step = np.zeros_like(distorted)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for _ in range(MOST_STEPS):
            step = _newton_step(camera, tangents, distorted)
            tangents = tangents - step
            if not (np.abs(step) > SMALL_STEP).any():  # NaN never converges, and need not
                break
        arrived = (np.abs(step) <= SMALL_STEP).all(axis=1)
        arrived &= np.hypot(*tangents.T) < fold_radius(camera)
    return np.where(arrived[:, None], tangents, np.nan)


def fold_radius(camera: CameraModel) -> float:
    """Undistorted radius where the radial distortion turns back; infinite where it never does.

    Parameters
    ----------
    camera : CameraModel, whose k1, k2 and k3 count
    """
    return _fold_radius(camera.k1, camera.k2, camera.k3)


@lru_cache(maxsize=1024)  # a fit asks for few distortions many times
def _fold_radius(k1: float, k2: float, k3: float) -> float:
    # d(r + k1 r^3 + k2 r^5 + k3 r^7)/dr = 0, as a polynomial in 1/r^2.
    inverse = np.roots([1.0, 3 * k1, 5 * k2, 7 * k3])
    real = inverse.real[(np.abs(inverse.imag) < 1e-12) & (inverse.real > 0)]
    return float(1 / np.sqrt(real.max())) if len(real) else np.inf


def _radial(camera: CameraModel, x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """(N,) squares of the radius, and by what factor the radial distortion lengthens it."""
    q = x * x + y * y
    return q, 1 + q * (camera.k1 + q * (camera.k2 + q * camera.k3))


def _bent(
    camera: CameraModel, x: Floats, y: Floats, q: Floats, radial: Floats
) -> tuple[Floats, Floats]:
    """(N,) distorted tangents across and down."""
    across = x * radial + 2 * camera.p1 * x * y + camera.p2 * (q + 2 * x * x)
    down = y * radial + camera.p1 * (q + 2 * y * y) + 2 * camera.p2 * x * y
    return across, down


def undistort_derivatives(camera: CameraModel, tangents: Floats) -> tuple[Floats, Floats]:
    """Derivatives of ``undistort`` by the distorted tangents and by the coefficients.

    Parameters
    ----------
    camera : CameraModel, whose k1, k2, k3, p1 and p2 count
    tangents : (N, 2) array, that ``undistort`` found

    Returns
    -------
    tuple of array
        (N, 2, 2), and (N, 2, 5) by k1, k2, p1, p2 and k3.
    """
    x, y = tangents.T
    q, cross = x * x + y * y, 2 * x * y
    by_coefficients = np.array(
        [
            [x * q, x * q**2, cross, q + 2 * x * x, x * q**3],
            [y * q, y * q**2, q + 2 * y * y, cross, y * q**3],
        ]
    )
    inverse = _inverse_jacobian(camera, tangents)
    return inverse, -inverse @ np.moveaxis(by_coefficients, 2, 0)


def _newton_step(camera: CameraModel, tangents: Floats, distorted: Floats) -> Floats:
    """(N, 2) by which ``tangents`` are too large, to first order."""
    x, y = tangents.T
    q, radial = _radial(camera, x, y)
    bent_x, bent_y = _bent(camera, x, y, q, radial)
    across, down = bent_x - distorted[:, 0], bent_y - distorted[:, 1]
    by_x, cross, by_y = _jacobian(camera, x, y, q, radial)
    steps = np.empty_like(tangents)
    steps[:, 0] = by_y * across - cross * down
    steps[:, 1] = by_x * down - cross * across
    return steps / (by_x * by_y - cross * cross)[:, None]


def _inverse_jacobian(camera: CameraModel, tangents: Floats) -> Floats:
    """(N, 2, 2) derivatives of tangents by the distorted ones."""
    x, y = tangents.T
    by_x, cross, by_y = _jacobian(camera, x, y, *_radial(camera, x, y))
    inverse = np.array([[by_y, -cross], [-cross, by_x]]) / (by_x * by_y - cross * cross)
    return np.moveaxis(inverse, 2, 0)


def _jacobian(
    camera: CameraModel, x: Floats, y: Floats, q: Floats, radial: Floats
) -> tuple[Floats, Floats, Floats]:
    """(N,) derivatives: of x distorted by x, of either by the other, of y distorted by y."""
    by_q = 2 * (camera.k1 + q * (2 * camera.k2 + q * 3 * camera.k3))  # of radial, twice
    by_x = radial + by_q * x * x + 2 * camera.p1 * y + 6 * camera.p2 * x
    cross = by_q * x * y + 2 * camera.p1 * x + 2 * camera.p2 * y
    by_y = radial + by_q * y * y + 6 * camera.p1 * y + 2 * camera.p2 * x
    return by_x, cross, by_y
