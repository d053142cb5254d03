"""The circle that lies closest to points in a plane."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from lscan.errors import MeasurementError
from lscan.records import Floats


@dataclass(frozen=True)
class Circle:
    """A fitted circle.

    Attributes
    ----------
    centre_mm : (2,) array, mm, frame of the points
    radius_mm : float, mm
    diameter_sigma_mm : float, mm, standard uncertainty of the diameter where the points err
        independently
    radius_by_point : (K, 2) array, derivative of the radius by each point's (x, z)
    """

    centre_mm: Floats
    radius_mm: float
    diameter_sigma_mm: float
    radius_by_point: Floats


def fit_circle(points_mm: Floats, sigma_mm: Floats) -> Circle:
    """The circle of least squared distances to points.

    Parameters
    ----------
    points_mm : (K, 2) array, mm, in any plane
    sigma_mm : (K,) array, mm, standard uncertainty of each point's distance from the circle; points
        are weighted by it

    Returns
    -------
    Circle
        Its uncertainty is that of the sigmas given or that of the points' scatter, whichever is
        the larger.

    Raises
    ------
    MeasurementError
        For fewer than four points, or points that lie on a line.

    References
    ----------
    Starts from the algebraic circle of I. Kasa, IEEE Trans. Instrum. Meas. 25, 8 (1976).

    Examples
    --------
    >>> corners = np.array([[0.0, 0.0], [0.0, 6.0], [8.0, 0.0], [8.0, 6.0]])
    >>> round(fit_circle(corners, np.full(4, 0.1)).radius_mm, 6)
    5.0
    """
    if len(points_mm) < 4:
        raise MeasurementError(f"circle: {len(points_mm)} points, 4 are needed")
    root = 1 / np.maximum(sigma_mm, 1e-6)

    def weighted(parameters: Floats) -> Floats:
        return (np.linalg.norm(points_mm - parameters[:2], axis=1) - parameters[2]) * root

    def jacobian(parameters: Floats) -> Floats:
        return _by_parameters(points_mm, parameters) * root[:, None]

    fit = least_squares(weighted, _algebraic(points_mm), jacobian, method="lm", xtol=1e-12)
    design = jacobian(fit.x)
    inverse = np.linalg.inv(design.T @ design).astype(float)
    scatter = 2 * float(fit.cost) / max(len(points_mm) - 3, 1)
    by_distance = -(inverse @ design.T)[2] * root  # of the radius, by each residual
    return Circle(
        centre_mm=fit.x[:2],
        radius_mm=float(fit.x[2]),
        diameter_sigma_mm=2 * float(np.sqrt(inverse[2, 2] * max(1.0, scatter))),
        radius_by_point=-by_distance[:, None] * _by_parameters(points_mm, fit.x)[:, :2],
    )


def _by_parameters(points: Floats, parameters: Floats) -> Floats:
    """(K, 3) derivatives of the points' distances from the circle by its centre and radius."""
    away = points - parameters[:2]
    distance = np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)
    return np.column_stack([-away / distance, -np.ones(len(points))])


def _algebraic(points: Floats) -> Floats:
    """(3,) centre and radius that minimise the squared x² + z² + D x + E z + F."""
    middle = points.mean(axis=0)
    centred = points - middle
    spread = np.linalg.eigvalsh(centred.T @ centred)
    if spread[0] < 1e-9 * spread[1] or spread[1] == 0:
        raise MeasurementError("circle: its points lie on a straight line")
    return algebraic_ball(points)


def algebraic_ball(points_mm: Floats) -> Floats:
    """(D + 1,) centre and radius, mm, of the algebraic circle, or sphere, of points.

    They minimise the squared |p|² + a . p + b.

    Parameters
    ----------
    points_mm : (K, D) array, mm, D of 2 or 3

    References
    ----------
    I. Kasa, IEEE Trans. Instrum. Meas. 25, 8 (1976).
    """
    middle = points_mm.mean(axis=0)
    centred = points_mm - middle
    design = np.column_stack([centred, np.ones(len(points_mm))])
    solution = np.linalg.lstsq(design, -(centred**2).sum(axis=1), rcond=None)[0]
    centre = -solution[:-1] / 2
    radius = np.sqrt(max(float(centre @ centre - solution[-1]), 0.0))
    return np.array([*(centre + middle), radius])
