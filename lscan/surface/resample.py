"""Slices of an aligned surface: the height along a straight line in plan (Fig. 28)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from lscan.errors import InputError, MeasurementError
from lscan.records import Floats, Ints, Mask, Status, Surface, has_value

NEIGHBOURS = 32
"""Most points one plane is fitted to; a full circle of the radius below holds about 15."""

RADIUS_IN_SAMPLES = 1.6
"""Radius of the neighbourhood in units of the coarser of the two sample spacings."""


@dataclass(frozen=True)
class Slice:
    """Heights along a line in plan.

    xy_mm: (M, 2) where; along_mm: (M,) distance from the line's start.
    z_mm: (M,) height; NaN where the status is NO_DATA.
    sigma_mm: (M,) standard uncertainty of z.  status: (M,) of Status.
    radius_mm: how far around a point measurements were used; beyond it there is no data.
    """

    xy_mm: Floats
    along_mm: Floats
    z_mm: Floats
    sigma_mm: Floats
    status: Ints
    radius_mm: float


def resample(surface: Surface, line: tuple[Floats, Floats], step_mm: float = 0.5) -> Slice:
    """The height of ``surface`` every ``step_mm`` along ``line``, its two ends (x, y) in mm.

    At each point a plane is fitted by least squares to the measurements within a radius of
    RADIUS_IN_SAMPLES sample spacings.  Nothing is interpolated across holes: where the points
    around do not enclose the place, so that the plane's height there is less certain than a
    single measurement, the status is NO_DATA.

    Raises InputError for a line without length or a step that is not positive,
    MeasurementError for a surface without points.
    """
    start, end = np.asarray(line[0], dtype=float), np.asarray(line[1], dtype=float)
    length = float(np.linalg.norm(end - start))
    if not np.isfinite(length) or length == 0:
        raise InputError("slice has no length", where="slice", value=line, allowed="two points")
    if not step_mm > 0:
        raise InputError("step is not positive", where="slice", value=step_mm, allowed="> 0 mm")
    along = np.linspace(0.0, length, max(round(length / step_mm), 1) + 1)
    xy = start + along[:, None] * (end - start) / length
    valid = has_value(surface.status) & np.isfinite(surface.xyz_mm).all(axis=-1)
    if not valid.any():
        raise MeasurementError("the surface holds no measured point to slice")
    radius = RADIUS_IN_SAMPLES * _spacing(surface.xyz_mm, valid)
    z, sigma = _local_planes(surface, valid, xy, radius)
    status = np.where(np.isfinite(z), Status.OK, Status.NO_DATA).astype(np.int64)
    return Slice(xy, along, z, sigma, status, radius)


def _spacing(xyz: Floats, valid: Mask) -> float:
    """The coarser of the median plan distances between neighbours in a row and in a column."""
    spacings = []
    for axis in (0, 1):
        both = np.take(valid, range(1, valid.shape[axis]), axis) & np.take(
            valid, range(valid.shape[axis] - 1), axis
        )
        steps = np.diff(xyz[..., :2], axis=axis)[both]
        if len(steps):
            spacings.append(float(np.median(np.hypot(steps[:, 0], steps[:, 1]))))
    if not spacings:
        raise MeasurementError("the surface has no two measured points side by side")
    return max(spacings)


def _local_planes(
    surface: Surface, valid: Mask, xy: Floats, radius: float
) -> tuple[Floats, Floats]:
    """(M,) height and its uncertainty at each of the places (M, 2), NaN without data."""
    points = surface.xyz_mm[valid]
    tree = cKDTree(points[:, :2])
    _, nearest = tree.query(xy, k=NEIGHBOURS, distance_upper_bound=radius)
    index = np.asarray(nearest)
    used: Mask = np.less(index, len(points))
    index = np.where(used, index, 0)
    near = points[index]
    offset = (near[..., :2] - xy[:, None]) / radius
    design = np.concatenate([np.ones((*used.shape, 1)), offset], axis=-1) * used[..., None]
    normal = np.einsum("mki,mkj->mij", design, design)
    good = (used.sum(axis=1) >= 4) & (np.linalg.det(normal) > 1e-6)
    inverse = np.linalg.inv(np.where(good[:, None, None], normal, np.eye(3)))
    # Row 0 of the solution operator: the weight each measurement has in the height here.
    weight = np.einsum("mj,mkj->mk", inverse[:, 0], design)
    good &= inverse[:, 0, 0] < 1
    slope_x = np.einsum("mj,mkj,mk->m", inverse[:, 1], design, near[..., 2]) / radius
    sigma_z, sigma_x = surface.sigma_mm[valid][index], surface.sigma_x_mm[valid][index]
    variance = sigma_z**2 + (slope_x[:, None] * sigma_x) ** 2
    z = np.einsum("mk,mk->m", weight, near[..., 2])
    sigma = np.sqrt(np.einsum("mk,mk->m", weight**2, variance))
    return np.where(good, z, np.nan), np.where(good, sigma, np.nan)
