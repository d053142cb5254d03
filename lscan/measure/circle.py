"""The circle that lies closest to points in a plane."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lscan.errors import MeasurementError
from lscan.records import Floats


@dataclass(frozen=True)
class Circle:
    """A fitted circle.

    centre_mm: (2,).  radius_mm.  covariance: (3, 3) of centre and radius, mm².
    rms_mm: scatter of the points about it, for the degrees of freedom left.
    radius_by_point: (K, 2) derivative of the radius by each point's (x, z).
    """

    centre_mm: Floats
    radius_mm: float
    covariance: Floats
    rms_mm: float
    radius_by_point: Floats

    @property
    def diameter_sigma_mm(self) -> float:
        """Standard uncertainty of the diameter, mm, where the points err independently."""
        return 2 * float(np.sqrt(self.covariance[2, 2]))


def fit_circle(points_mm: Floats, sigma_mm: Floats) -> Circle:
    """The circle of least squared distances to the points (K, 2), mm.

    sigma_mm: (K,) standard uncertainty of each point's distance from it; points are weighted
    by it.  Gauss-Newton with Levenberg's damping from the algebraic circle of Kasa (IEEE Trans.
    Instrum. Meas. 25, 8, 1976).  The covariance is that of the sigmas given or that of the
    points' scatter, whichever is the larger.

    Raises MeasurementError for fewer than four points, or points that lie on a line.
    """
    if len(points_mm) < 4:
        raise MeasurementError(f"circle: {len(points_mm)} points, 4 are needed")
    root = 1 / np.maximum(sigma_mm, 1e-6)
    parameters = _closest(points_mm, root, _algebraic(points_mm))
    residual, jacobian = _distances(points_mm, parameters)
    weighted = jacobian * root[:, None]
    inverse = np.linalg.inv(weighted.T @ weighted).astype(float)
    freedom = max(len(points_mm) - 3, 1)
    scatter = float(np.sum((residual * root) ** 2)) / freedom
    by_distance = -(inverse @ weighted.T)[2] * root  # of the radius, by each residual
    return Circle(
        centre_mm=parameters[:2],
        radius_mm=float(parameters[2]),
        covariance=inverse * max(1.0, scatter),
        rms_mm=float(np.sqrt(np.sum(residual**2) / freedom)),
        radius_by_point=-by_distance[:, None] * jacobian[:, :2],
    )


def _closest(points: Floats, root: Floats, parameters: Floats) -> Floats:
    """(3,) centre and radius of least squares, from the start ``parameters``."""
    residual, jacobian = _distances(points, parameters)
    damping = 1e-3
    for _ in range(100):
        weighted = jacobian * root[:, None]
        normal = weighted.T @ weighted
        gradient = weighted.T @ (residual * root)
        damped = normal + damping * np.diag(np.diag(normal))
        step = np.linalg.solve(damped, -gradient).astype(float)
        trial = _distances(points, parameters + step)
        if np.sum((trial[0] * root) ** 2) <= np.sum((residual * root) ** 2):
            parameters, (residual, jacobian) = parameters + step, trial
            damping /= 10
        else:
            damping *= 10
        if np.abs(step).max() < 1e-10 * parameters[2]:
            break
    return parameters


def _algebraic(points: Floats) -> Floats:
    """(3,) centre and radius that minimise the squared x² + z² + D x + E z + F."""
    middle = points.mean(axis=0)
    centred = points - middle
    spread = np.linalg.eigvalsh(centred.T @ centred)
    if spread[0] < 1e-9 * spread[1] or spread[1] == 0:
        raise MeasurementError("circle: its points lie on a straight line")
    design = np.column_stack([centred, np.ones(len(points))])
    solution = np.linalg.lstsq(design, -(centred**2).sum(axis=1), rcond=None)[0]
    centre = -solution[:2] / 2
    radius = np.sqrt(max(float(centre @ centre - solution[2]), 0.0))
    return np.array([*(centre + middle), radius])


def _distances(points: Floats, parameters: Floats) -> tuple[Floats, Floats]:
    """(K,) signed distance of each point from the circle, and its (K, 3) derivatives."""
    away = points - parameters[:2]
    distance = np.maximum(np.hypot(away[:, 0], away[:, 1]), 1e-12)
    jacobian = np.column_stack([-away / distance[:, None], -np.ones(len(points))])
    return distance - parameters[2], jacobian
