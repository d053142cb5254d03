"""Heights on a regular grid: what is left of a surface's noise and calibration in each cell."""

from dataclasses import dataclass

import numpy as np

from lscan.errors import InputError, MeasurementError
from lscan.records import Floats, Ints, Mask, Status, Surface, has_value
from lscan.surface.alignment import own_variances

MIN_POINTS = 9
"""Fewest points of a cell: three to spare for the six coefficients of its quadratic."""

TERMS = 6
ENOUGH = 0.8  # of the cells of a fitting size: those at the rim are cut

LARGEST_GRID = 4_000_000
"""Most cells of a grid: 2000 by 2000, which is more than a scan has points."""


@dataclass(frozen=True)
class HeightGrid:
    """Heights at the centres of square cells, R rows along y by C columns along x.

    Attributes
    ----------
    x_mm : (C,) array, mm, of the centres, frame of the surface
    y_mm : (R,) array, mm, of the centres, frame of the surface
    cell_mm : float, mm, side of a cell
    z_mm : (R, C) array, mm, height at the centre; NaN where status is NO_DATA
    sigma_z_mm : (R, C) array, mm, standard uncertainty of z, all causes together
    status : (R, C) array, of Status
    points : (R, C) array, number of measurements in the cell
    modes_mm : (R, C, M) array or None, mm, the part of sigma_z_mm that cells have in common, as in
        PlanePoints: the covariance of the heights of two cells is the product of their modes; NaN
        without data.  None where the surface has none.
    """

    x_mm: Floats
    y_mm: Floats
    cell_mm: float
    z_mm: Floats
    sigma_z_mm: Floats
    status: Ints
    points: Ints
    modes_mm: Floats | None = None


@dataclass(frozen=True)
class _CellSamples:
    """The measured points in the order of their cells.

    order: (P,) index of each among the points as given.  cell: (P,) its cell; starts: (C,)
    where each cell's points begin, of the C cells that hold points.  weight: (3, P) what each
    point's z adds to the height at the centre, and to the slopes there along x and y, 1/mm.
    """

    order: Ints
    cell: Ints
    starts: Ints
    weight: Floats

    def total(self, values: Floats) -> Floats:
        """(C, ...) sum over each cell's points of values (P, ...)."""
        return np.add.reduceat(values, self.starts, axis=0)


def grid_cells(surface: Surface, cell_mm: float, bias_mm: Floats | None = None) -> HeightGrid:
    """The heights of ``surface`` on a grid of square cells, from the least x and y upwards.

    In each cell a quadratic in x and y is fitted to z by least squares; its value at the centre
    is the height, a weighted sum of the measured ones.  Own noise goes through the weights'
    squares, that of x through the slope.  A mode displaces the whole surface, so it changes the
    height by the weighted sum of its z less slope times its x and y.  A bias adds up.  A cell of
    fewer than MIN_POINTS points, or whose points do not enclose the centre, so that its height
    is less certain than a single measurement, has NO_DATA.

    Parameters
    ----------
    surface : Surface, mm, of F by N points, in any frame with z up
    cell_mm : float, mm, side of a cell; cell boundaries lie at whole multiples of it
    bias_mm : (F, N) array, optional, mm, standard deviation of an error of z that neighbouring
        points share and that is in no mode, such as what a line of finite width does on a curved
        surface

    Raises
    ------
    InputError
        For a cell without size or so small that the grid has more than LARGEST_GRID cells, or
        biases of another shape.
    MeasurementError
        Where there is no point.
    """
    valid = has_value(surface.status) & np.isfinite(surface.xyz_mm).all(axis=-1)
    _check(surface, cell_mm, bias_mm, bool(valid.any()))
    xyz = surface.xyz_mm[valid]
    low = np.floor(xyz[:, :2].min(axis=0) / cell_mm).astype(int)
    place = np.floor(xyz[:, :2] / cell_mm).astype(int) - low
    columns, rows = (int(n) for n in place.max(axis=0) + 1)
    if columns * rows > LARGEST_GRID:
        what, allowed = "gives too many cells", f"at most {LARGEST_GRID}"
        raise InputError(what, where="grid: cell_mm", value=f"{columns} x {rows}", allowed=allowed)
    x, y = ((low[k] + np.arange(n) + 0.5) * cell_mm for k, n in enumerate((columns, rows)))
    offset = (xyz[:, :2] - np.column_stack([x[place[:, 0]], y[place[:, 1]]])) / (cell_mm / 2)
    samples, enclosed = _cell_weights(place[:, 1] * columns + place[:, 0], offset, cell_mm / 2)
    where = samples.cell[samples.starts[enclosed]]

    def spread(values: Floats, missing: float) -> Floats:
        """(R, C, ...) of values (C', ...) of the cells that hold points."""
        whole = np.full((rows * columns, *values.shape[1:]), missing)
        whole[where] = values[enclosed]
        return whole.reshape(rows, columns, *values.shape[1:])

    height, slope_x, slope_y = (samples.total(w * xyz[samples.order, 2]) for w in samples.weight)
    slopes = np.stack([slope_x, slope_y], axis=-1)
    variance = _own_variance(surface, valid, samples, slopes)
    if bias_mm is not None:
        variance += samples.total(samples.weight[0] * bias_mm[valid][samples.order]) ** 2
    if (modes := _modes(surface, valid, samples, slopes)) is not None:
        variance += (modes**2).sum(axis=-1)
    z = spread(height, np.nan)
    return HeightGrid(
        x_mm=x,
        y_mm=y,
        cell_mm=cell_mm,
        z_mm=z,
        sigma_z_mm=spread(np.sqrt(variance), np.nan),
        status=np.where(np.isfinite(z), Status.OK, Status.NO_DATA).astype(np.int64),
        points=np.bincount(samples.cell, minlength=rows * columns).reshape(rows, columns),
        modes_mm=None if modes is None else spread(modes, np.nan),
    )


def fitting_cell_mm(surface: Surface) -> float:
    """The least side of cells, 1, 2 or 5 times a power of ten mm, of which hardly any lacks points.

    Of the cells that hold any point, ENOUGH have as many as a height takes.

    Parameters
    ----------
    surface : Surface, mm, in any frame with z up

    Raises
    ------
    MeasurementError
        Where there is no point, or too few for a grid.
    """
    valid = has_value(surface.status) & np.isfinite(surface.xyz_mm).all(axis=-1)
    plan = surface.xyz_mm[valid][:, :2]
    if len(plan) == 0:
        raise MeasurementError("the surface holds no measured point to grid")
    extent = np.ptp(plan, axis=0)
    for power in range(-3, 5):
        for first in (1.0, 2.0, 5.0):
            cell_mm = first * 10.0**power
            if np.prod(extent / cell_mm + 1) > LARGEST_GRID:
                continue
            place = np.floor(plan / cell_mm).astype(int)
            x, y = (place - place.min(axis=0)).T
            # By one number each: rows of two take many times as long to sort.
            counts = np.unique(y * (x.max() + 1) + x, return_counts=True)[1]
            if np.mean(counts >= MIN_POINTS) >= ENOUGH:
                return cell_mm
    raise MeasurementError(f"the surface holds too few points for a grid: {len(plan)}")


def _check(surface: Surface, cell_mm: float, bias_mm: Floats | None, any_point: bool) -> None:
    if not (np.isfinite(cell_mm) and cell_mm > 0):
        raise InputError("is not a size", where="grid: cell_mm", value=cell_mm, allowed="> 0 mm")
    if bias_mm is not None and bias_mm.shape != surface.status.shape:
        what, allowed = "is not of the surface's shape", str(surface.status.shape)
        raise InputError(what, where="grid: bias_mm", value=bias_mm.shape, allowed=allowed)
    if not any_point:
        raise MeasurementError("the surface holds no measured point to grid")


def _cell_weights(cell: Ints, offset: Floats, half_mm: float) -> tuple[_CellSamples, Ints]:
    """The weights of each point, and which of the cells with points have a height."""
    order = np.argsort(cell, kind="stable")
    ordered, (a, b) = cell[order], offset[order].T
    starts = np.flatnonzero(np.diff(ordered, prepend=-1))
    count = np.diff(starts, append=len(ordered))
    design = np.stack([np.ones_like(a), a, b, a * a, a * b, b * b], axis=-1)
    normal = np.add.reduceat(design[:, :, None] * design[:, None, :], starts, axis=0)
    known = (count >= MIN_POINTS) & (np.linalg.det(normal / count[:, None, None]) > 1e-9)
    inverse = np.linalg.inv(np.where(known[:, None, None], normal, np.eye(TERMS)))
    rows = np.repeat(inverse[:, :3], count, axis=0)
    weight = np.einsum("pij,pj->ip", rows, design) / np.array([[1.0], [half_mm], [half_mm]])
    enclosed = np.flatnonzero(known & (inverse[:, 0, 0] < 1))
    return _CellSamples(order, ordered, starts, weight), enclosed


def _own_variance(surface: Surface, valid: Mask, samples: _CellSamples, slopes: Floats) -> Floats:
    """(C,) variance of the heights from each point's own noise, mm²."""
    own_x, _, own_z = own_variances(surface)[valid][samples.order].T
    count = np.diff(samples.starts, append=len(samples.order))
    slope_x = np.repeat(slopes[:, 0], count)
    return samples.total(samples.weight[0] ** 2 * (own_z + slope_x**2 * own_x))


def _modes(surface: Surface, valid: Mask, samples: _CellSamples, slopes: Floats) -> Floats | None:
    """(C, M) change of the heights by each mode, mm."""
    if surface.modes_mm is None:
        return None
    modes = surface.modes_mm[valid][samples.order]
    weighted = samples.weight[0][:, None, None] * modes
    shift = samples.total(weighted)
    return np.asarray(
        shift[:, 2] - slopes[:, :1] * shift[:, 0] - slopes[:, 1:] * shift[:, 1], dtype=float
    )
