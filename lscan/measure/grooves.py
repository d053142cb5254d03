"""The grooved block from its profile (Table III): segments, their ends, its dimensions; slices."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.optimize import least_squares
from scipy.special import ndtri

from lscan.config.targets import GroovedBlock, Sandwave
from lscan.errors import InputError, MeasurementError
from lscan.measure.board import LengthBudget, mean_length
from lscan.records import Floats, Ints, Length, Mask, Profile, Surface, has_value
from lscan.stripe.blurredstep import NO_END, StepLimits, StepSamples, fit_steps
from lscan.surface import Slice

# Straight segments of a profile: runs of neighbouring points on one level.

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
    # The median slope over short chords that stay on one segment: walls and steps are few.
    reach = max(len(x) // 50, 3)
    chord = (z[reach:] - z[:-reach]) / np.maximum(x[reach:] - x[:-reach], 1e-9)
    level = chord[(np.abs(chord) < MAX_TILT) & (x[reach:] > x[:-reach])]
    tilt = float(np.median(level)) if len(level) else 0.0
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


def join_segments(parts: Sequence[Segment], line: Trace) -> Segment:
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
    x = line.x[points]  # counted from its mean, of two lines of one slope
    middle = float(x.mean()) if len(x) else 0.0
    design = np.column_stack([x - middle, which == 0, which == 1]).astype(float)
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


# Where lit segments end, from how their brightness falls there.
#
# The camera's blur draws the end of a line out over two or three columns.  Each segment's
# brightness is a straight line, the shading of fan and lens, times that of its two ends, blurred
# steps (stripe/blurredstep.py); all segments of a picture share one blur.  All are fitted together
# to the columns of the picture, so that speckle, which moves single columns, is averaged over the
# fall.


UNDIMMED = 0.95
"""Brightness of a segment's last point, in units of the segment's, above which no fall is seen."""

USUAL_BLUR = 0.8  # columns, where the fit starts: a lens of 0.7 pixels, and the pixel's width

BLURS = (1 / np.sqrt(12), 3.0)
"""Least and greatest blur, columns: the pixel's own width, and what falls more slowly is no end but
a shadow."""

LEAST_T = -1.645
"""Depth, in widths of the blur, from which columns show the end: at 5 % of the segment's
brightness.  Dimmer ones are found only where speckle makes them bright."""

UNMODELLED = 0.01
"""Uncertainty of a column's brightness that is no noise, in units of the segment's: the halo of
light that clear water scatters about a line."""

FALSE_LIGHT = 0.015
"""Standard uncertainty of an end, in columns, that no further picture lessens.  Half a percent of
the segment's brightness, left of a halo or a lit wall where the ground beside the line is taken
off (stripe/peaks.py), moves a fall over two columns by as much, outwards."""


MOST_GAMMA = 2.6
"""Of a camera's tone curve that is not known: sRGB and what webcams add to it."""

_AT_HALF = -ndtri(2.0**-MOST_GAMMA)
CURVE = _AT_HALF * 2 ** (MOST_GAMMA - 1) * np.exp(-(_AT_HALF**2) / 2) / MOST_GAMMA / np.sqrt(3)
"""Standard uncertainty, in widths of the blur as it is seen, that such a curve makes of an end.

Behind a curve a fall of light Phi(t) is seen as Phi^(1 / gamma), which is one half not at t = 0 but
where Phi is 2^-gamma, farther out; there its slope, and so the width that is fitted to it, is
2^(gamma - 1) phi(t) / gamma.  The end is taken for as much farther out, by anything between none
and that of the greatest gamma: a rectangular distribution about 0 (GUM 4.3.7).  Left out is the
ground beneath the line, which lessens it, so that the bound is that of a line in the dark."""


@dataclass(frozen=True)
class End:
    """Where a segment ends.

    Attributes
    ----------
    x_mm : float, mm, the place, frame of the sheet
    own_mm : float, mm, its standard uncertainty from noise, another in every picture
    common_mm : float, mm, uncertainty alike in all pictures of one place: FALSE_LIGHT, or, where no
        fall is seen, the columns' spacing
    point : int, index into the trace of the segment's outermost point
    curve_mm : float, mm, towards larger x, one standard uncertainty of what an unknown tone curve
        does to all ends alike, outwards; 0 where the curve is known
    """

    x_mm: float
    own_mm: float
    common_mm: float
    point: int
    curve_mm: float = 0.0


def segment_ends(
    line: Trace, segments: Sequence[Segment], unknown_curve: bool = False
) -> list[tuple[End, End]]:
    """The left and the right end of each segment of one profile.

    Where no fall is seen, the end is half a column beyond the last point, to within an even
    distribution over one column.

    Parameters
    ----------
    line : Trace, mm, the profile's points from left to right, with their brightness
    segments : sequence of Segment, of that profile
    unknown_curve : bool, whether the camera may have a tone curve that is neither stated nor undone
    """
    outermost = np.array([[part.points[k] for part in segments] for k in (0, -1)])
    falls = np.array([[_falls(line, part, k) for part in segments] for k in (0, -1)])
    step = line.spacing_mm
    place = line.x[outermost] + np.array([[-step / 2], [step / 2]])
    own, curve = np.zeros((2, *place.shape))
    common = np.full(place.shape, step / np.sqrt(12))
    if falls.any():
        limits = StepLimits(LEAST_T, np.inf, (BLURS[0] * step, BLURS[1] * step), step, UNMODELLED)
        last = line.x[outermost][falls]
        samples = _samples(line, segments, falls)
        within, blur = np.full(len(last), 1.5 * step), np.array([USUAL_BLUR * step])
        fit = fit_steps(samples, last, within, blur, limits)
        place[falls] = np.clip(fit.place, last - 3 * step, last + 3 * step)
        own[falls] = np.sqrt(np.maximum(np.diag(fit.covariance), 0.0))
        common[falls] = FALSE_LIGHT * step
        if unknown_curve:
            curve = np.array([[-1.0], [1.0]]) * falls * CURVE * fit.width[0]
    both = np.stack([place, own, common, outermost, curve], axis=-1).tolist()
    left, right = ([End(x, s, e, int(p), c) for x, s, e, p, c in side] for side in both)
    return list(zip(left, right, strict=True))


def _samples(line: Trace, segments: Sequence[Segment], falls: Mask) -> StepSamples:
    """The columns of all segments; the places are the ends that fall, those on the left first."""
    points = np.concatenate([part.points for part in segments])
    which = np.repeat(np.arange(len(segments)), [len(part.points) for part in segments])
    known = np.isfinite(line.brightness[points]) & (line.brightness[points] > 0)
    points, which = points[known], which[known]
    x = line.x[points]
    outwards = np.array([[-1.0], [1.0]])
    along = np.concatenate([_along(line, part) for part in segments])[known]
    places = np.where(falls, np.cumsum(falls).reshape(falls.shape) - 1, -1)
    by_place = (outwards * falls)[:, None] * np.eye(2)[:, :, None]
    return StepSamples(
        stretch=which,
        brightness=line.brightness[points],
        level=np.stack([np.ones_like(along), along]),
        by_place=by_place[..., which],
        offset=np.where(falls[:, which], outwards * x, NO_END),
        places=places.T,
        group=np.zeros(len(segments), dtype=np.int64),
        wall=np.full(len(segments), -1),
    )


def _along(line: Trace, part: Segment) -> Floats:
    """(K,) place of the segment's points between its ends, -1 to 1."""
    x = line.x[part.points]
    return 2 * (x - x[0]) / max(float(x[-1] - x[0]), line.spacing_mm) - 1


def _falls(line: Trace, segment: Segment, end: int) -> bool:
    """Whether a segment's outermost point, its first (0) or last (-1), is dimmer than the rest."""
    peaks = line.brightness[segment.points]
    known = peaks[np.isfinite(peaks)]
    full = float(np.median(known)) if len(known) else 0.0
    return bool(full > 0 and peaks[end] < UNDIMMED * full)


# The nine dimensions of the grooved block from its profile (Sec. IV.B, Fig. 21, Table III).


@dataclass(frozen=True)
class Parts:
    """What a profile of the block consists of, each part as a segment of the profile.

    Attributes
    ----------
    ridges : tuple of Segment, the tops, from left to right, one more than there are grooves
    bottoms : tuple of Segment, what is seen of each groove's bottom
    floor : Segment, what is seen beside the block
    """

    ridges: tuple[Segment, ...]
    bottoms: tuple[Segment, ...]
    floor: Segment


def groove_dimensions(
    profiles: Profile | Sequence[Profile], piece: GroovedBlock, unknown_curve: bool = False
) -> dict[str, Length]:
    """The dimensions W1 to S2 of Table III, mm, measured as in the paper.

    Widths and separations lie between the end points of the tops' laser segments, measured
    along the tops; heights are distances between straight lines fitted to segments with a
    common slope.  Of several profiles the mean is given, weighted by each one's noise, outliers
    left out.  Its sigma_mm holds the noise of that mean and, undiminished, what errs alike in all
    profiles: the calibration, of which only the difference it makes to the length counts where the
    plane map has modes; false light at the ends, or the columns' spacing where an end's
    brightness does not fall; and what a level line's place within the pixel does to
    its height.

    Parameters
    ----------
    profiles : Profile or sequence of Profile, mm, frame of the sheet.  The block stands along the
        track, so that the sheet cuts it square; it may be tilted in the sheet by some degrees and
        lie anywhere in it.
    piece : GroovedBlock, the nominal shape
    unknown_curve : bool, whether the camera may have a tone curve (gamma) that is not known: the
        widths' uncertainty then holds what one of up to 2.6 does to the ends

    Raises
    ------
    InputError
        Where no profile is given.
    MeasurementError
        Names the profile and what is missing in it.

    References
    ----------
    Sec. IV.B, Fig. 21 and Table III of the paper.
    """
    several = [profiles] if isinstance(profiles, Profile) else list(profiles)
    if not several:
        raise InputError("no profile to measure", where="grooves", allowed="one or more")
    each = [_measure(profile, piece, unknown_curve) for profile in several]
    mean = {name: mean_length([lengths[name] for lengths in each]) for name in each[0]}
    return {
        name: Length(nominal, mean[name].value_mm, mean[name].sigma_mm)
        for name, nominal in piece.dimensions_mm().items()
    }


def _measure(profile: Profile, piece: GroovedBlock, unknown_curve: bool) -> dict[str, LengthBudget]:
    try:
        line = trace(profile)
        parts = find_parts(line, piece)
        return {**_heights(line, parts), **_separations(line, parts, unknown_curve)}
    except MeasurementError as error:
        raise MeasurementError(f"profile at {profile.position_mm:g} mm: {error}") from error


def find_parts(line: Trace, piece: GroovedBlock) -> Parts:
    """The tops, groove bottoms and floor in one profile of the grooved block.

    The tops are the highest level that a good part of the profile lies on; what lies between
    two of them is a groove, what lies outside them the floor.

    Parameters
    ----------
    line : Trace, mm, the profile's points from left to right
    piece : GroovedBlock, the nominal shape

    Raises
    ------
    MeasurementError
        Names what is missing.
    """
    found = segments(line)
    shallowest = min(groove.depth_mm for groove in piece.grooves)
    ridges = _ridges(line, found, piece, shallowest)
    bottoms = []
    for number, (left, right) in enumerate(pairwise(ridges), start=1):
        limit = left.level_mm - shallowest / 2
        if not (inside := _below(found, left.points[-1], right.points[0], limit)):
            raise MeasurementError(f"the bottom of groove {number} is not seen")
        # Beside the bottom, pieces of lit wall may stand: the bottom is the widest piece.
        bottoms.append(_widest_level(line, inside))
    top = float(np.median([ridge.level_mm for ridge in ridges]))
    deepest = top - max(groove.depth_mm for groove in piece.grooves)
    limit = (deepest + top - piece.height_mm) / 2
    beside = [
        *_below(found, -1, ridges[0].points[0], limit),
        *_below(found, ridges[-1].points[-1], len(line.x), limit),
    ]
    if not beside:
        raise MeasurementError("the floor beside the block is not seen")
    return Parts(ridges, tuple(bottoms), _widest_level(line, beside))


def _ridges(
    line: Trace, found: list[Segment], piece: GroovedBlock, shallowest_mm: float
) -> tuple[Segment, ...]:
    """The tops from left to right, pieces broken by missing points joined."""
    narrowest = min(piece.last_ridge_mm, *(groove.ridge_mm for groove in piece.grooves))
    wide = [part for part in found if _width(line, part) > narrowest / 4]
    wanted = len(piece.grooves) + 1
    if not wide:
        raise MeasurementError(f"no level segment found, the block has {wanted} tops")
    top = max(part.level_mm for part in wide)
    tops = [part for part in wide if part.level_mm > top - shallowest_mm / 4]
    gap = min(groove.width_mm for groove in piece.grooves) / 2
    groups: list[list[Segment]] = []
    for part in tops:
        if groups and line.x[part.points[0]] - line.x[groups[-1][-1].points[-1]] < gap:
            groups[-1].append(part)
        else:
            groups.append([part])
    ridges = tuple(join_segments(group, line) for group in groups)
    ridges = tuple(ridge for ridge in ridges if _width(line, ridge) > narrowest / 2)
    if len(ridges) != wanted:
        raise MeasurementError(f"{len(ridges)} tops found, the block has {wanted}")
    return ridges


def _below(found: list[Segment], start: int, stop: int, limit_mm: float) -> list[Segment]:
    """The segments between two points of the trace that lie lower than a level."""
    return [
        part
        for part in found
        if part.level_mm < limit_mm and start < part.points[0] and part.points[-1] < stop
    ]


def _widest_level(line: Trace, parts: list[Segment]) -> Segment:
    """The widest of the segments, joined with the others on its level."""
    widest = max(parts, key=lambda part: _width(line, part))
    level = [part for part in parts if abs(part.level_mm - widest.level_mm) < 2.0]
    return join_segments(level, line)


def _width(line: Trace, part: Segment) -> float:
    return float(line.x[part.points[-1]] - line.x[part.points[0]])


def _heights(line: Trace, parts: Parts) -> dict[str, LengthBudget]:
    """H1, H3, H4 from each groove's bottom to the tops on both its sides; H2 to the floor."""
    first, second, third = parts.bottoms
    ridges, heights = parts.ridges, {}
    for name, upper, lower in (
        ("H3", ridges[:2], first),
        ("H4", ridges[1:3], second),
        ("H1", ridges[2:4], third),
        ("H2", ridges, parts.floor),
    ):
        tops = np.concatenate([inner_points(line, part) for part in upper])
        try:
            heights[name] = height_between(line, tops, inner_points(line, lower))
        except MeasurementError as error:
            raise MeasurementError(f"{name}: {error}") from error
    return heights


def _separations(line: Trace, parts: Parts, unknown_curve: bool) -> dict[str, LengthBudget]:
    """Widths and separations along the tops, from the ends of the tops' segments."""
    ends = segment_ends(line, parts.ridges, unknown_curve)
    left, right = [end[0] for end in ends], [end[1] for end in ends]
    return {
        "W1": _between(line, right[0], left[1]),
        "W2": _between(line, right[1], left[2]),
        "W3": _between(line, right[2], left[3]),
        "S1": _between(line, left[0], right[2]),
        "S2": _between(line, left[1], left[3]),
    }


def _between(line: Trace, start: End, stop: End) -> LengthBudget:
    """Distance along the tops from one end to another, to its right."""
    along = float(np.hypot(1.0, line.tilt))
    ends = (start.point, stop.point)
    curve = stop.curve_mm - start.curve_mm
    common = np.linalg.norm([start.common_mm, stop.common_mm, curve])
    modes, place = None, 0.0
    if line.modes is None:
        place = float(np.hypot(*line.sigma_x[list(ends)]))
    else:
        modes = along * (line.modes[stop.point, 0] - line.modes[start.point, 0])
    return LengthBudget(
        value_mm=along * (stop.x_mm - start.x_mm),
        own_mm=along * float(np.hypot(start.own_mm, stop.own_mm)),
        common_mm=along * float(np.hypot(common, place)),
        modes_mm=modes,
    )


# A measured slice of the sandwave against eq. (4) (Figs. 29 to 32).


_SCALE_POINTS = 20_000  # of a surface: more make the scale no better known, their errors are alike
_BORDER_MM = 3.0  # of the waves, where the surface steps to the rim


@dataclass(frozen=True)
class SliceErrors:
    """Errors of a slice, measured minus eq. (4).

    Attributes
    ----------
    nominal_mm : (M,) array, mm, eq. (4) at each point of the slice, also beyond the border of the
        waves
    error_mm : (M,) array, mm, at each point of the slice; NaN where it was not compared
    points : int, number compared
    unseen : int, number without data, or known to be out of sight
    at_step : int, number left out beside the border of the waves: there the surface steps to the
        rim, and a height measured over a radius is neither the one nor the other
    """

    nominal_mm: Floats
    error_mm: Floats
    points: int
    unseen: int
    at_step: int

    def __str__(self) -> str:
        """The errors in words."""
        ends = f"{self.min_mm:.3f} to {self.max_mm:.3f} mm"
        return f"{self.rmse_mm:.3f} mm rms, {ends}, of {self.points} points"

    @property
    def rmse_mm(self) -> float:
        """Root of the mean squared error, mm."""
        return float(np.sqrt(np.nanmean(self.error_mm**2)))

    @property
    def min_mm(self) -> float:
        """Most negative error, mm."""
        return float(np.nanmin(self.error_mm))

    @property
    def max_mm(self) -> float:
        """Most positive error, mm."""
        return float(np.nanmax(self.error_mm))

    def as_json(self) -> dict[str, float | int]:
        """Counts and errors under the keys results.json uses."""
        return {
            "points": self.points,
            "unseen": self.unseen,
            "rmse_mm": self.rmse_mm,
            "min_mm": self.min_mm,
            "max_mm": self.max_mm,
        }


def compare_slice(measured: Slice, piece: Sandwave, visible: Mask | None = None) -> SliceErrors:
    """The errors of a slice against eq. (4) of the sandwave.

    Points nearer to the border of the waves, or farther out, than the radius over which the
    slice's heights were taken are counted as ``at_step`` and not compared.

    Parameters
    ----------
    measured : Slice, of M points, mm, frame of the workpiece
    piece : Sandwave, the nominal shape
    visible : (M,) mask, optional, of the points known to be lit and seen; by default all

    Raises
    ------
    MeasurementError
        Where no point is left to compare.

    References
    ----------
    Eq. (4) and Figs. 29 to 32 of the paper.
    """
    x, y = measured.xy_mm.T
    inside = piece.inset_mm(x, y) >= measured.radius_mm
    seen = has_value(measured.status)
    if visible is not None:
        seen &= visible
    compared = inside & seen
    if not compared.any():
        what = f"slice: none of its {len(x)} points has data on the waves to compare with eq. (4)"
        raise MeasurementError(what)
    nominal = piece.height_mm(x, y)
    return SliceErrors(
        nominal_mm=nominal,
        error_mm=np.where(compared, measured.z_mm - nominal, np.nan),
        points=int(compared.sum()),
        unseen=int((inside & ~seen).sum()),
        at_step=int((~inside).sum()),
    )


def scale_along_track(surface: Surface, piece: Sandwave) -> float:
    """How long the sandwave is along y beside its design: above 1 where the track moves too little.

    Eq. (4) is fitted to the heights with y stretched about the middle, and shifts along x, y and z
    beside it, by least squares that outliers hardly move (soft L1).  The waves' meander shows the
    scale: 8,000 heights that scatter by 0.5 mm give it to 1e-3.

    Parameters
    ----------
    surface : Surface, mm, frame of the workpiece
    piece : Sandwave, the nominal shape

    Raises
    ------
    MeasurementError
        Where fewer than 100 points lie on the waves.

    References
    ----------
    Eq. (4) of the paper.
    """
    x, y, z = np.moveaxis(surface.xyz_mm, -1, 0)
    valued = has_value(surface.status) & np.isfinite(x + y + z)
    at = np.flatnonzero(valued & (piece.inset_mm(x, y) > _BORDER_MM))
    if len(at) < 100:
        raise MeasurementError(f"{len(at)} points lie on the waves, 100 are needed for their scale")
    at = at[:: max(1, len(at) // _SCALE_POINTS)]
    x, y, z = x.ravel()[at], y.ravel()[at], z.ravel()[at]
    middle = piece.side_mm / 2

    def miss(fit: Floats) -> Floats:
        stretch, along_x, along_y, up = fit
        designed = middle + (y - middle) / stretch + along_y
        return z - piece.height_mm(x + along_x, designed) - up

    fit = least_squares(miss, [1.0, 0.0, 0.0, 0.0], loss="soft_l1", f_scale=0.5)
    return float(fit.x[0])
