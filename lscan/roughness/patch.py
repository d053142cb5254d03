"""A patch of seabed as roughness sees it: heights on a grid, in cm, with holes.

Nothing is filled in.  What is asked of a patch counts the cells that were measured, and the
expectation of a periodogram is taken over just those.
"""

from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from lscan.errors import InputError, MeasurementError
from lscan.records import Floats, Mask, Surface, has_value
from lscan.surface import HeightGrid, grid_cells
from lscan.surface.grid import MIN_POINTS

MM_PER_CM = 10.0
FEWEST = 16
"""Cells along either side: the longest wavelengths and the shortest are then a factor of four
apart, once those are left out that a patch cannot tell from its slope."""
LEAST_SEEN = 0.5
STEP = 15.0  # times the median difference of neighbouring cells: ten sigmas of normal ones


@dataclass(frozen=True)
class Patch:
    """Heights on a grid of square cells, R rows along y by C columns along x.

    Attributes
    ----------
    z_cm : (R, C) array, cm; 0 where not seen
    seen : (R, C) array, whether the cell was measured
    cell_cm : float, cm, side of a cell
    noise_cm2 : float, cm², variance of a cell's own noise, the mean over those that were measured;
        of cells finer than the points that they were joined from, that of white noise with the
        spectrum that the points' noise has at long waves
    points_cells : float, how many cells the points lie apart along x that cells were joined from
    """

    z_cm: Floats
    seen: Mask
    cell_cm: float
    noise_cm2: float = 0.0
    points_cells: float = 1.0

    def __post_init__(self) -> None:
        """Raise MeasurementError where the patch is too small or has too many holes."""
        if min(self.z_cm.shape) < FEWEST:
            rows, columns = self.z_cm.shape
            raise MeasurementError(
                f"roughness: a patch of {rows} by {columns} cells, {FEWEST} a side are needed"
            )
        share = self.seen.mean()
        if share < LEAST_SEEN:
            raise MeasurementError(
                f"roughness: {share:.0%} of the patch's cells are measured, "
                f"{LEAST_SEEN:.0%} are needed"
            )

    @property
    def points_noise_cm2(self) -> float:
        """cm², variance of a single point's own noise."""
        return self.noise_cm2 / self.points_cells

    @property
    def size_cm(self) -> tuple[float, float]:
        """Length along y, and along x."""
        rows, columns = self.z_cm.shape
        return rows * self.cell_cm, columns * self.cell_cm

    @property
    def steps(self) -> float:
        """Length of steps between cells, along x or along y, in the patch's shorter side."""
        z, least = np.where(self.seen, self.z_cm, np.nan), float(np.sqrt(self.noise_cm2))
        off = [np.abs(d - np.nanmedian(d)) for d in (np.diff(z, axis=0), np.diff(z, axis=1))]
        return max(int((d > STEP * max(np.nanmedian(d), least)).sum()) for d in off) / min(z.shape)

    @property
    def nyquist_per_cm(self) -> float:
        """rad/cm, the largest wavenumber along either side."""
        return float(np.pi / self.cell_cm)


def patch_of(grid: HeightGrid) -> Patch:
    """The patch that a surface's grid holds.

    A cell's own noise is what its uncertainty has beside the modes that all cells have in common:
    those displace or tilt the patch as a whole.

    Parameters
    ----------
    grid : HeightGrid, mm

    Raises
    ------
    MeasurementError
        It is too small, or has too many holes.
    """
    seen = has_value(grid.status) & np.isfinite(grid.z_mm)
    variance = grid.sigma_z_mm**2
    if grid.modes_mm is not None:
        variance = variance - (grid.modes_mm**2).sum(axis=2)
    noise = float(np.maximum(variance[seen], 0.0).mean()) if seen.any() else 0.0
    z = np.where(seen, grid.z_mm, 0.0) / MM_PER_CM
    return Patch(z, seen, grid.cell_mm / MM_PER_CM, noise / MM_PER_CM**2)


def patch_of_cells(surface: Surface, cell_mm: float) -> Patch:
    """The patch of a surface's points, averaged in cells.

    Parameters
    ----------
    surface : Surface, mm
    cell_mm : float, mm, side of a cell

    Raises
    ------
    InputError
        The cells are too small or too many.
    MeasurementError
        There is no point, or the patch is too small or has too many holes: a size of cells that
        serves is named, where there is one.
    """
    grid = grid_cells(surface, cell_mm)
    try:
        return patch_of(grid)
    except MeasurementError as error:
        serving_mm = _serving_cell_mm(surface)
        advice = f"cells of {serving_mm:g} mm serve" if serving_mm else "no size of cells serves"
        raise MeasurementError(f"{error}; a cell needs {MIN_POINTS} points: {advice}") from error


def _serving_cell_mm(surface: Surface) -> float | None:
    """The least size of cells, to a tenth of it, that gives a patch; None where none does."""
    plan = surface.xyz_mm[has_value(surface.status)][:, :2]
    width, length = np.ptp(plan, axis=0)
    size = np.sqrt(MIN_POINTS * width * length / len(plan))
    while min(width, length) > FEWEST * size > 0:
        rounded = float(f"{size:.2g}")
        with suppress(MeasurementError):
            patch_of(grid_cells(surface, rounded))
            return rounded
        size *= 1.1
    return None


def wavenumbers(shape: tuple[int, int], cell_cm: float) -> tuple[Floats, Floats]:
    """(R, 1) and (1, C) rad/cm along y and x, of a discrete Fourier transform.

    Parameters
    ----------
    shape : (R, C), of the grid
    cell_cm : float, cm

    Raises
    ------
    InputError
        The cell has no length.
    """
    if not cell_cm > 0:
        raise InputError("cell_cm", value=cell_cm, allowed="above 0 cm")
    along_y, along_x = (
        np.asarray(2 * np.pi * np.fft.fftfreq(count, cell_cm), dtype=float) for count in shape
    )
    return along_y[:, np.newaxis], along_x[np.newaxis, :]
