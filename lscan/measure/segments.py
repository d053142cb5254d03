"""Straight segments of a profile: runs of neighbouring points on one level."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lscan.errors import MeasurementError
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

UNDIMMED = 0.95
"""Brightness of a segment's last point, in units of the segment's, above which no fall is seen."""

MAX_TILT = np.tan(np.radians(10.0))
"""Steepest slope of a profile's segments that is believed when its tilt is looked for."""


@dataclass(frozen=True)
class Segment:
    """Neighbouring points of one profile on one level.

    points: (K,) indices into the profile.  level_mm: median of z - tilt * x.
    """

    points: Ints
    level_mm: float


@dataclass(frozen=True)
class Trace:
    """A profile's valid points in the picture's order, turned so that x grows.

    x, z, sigma_x, sigma_z: (P,) mm.  column: (P,) index in the profile.  peak: (P,) grey value.
    spacing_mm: median distance in x from one column to the next.
    tilt: common dz/dx of its level segments.
    """

    x: Floats
    z: Floats
    sigma_x: Floats
    sigma_z: Floats
    column: Ints
    peak: Floats
    spacing_mm: float
    tilt: float


def trace(profile: Profile) -> Trace:
    """The profile's valid points from left to right, with the common tilt of its segments.

    Raises MeasurementError where there are too few points to speak of segments.
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
    return Trace(x, z, sigma_x, sigma_z, column, profile.peak[column], spacing, tilt)


def segments(line: Trace) -> list[Segment]:
    """The segments of a trace from left to right, those of a few points (walls) left out."""
    flat = line.z - line.tilt * line.x
    runs = np.split(np.arange(len(flat)), _breaks(line.x, flat))
    level = [_without_walls(run, flat) for run in runs if len(run) >= MIN_POINTS]
    return [Segment(run, float(np.median(flat[run]))) for run in level if len(run) >= MIN_POINTS]


def joined(parts: Sequence[Segment], line: Trace) -> Segment:
    """One segment of all the points of several that lie on one level."""
    points = np.concatenate([part.points for part in parts])
    flat = line.z[points] - line.tilt * line.x[points]
    return Segment(points, float(np.median(flat)))


def inner_points(line: Trace, segment: Segment) -> Ints:
    """(K,) the segment's points that lie clear of its ends."""
    x = line.x[segment.points]
    clear = (x > x.min() + CORNER_MM) & (x < x.max() - CORNER_MM)
    return segment.points[clear]


def end_mm(line: Trace, segment: Segment, direction: int) -> tuple[float, float]:
    """x in mm where a segment ends towards ``direction`` (+1: greater x), and its sigma.

    The segment ends where its brightness falls to half of what it is along it, interpolated
    between the columns.  The first column beyond is dark, or shows another surface that
    outshone the segment: then it had less than half, and a quarter is taken for it.  Where no
    fall is seen, the end is half a column beyond the last point.
    sigma: that of an even distribution over one column, and of the end point's x.
    """
    order = segment.points[::direction]
    last = order[-4:]
    bright = [*_brightness(line, order, last), 0.25 if _joined_on(line, order, direction) else 0.0]
    x = [*line.x[last], line.x[last[-1]] + direction * line.spacing_mm]
    lit = max((k for k in range(len(last)) if bright[k] >= 0.5), default=len(last) - 1)
    part = (bright[lit] - 0.5) / (bright[lit] - bright[lit + 1])
    if bright[-2] > UNDIMMED or bright[lit] < 0.5:
        lit, part = len(last) - 1, 0.5
    sigma = np.hypot(line.spacing_mm / np.sqrt(12), line.sigma_x[last[-1]])
    return float(x[lit] + part * (x[lit + 1] - x[lit])), float(sigma)


def _brightness(line: Trace, order: Ints, which: Ints) -> list[float]:
    """Peak of some points in units of the median near the end of ``order``, 1 where unknown."""
    peaks = line.peak[order[-20:]]
    known = peaks[np.isfinite(peaks)]
    full = float(np.median(known)) if len(known) else 0.0
    relative = line.peak[which] / full if full > 0 else np.ones(len(which))
    return [float(value) for value in np.clip(np.nan_to_num(relative, nan=1.0), 0.0, 1.0)]


def _joined_on(line: Trace, order: Ints, direction: int) -> bool:
    """Whether the very next column beyond a segment's end holds a point of another surface."""
    beyond = int(order[-1]) + direction
    within = 0 <= beyond < len(line.x)
    return within and abs(int(line.column[beyond]) - int(line.column[order[-1]])) == 1


def height_between(line: Trace, upper: Ints, lower: Ints) -> tuple[float, float]:
    """Distance in mm between two parallel lines, and its standard uncertainty.

    Both sets of points, indices into the trace, are fitted with one slope by least squares,
    points farther than three robust deviations from their line left out.  The sigma adds to the
    fit's the points' own sigma_z, once for each line: most of that is the plane map's, common
    to neighbours, and does not average out.
    Raises MeasurementError where either set holds fewer than MIN_POINTS points.
    """
    points = np.concatenate([upper, lower])
    which = np.repeat([0, 1], [len(upper), len(lower)])
    keep = np.ones(len(points), dtype=bool)
    middle = float(line.x[points].mean()) if len(points) else 0.0
    design = np.column_stack([line.x[points] - middle, which == 0, which == 1]).astype(float)
    for _ in range(5):
        if min(np.sum(keep & (which == 0)), np.sum(keep & (which == 1))) < MIN_POINTS:
            raise MeasurementError(f"fewer than {MIN_POINTS} points clear of the corners")
        solution = np.linalg.lstsq(design[keep], line.z[points[keep]], rcond=None)[0]
        residual = line.z[points] - design @ solution
        scale = 1.4826 * float(np.median(np.abs(residual[keep])))
        keep = np.abs(residual) <= 3 * scale + 1e-6
    used = design[keep]
    freedom = max(int(keep.sum()) - 3, 1)
    scatter = float(np.sum(residual[keep] ** 2)) / freedom
    own = line.sigma_z[points] ** 2
    common = sum(float(np.mean(own[keep & (which == side)])) for side in (0, 1))
    difference = np.array([0.0, 1.0, -1.0])
    inverse = np.linalg.inv(used.T @ used)
    cosine = 1 / float(np.hypot(1.0, solution[0]))
    sigma = np.sqrt(scatter * float(difference @ inverse @ difference) + common) * cosine
    return float((solution[1] - solution[2]) * cosine), float(sigma)


def _without_walls(run: Ints, flat: Floats) -> Ints:
    """The run without points at its ends that lie off its level: lit spots of a wall."""
    on_level = np.flatnonzero(np.abs(flat[run] - np.median(flat[run])) < LEVEL_MM)
    return run[on_level[0] : on_level[-1] + 1] if len(on_level) else run[:0]


def _breaks(x: Floats, flat: Floats) -> Ints:
    """Indices at which a new run begins: after a jump in height or a gap in x."""
    return np.flatnonzero((np.abs(np.diff(flat)) > JUMP_MM) | (np.abs(np.diff(x)) > GAP_MM)) + 1


def _common_tilt(x: Floats, z: Floats) -> float:
    """Median slope over short chords that stay on one segment: walls and steps are few."""
    reach = max(len(x) // 50, 3)
    chord = (z[reach:] - z[:-reach]) / np.maximum(x[reach:] - x[:-reach], 1e-9)
    level = chord[(np.abs(chord) < MAX_TILT) & (x[reach:] > x[:-reach])]
    return float(np.median(level)) if len(level) else 0.0
