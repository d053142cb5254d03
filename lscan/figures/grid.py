"""Scattered points of a surface averaged onto a regular grid, for pictures."""

from dataclasses import dataclass

import numpy as np

from lscan.errors import MeasurementError
from lscan.records import Floats

CELL_MM = 1.5
"""The least cell of the grids drawn: three of the paper's steps."""


@dataclass(frozen=True)
class NodeHeights:
    """Heights on a regular grid of C by R nodes.

    Attributes
    ----------
    x_mm : (C,) array, mm, of the nodes
    y_mm : (R,) array, mm, of the nodes
    z_mm : (R, C) array, mm, heights; NaN where there is no point near the node
    """

    x_mm: Floats
    y_mm: Floats
    z_mm: Floats


def grid_heights(xyz_mm: Floats, cell_mm: float) -> NodeHeights:
    """The mean height about each node of a grid.

    Each point counts at its four nearest nodes with the weights of bilinear interpolation, so that
    a plane sampled evenly stays a plane.

    Parameters
    ----------
    xyz_mm : (..., 3) array, mm, points in any frame with z up; NaN where there is none
    cell_mm : float, mm, from node to node along x and along y

    Raises
    ------
    MeasurementError
        Where there is no point at all.

    Examples
    --------
    >>> corners = np.array([[0.0, 0.0, 1.0], [2.0, 0.0, 1.0], [0.0, 2.0, 3.0], [2.0, 2.0, 3.0]])
    >>> grid_heights(corners, cell_mm=2.0).z_mm[:2, :2]
    array([[1., 1.],
           [3., 3.]])
    """
    points = xyz_mm.reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) == 0:
        raise MeasurementError("the surface holds no point to draw")
    start = np.floor(points[:, :2].min(axis=0) / cell_mm)
    place = points[:, :2] / cell_mm - start
    columns, rows = (int(n) for n in np.floor(place.max(axis=0)) + 2)
    weight, total = np.zeros(rows * columns), np.zeros(rows * columns)
    whole = np.floor(place).astype(np.int64)
    part = place - whole
    for right, up in ((0, 0), (1, 0), (0, 1), (1, 1)):
        share = np.abs(1 - right - part[:, 0]) * np.abs(1 - up - part[:, 1])
        node = (whole[:, 1] + up) * columns + whole[:, 0] + right
        weight += np.bincount(node, share, minlength=rows * columns)
        total += np.bincount(node, share * points[:, 2], minlength=rows * columns)
    # A node that points only graze, on a rim or in a shadow, would invent a height there.
    held = weight > 0.25
    z_mm = np.where(held, total / np.where(held, weight, 1.0), np.nan).reshape(rows, columns)
    x_mm, y_mm = ((start[k] + np.arange(n)) * cell_mm for k, n in enumerate((columns, rows)))
    return NodeHeights(x_mm, y_mm, z_mm)


def cell_for(xyz_mm: Floats, least_mm: float, most_nodes: int = 220) -> float:
    """The cell in mm that fits a scan: no finer than its points, nor than ``least_mm``.

    Parameters
    ----------
    xyz_mm : (F, N, 3) array, mm, F profiles of N points; NaN where there is none
    least_mm : float, mm, the least cell
    most_nodes : int, along the longer side of the surface
    """
    steps = [_typical_step(xyz_mm[..., 1], axis=0), _typical_step(xyz_mm[..., 0], axis=1)]
    plan = xyz_mm[..., :2].reshape(-1, 2)
    plan = plan[np.isfinite(plan).all(axis=1)]
    extent = float(np.ptp(plan, axis=0).max()) if len(plan) else 0.0
    return max(least_mm, 1.5 * max(steps), extent / most_nodes)


def height_range(xyz_mm: Floats) -> tuple[float, float]:
    """Lowest and highest height in mm, less the outermost half percent each.

    Parameters
    ----------
    xyz_mm : (..., 3) array, mm, points with z up; NaN where there is none
    """
    low, high = np.nanpercentile(xyz_mm[..., 2], (0.5, 99.5))
    return float(low), float(high)


def _typical_step(values: Floats, axis: int) -> float:
    step = np.abs(np.diff(values, axis=axis))
    finite = step[np.isfinite(step)]
    return float(np.median(finite)) if len(finite) else 0.0
