"""A patch of seabed as roughness sees it: heights on a grid, in cm, with holes.

Nothing is filled in.  What is asked of a patch counts the cells that were measured, and the
expectation of a periodogram is taken over just those.
"""

from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from lscan.errors import InputError, MeasurementError
from lscan.records import Floats, Ints, Mask, Surface, has_value
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
        """Raise MeasurementError where the patch is too small or has too many holes.

        What is not seen is not looked at: whatever stands there becomes 0.
        """
        if min(self.z_cm.shape) < FEWEST:
            rows, columns = self.z_cm.shape
            what = f"roughness: a patch of {rows} by {columns} cells, {FEWEST} a side are needed"
            raise MeasurementError(what)
        share = self.seen.mean()
        if share < LEAST_SEEN:
            raise MeasurementError(
                f"roughness: {share:.0%} of the patch's cells are measured, "
                f"{LEAST_SEEN:.0%} are needed"
            )
        heights = np.where(self.seen, self.z_cm, 0.0)
        if unknown := int((~np.isfinite(heights)).sum()):
            what = f"roughness: {unknown} cells that are seen have no height, none is allowed"
            raise MeasurementError(what)
        object.__setattr__(self, "z_cm", heights)

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


# A surface's own profiles as a patch: finer than cells, which need several points each.


WIDEST_GAP = 1.6  # of the usual distance between neighbouring points, that a profile is joined over
SHORTEST = 8  # points of a stretch without a gap that counts
UNEVEN = 0.1  # of the distance between profiles, by which it may change
BENT = 0.2  # of it, by which a profile may leave its straight line in plan


def patch_of_profiles(surface: Surface, cell_mm: float | None = None) -> Patch:
    """The patch that a surface's profiles span: rows are profiles, columns even steps along them.

    Rows and columns rise with y and x, whichever way the track went.

    Profiles are joined by cubic splines between neighbouring points, and have holes where points
    are missing.

    Parameters
    ----------
    surface : Surface, mm, profiles that are parallel straight lines in plan, evenly spaced
    cell_mm : float, optional, mm, the cells' side: every so manieth profile is taken; by default
        the profiles' distance

    Raises
    ------
    MeasurementError
        The profiles are bent in plan or unevenly spaced, or too few.
    """
    good = has_value(surface.status) & np.isfinite(surface.xyz_mm).all(axis=-1)
    rows = np.flatnonzero(good.sum(axis=1) >= SHORTEST)
    if len(rows) < FEWEST:
        what = f"roughness: {len(rows)} profiles of {SHORTEST} points, {FEWEST} are needed"
        raise MeasurementError(what)
    along, across = _frame(surface, good, rows)
    step_mm = _spacing(across, good, rows)
    every = max(round((cell_mm or 0.0) / abs(step_mm)), 1)
    rows = rows[0] + np.arange(0, rows[-1] - rows[0] + 1, every)
    rows = rows if step_mm > 0 else rows[::-1]
    cell = every * abs(step_mm)
    low, high = np.nanpercentile(np.where(good, along, np.nan)[rows], (0.5, 99.5))
    places = np.arange(low, high, cell)
    variance = surface.sigma_z_mm**2
    if surface.modes_mm is not None:  # a point's own noise, less what it shares with all others
        variance = variance - (surface.modes_mm[..., 2, :] ** 2).sum(axis=-1)
    variance = np.maximum(variance, 0.0)
    kept = [_resample(along[r], surface.xyz_mm[r, :, 2], good[r], places) for r in rows]
    z, seen = (np.stack(part) for part in zip(*kept, strict=True))
    apart = float(np.median(np.concatenate([np.diff(along[r][good[r]]) for r in rows])))
    points_cells = max(apart / cell, 1.0)
    noise = float(variance[good].mean()) * points_cells
    return Patch(z / MM_PER_CM, seen, cell / MM_PER_CM, noise / MM_PER_CM**2, points_cells)


def _frame(surface: Surface, good: Mask, rows: Ints) -> tuple[Floats, Floats]:
    """(F, N) mm, plan coordinates along the profiles and across them."""
    plan = surface.xyz_mm[..., :2]
    ends = np.array([plan[r][good[r]][[0, -1]] for r in rows])
    way = (ends[:, 1] - ends[:, 0]).mean(axis=0)
    way = way / np.linalg.norm(way)
    if way[0] < 0:
        way = -way
    return plan @ way, plan @ np.array([-way[1], way[0]])


def _spacing(across: Floats, good: Mask, rows: Ints) -> float:
    """mm from each profile to the next, which must be even; below 0 where y falls."""
    middle = np.array([np.median(across[r][good[r]]) for r in rows])
    step, offset = np.polyfit(rows, middle, 1)
    size = abs(float(step))
    uneven = float(np.abs(middle - offset - step * rows).max())
    bent = max(float(np.ptp(across[r][good[r]])) for r in rows)
    if size == 0 or uneven > UNEVEN * size or bent > BENT * size:
        raise MeasurementError(
            f"roughness: profiles {size:.3g} mm apart lie up to {uneven:.2g} mm off even spacing "
            f"and leave their lines by {bent:.2g} mm: give the side of a cell in place of profiles"
        )
    return float(step)


def _resample(along: Floats, z: Floats, good: Mask, places: Floats) -> tuple[Floats, Mask]:
    """(C,) heights at places along a profile, 0 in holes, and where they are none."""
    order = np.argsort(along[good])
    s, height = along[good][order], z[good][order]
    single = np.diff(s, prepend=-np.inf) > 1e-9
    s, height = s[single], height[single]
    found, seen = np.zeros(len(places)), np.zeros(len(places), dtype=bool)
    if len(s) < SHORTEST:
        return found, seen
    apart = float(np.median(np.diff(s)))
    breaks = np.flatnonzero(np.diff(s) > WIDEST_GAP * apart)
    for first, last in zip(np.r_[0, breaks + 1], np.r_[breaks + 1, len(s)], strict=True):
        if last - first >= SHORTEST:
            inside = (places >= s[first]) & (places <= s[last - 1])
            found[inside] = CubicSpline(s[first:last], height[first:last])(places[inside])
            seen |= inside
    return found, seen
