"""Straight segments of a profile: runs of neighbouring points on one level."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lscan.errors import MeasurementError
from lscan.measure.lengths import LengthBudget
from lscan.records import Floats, Ints, Profile, has_value

JUMP_MM = 3.0
"""Height difference between neighbouring points that ends a segment: above what noise and a
tilt of 3 degrees do within a column, below any groove's depth."""

GAP_MM = 5.0
"""Stretch without points that ends a segment: a groove whose bottom is not seen is wider."""

LEVEL_MM = 1.0
"""How far off its segment's level an end point may lie: five times a coarse noise of 0.2 mm."""

MIN_POINTS = 4

CORNER_MM = 2.0
"""Points this near to a segment's end are left out of line fits: corners lie in shadow, and
the line spills over edges."""

PHASE = 0.005
"""Standard uncertainty of a level line's height, in units of the columns' spacing: by so much of a
pixel an extractor's centre may hang on where within the pixel a narrow line lies, and a line
along the pixels' rows lies alike in all its columns, and in all pictures of one place."""

MAX_TILT = np.tan(np.radians(10.0))
"""Steepest slope of a profile's segments that is accepted when its tilt is looked for."""


@dataclass(frozen=True)
class Segment:
    """Neighbouring points of one profile on one level.

    Attributes
    ----------
    points : (K,) array, indices into the trace
    level_mm : float, mm, median of z - tilt * x
    """

    points: Ints
    level_mm: float


@dataclass(frozen=True)
class Trace:
    """A profile's P valid points in the picture's order, turned so that x grows.

    Attributes
    ----------
    x, z : (P,) array, mm, frame of the sheet
    sigma_x, sigma_z : (P,) array, mm, standard uncertainties of x and of z
    brightness : (P,) array, DN, of the line
    spacing_mm : float, mm, median distance in x from one column to the next
    tilt : float, common dz/dx of its level segments
    modes : (P, 2, M) array or None, mm, as PlanePoints.modes_mm; None where none are known
    """

    x: Floats
    z: Floats
    sigma_x: Floats
    sigma_z: Floats
    brightness: Floats
    spacing_mm: float
    tilt: float
    modes: Floats | None = None


def trace(profile: Profile) -> Trace:
    """The profile's valid points from left to right, with the common tilt of its segments.

    Parameters
    ----------
    profile : Profile, mm, frame of the sheet

    Raises
    ------
    MeasurementError
        Where there are too few points to speak of segments.
    """
    valid = has_value(profile.points.status) & np.isfinite(profile.points.xz_mm).all(axis=1)
    column = np.flatnonzero(valid)
    if len(column) < 5 * MIN_POINTS:
        raise MeasurementError(f"{len(column)} measured points: no segments in them")
    # Not in order of x: seen aslant, the bottom beside an edge may reach beneath the top.
    if profile.points.xz_mm[column[-1], 0] < profile.points.xz_mm[column[0], 0]:
        column = column[::-1]
    x, z = profile.points.xz_mm[column].T
    sigma_x, sigma_z = profile.points.sigma_mm[column].T
    steps = np.diff(x)[np.abs(np.diff(column)) == 1]
    spacing = float(np.median(steps)) if len(steps) else 0.0
    if not spacing > 0:
        raise MeasurementError("no two neighbouring columns have a point: no segments")
    tilt = _common_tilt(x, z)
    modes = None if profile.points.modes_mm is None else profile.points.modes_mm[column]
    return Trace(x, z, sigma_x, sigma_z, profile.brightness[column], spacing, tilt, modes)


def segments(line: Trace) -> list[Segment]:
    """The segments of a trace from left to right, those of a few points (walls) left out.

    Parameters
    ----------
    line : Trace, mm
    """
    flat = line.z - line.tilt * line.x
    breaks = (np.abs(np.diff(flat)) > JUMP_MM) | (np.abs(np.diff(line.x)) > GAP_MM)
    runs = np.split(np.arange(len(flat)), np.flatnonzero(breaks) + 1)
    level = [_without_walls(run, flat) for run in runs if len(run) >= MIN_POINTS]
    return [Segment(run, float(np.median(flat[run]))) for run in level if len(run) >= MIN_POINTS]


def joined(parts: Sequence[Segment], line: Trace) -> Segment:
    """One segment of all the points of several that lie on one level.

    Parameters
    ----------
    parts : sequence of Segment, of ``line``
    line : Trace, mm
    """
    points = np.concatenate([part.points for part in parts])
    flat = line.z[points] - line.tilt * line.x[points]
    return Segment(points, float(np.median(flat)))


def inner_points(line: Trace, segment: Segment) -> Ints:
    """The segment's points that lie clear of its ends, (K,) indices into the trace.

    Parameters
    ----------
    line : Trace, mm
    segment : Segment, of ``line``
    """
    x = line.x[segment.points]
    clear = (x > x.min() + CORNER_MM) & (x < x.max() - CORNER_MM)
    return segment.points[clear]


def height_between(line: Trace, upper: Ints, lower: Ints) -> LengthBudget:
    """Distance in mm between two parallel lines, with its uncertainty.

    Both sets of points are fitted with one slope by least squares, points farther than three
    robust deviations from their line left out.  The height is a weighted sum of their z, so each
    mode of the calibration changes it by that sum of the mode; its own noise is the points' scatter
    through the same sum, what neighbours have in common counted.  Either line may lie off by PHASE,
    in all pictures alike.  Where no modes are known the points' own sigma_z counts once for each
    line: most of that is the plane map's, common to neighbours, and does not average out.

    Parameters
    ----------
    line : Trace, mm
    upper, lower : (K,) array, indices into the trace of the points on either line

    Raises
    ------
    MeasurementError
        Where either set holds fewer than MIN_POINTS points.
    """
    points = np.concatenate([upper, lower])
    which = np.repeat([0, 1], [len(upper), len(lower)])
    design = _two_lines(line.x[points], which)
    keep = np.ones(len(points), dtype=bool)
    for _ in range(5):
        if min(np.sum(keep & (which == 0)), np.sum(keep & (which == 1))) < MIN_POINTS:
            raise MeasurementError(f"fewer than {MIN_POINTS} points clear of the corners")
        solution = np.linalg.lstsq(design[keep], line.z[points[keep]], rcond=None)[0]
        residual = line.z[points] - design @ solution
        scale = 1.4826 * float(np.median(np.abs(residual[keep])))
        keep = np.abs(residual) <= 3 * scale + 1e-6
    used, side = points[keep], which[keep]
    slope = float(solution[0])
    cosine = 1 / float(np.hypot(1.0, slope))
    # Rows of the pseudo-inverse: what each point's z adds to the slope and the two levels.
    share = np.linalg.pinv(design[keep])
    weight = (share[1] - share[2]) * cosine
    freedom = max(len(used) - 3, 1)
    scatter = float(np.sum(residual[keep] ** 2)) / freedom * _correlation_factor(residual[keep])
    modes, common = None, 2 * (PHASE * line.spacing_mm) ** 2
    if line.modes is None:
        common += sum(float(np.mean(line.sigma_z[used[side == k]] ** 2)) for k in (0, 1))
    else:
        modes = weight @ (line.modes[used, 1] - slope * line.modes[used, 0])
    return LengthBudget(
        value_mm=float(solution[1] - solution[2]) * cosine,
        own_mm=float(np.sqrt(scatter * (weight @ weight))),
        common_mm=float(np.sqrt(common)) * cosine,
        modes_mm=modes,
    )


def _two_lines(x: Floats, which: Ints) -> Floats:
    """(K, 3) design of two lines of one slope, x counted from its mean."""
    middle = float(x.mean()) if len(x) else 0.0
    return np.column_stack([x - middle, which == 0, which == 1]).astype(float)


def _correlation_factor(residual: Floats) -> float:
    """Factor by which the variance of a mean grows because neighbours err alike: 1 at least.

    The camera's blur makes the speckle of columns next to each other one error.  The factor is
    1 + 2 (r1 + r2), r1 and r2 the correlations of residuals one and two columns apart; for more
    the blur of one pixel leaves nothing.
    """
    total = float(residual @ residual)
    if total == 0 or len(residual) < 4 * MIN_POINTS:
        return 1.0
    near = sum(float(residual[k:] @ residual[:-k]) / total for k in (1, 2))
    return max(1.0, 1 + 2 * near)


def _without_walls(run: Ints, flat: Floats) -> Ints:
    """The run without points at its ends that lie off its level: lit spots of a wall."""
    on_level = np.flatnonzero(np.abs(flat[run] - np.median(flat[run])) < LEVEL_MM)
    return run[on_level[0] : on_level[-1] + 1] if len(on_level) else run[:0]


def _common_tilt(x: Floats, z: Floats) -> float:
    """Median slope over short chords that stay on one segment: walls and steps are few."""
    reach = max(len(x) // 50, 3)
    chord = (z[reach:] - z[:-reach]) / np.maximum(x[reach:] - x[:-reach], 1e-9)
    level = chord[(np.abs(chord) < MAX_TILT) & (x[reach:] > x[:-reach])]
    return float(np.median(level)) if len(level) else 0.0
