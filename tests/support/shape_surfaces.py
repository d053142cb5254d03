"""Points of planes, spheres and cylinders in closed form, with noise and errors in common."""

import numpy as np

from lscan.measure.shapes import MeasuredPoints
from lscan.records import Floats, Surface

SPAN_MM = 40.0
RADIUS_MM = 30.0


def plan(count: int = 21) -> tuple[Floats, Floats]:
    """x and y, (count, count) each, of a square of SPAN_MM about the origin."""
    axis = np.linspace(-SPAN_MM / 2, SPAN_MM / 2, count)
    x, y = np.meshgrid(axis, axis)
    return x, y


def dome(x: Floats, y: Floats) -> Floats:
    """Heights of a sphere of RADIUS_MM about the origin."""
    return np.sqrt(RADIUS_MM**2 - x**2 - y**2)


def ridge(x: Floats, y: Floats) -> Floats:
    """Heights of a cylinder of RADIUS_MM about the y axis."""
    return np.sqrt(RADIUS_MM**2 - x**2) + 0 * y


def surface_of(x: Floats, y: Floats, z: Floats, sigma_mm: float = 0.05) -> Surface:
    """The surface of heights (F, N), whose z alone is uncertain."""
    return Surface(
        xyz_mm=np.stack([x, y, z], axis=-1),
        sigma_x_mm=np.zeros(z.shape),
        sigma_z_mm=np.full(z.shape, sigma_mm),
        status=np.zeros(z.shape, dtype=np.int64),
        position_mm=np.arange(len(z), dtype=float),
        frame="workpiece",
    )


def points_of(
    xyz: Floats, sigma_mm: float = 0.05, modes_mm: Floats | None = None
) -> MeasuredPoints:
    """Points (K, 3), mm, alike uncertain along all axes."""
    own = np.full(xyz.shape, sigma_mm**2)
    return MeasuredPoints(xyz, own, np.zeros((*xyz.shape, 0)) if modes_mm is None else modes_mm)


def common_errors(xyz: Floats) -> Floats:
    """(..., 3, 3) three errors that all points share: a stretch along x, a bend and a tilt."""
    x, _, z = np.moveaxis(xyz / SPAN_MM, -1, 0)
    nought = np.zeros_like(x)
    fields = [(x, nought, nought), (nought, nought, x**2), (-z, nought, x)]
    return 0.05 * np.stack([np.stack(field, axis=-1) for field in fields], axis=-1)
