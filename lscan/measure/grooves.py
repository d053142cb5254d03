"""The nine dimensions of the grooved block from its profile (Sec. IV.B, Fig. 21, Table III)."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from lscan.config.targets import GroovedBlock
from lscan.errors import InputError, MeasurementError
from lscan.measure.ends import End, segment_ends
from lscan.measure.lengths import LengthBudget, mean_length
from lscan.measure.segments import (
    Segment,
    Trace,
    height_between,
    inner_points,
    joined,
    segments,
    trace,
)
from lscan.records import Length, Profile


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
    profiles: Profile | Sequence[Profile], piece: GroovedBlock
) -> dict[str, Length]:
    """The dimensions W1 to S2 of Table III, mm, measured as in the paper.

    Widths and separations lie between the end points of the tops' laser segments, measured
    along the tops; heights are distances between straight lines fitted to segments with a
    common slope.  Of several profiles the mean is given, weighted by each one's noise, outliers
    left out.  Its sigma_mm holds the noise of that mean and, undiminished, what errs alike in all
    profiles: the calibration, of which only the difference it makes to the length counts where the
    plane map has modes; false light at the ends, or the columns' spacing where an end's
    brightness does not fall (ends.py); and what a level line's place within the pixel does to
    its height (segments.py).

    Parameters
    ----------
    profiles : Profile or sequence of Profile, mm, frame of the sheet.  The block stands along the
        track, so that the sheet cuts it square; it may be tilted in the sheet by some degrees and
        lie anywhere in it.
    piece : GroovedBlock, the nominal shape

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
    each = [_measure(profile, piece) for profile in several]
    mean = {name: mean_length([lengths[name] for lengths in each]) for name in each[0]}
    return {
        name: Length(nominal, mean[name].value_mm, mean[name].sigma_mm)
        for name, nominal in piece.dimensions_mm().items()
    }


def _measure(profile: Profile, piece: GroovedBlock) -> dict[str, LengthBudget]:
    try:
        line = trace(profile)
        parts = find_parts(line, piece)
        return {**_heights(line, parts), **_separations(line, parts)}
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
        inside = _below(found, left.points[-1], right.points[0], limit)
        if not inside:
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
    ridges = tuple(joined(group, line) for group in groups)
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
    return joined(level, line)


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


def _separations(line: Trace, parts: Parts) -> dict[str, LengthBudget]:
    """Widths and separations along the tops, from the ends of the tops' segments."""
    ends = segment_ends(line, parts.ridges)
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
    common = np.hypot(start.common_mm, stop.common_mm)
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
