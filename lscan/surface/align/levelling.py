"""The matrices of an alignment: the shear of the yaw, and the levelling of eqs. (5) to (7)."""

import numpy as np

from lscan.errors import MeasurementError
from lscan.records import Floats


def shear(yaw_rad: float) -> Floats:
    """(3, 3) matrix from raw points (x, s, z) to true points in the head's axes.

    Parameters
    ----------
    yaw_rad : float, rad, angle of the sheet against the track
    """
    return np.array([[1.0, np.sin(yaw_rad), 0.0], [0.0, np.cos(yaw_rad), 0.0], [0.0, 0.0, 1.0]])


def levelling_step(normal: Floats) -> Floats:
    """(3, 3) rotation R_x R_y of eqs. (5) to (7) that levels a base plane.

    As printed, with alpha = -asin(n_y) and beta = asin(n_x), eqs. (5) and (6) would turn a
    level plane (alpha = beta = 0) by 90 degrees about both axes: their sines and cosines hold
    for angles counted from the axes, that is for alpha + 90° and beta + 90°.  With these put
    in, sin becomes cos and cos becomes -sin, as here; then R_x R_y n is
    (0, 0, 1) but for terms of third order in the tilt, and repeating it (eq. 7) removes those.

    Parameters
    ----------
    normal : (3,) array, unit normal of the base plane

    References
    ----------
    Eqs. (5) to (7) of the paper.

    Examples
    --------
    >>> normal = np.array([0.0, 0.6, 0.8])
    >>> (levelling_step(normal) @ normal).round(6) + 0.0
    array([0., 0., 1.])
    """
    alpha, beta = -np.arcsin(normal[1]), np.arcsin(normal[0])
    sin_a, cos_a, sin_b, cos_b = np.sin(alpha), np.cos(alpha), np.sin(beta), np.cos(beta)
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cos_a, sin_a], [0.0, -sin_a, cos_a]])
    about_y = np.array([[cos_b, 0.0, -sin_b], [0.0, 1.0, 0.0], [sin_b, 0.0, cos_b]])
    return about_x @ about_y


def level(points_mm: Floats) -> Floats:
    """(3, 3) rotation that levels the base plane of points.

    Eq. (7) repeated, the plane fitted anew each time, until its normal settles at (0, 0, 1).

    Parameters
    ----------
    points_mm : (K, 3) array, mm, of the base plane, frame of the head

    Raises
    ------
    MeasurementError
        Where the points carry no plane.

    References
    ----------
    Eqs. (5) to (7) of the paper.
    """
    rotation = np.eye(3)
    for _ in range(20):
        normal = plane_normal(points_mm @ rotation.T)
        if np.hypot(normal[0], normal[1]) < 1e-12:
            break
        rotation = levelling_step(normal) @ rotation
    return rotation


def plane_normal(points_mm: Floats) -> Floats:
    """(3,) upward unit normal of the least-squares plane of points.

    Parameters
    ----------
    points_mm : (K, 3) array, mm

    Raises
    ------
    MeasurementError
        For fewer than three points, or points on one line.
    """
    if len(points_mm) < 3:
        raise MeasurementError(f"base plane: {len(points_mm)} points, 3 are needed")
    centred = points_mm - points_mm.mean(axis=0)
    spread, axes = np.linalg.eigh(centred.T @ centred)
    if spread[1] < 1e-9 * spread[2]:
        raise MeasurementError("base plane: the points lie on one line")
    normal = axes[:, 0]
    return normal if normal[2] > 0 else -normal
