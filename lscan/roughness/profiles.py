"""A surface's own profiles as a patch: finer than cells, which need several points each."""

import numpy as np
from scipy.interpolate import CubicSpline

from lscan.errors import MeasurementError
from lscan.records import Floats, Ints, Mask, Surface, has_value
from lscan.roughness.patch import FEWEST, MM_PER_CM, Patch

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
        raise MeasurementError(
            f"roughness: {len(rows)} profiles of {SHORTEST} points, {FEWEST} are needed"
        )
    along, across = _frame(surface, good, rows)
    step_mm = _spacing(across, good, rows)
    every = max(round((cell_mm or 0.0) / abs(step_mm)), 1)
    rows = rows[0] + np.arange(0, rows[-1] - rows[0] + 1, every)
    rows = rows if step_mm > 0 else rows[::-1]
    cell = every * abs(step_mm)
    low, high = np.nanpercentile(np.where(good, along, np.nan)[rows], (0.5, 99.5))
    places = np.arange(low, high, cell)
    variance = _own_variance(surface)
    kept = [_resampled(along[r], surface.xyz_mm[r, :, 2], good[r], places) for r in rows]
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


def _resampled(along: Floats, z: Floats, good: Mask, places: Floats) -> tuple[Floats, Mask]:
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


def _own_variance(surface: Surface) -> Floats:
    """(F, N) mm², of a point's own noise: less what it shares with all others."""
    variance = surface.sigma_z_mm**2
    if surface.modes_mm is not None:
        variance = variance - (surface.modes_mm[..., 2, :] ** 2).sum(axis=-1)
    return np.maximum(variance, 0.0)
