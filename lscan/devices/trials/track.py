"""Trying out a rig's track: moves from both sides, each timed, and how well they repeat."""

import statistics
import time
from dataclasses import dataclass

from lscan.devices.api import Describing, Fact, Limited, Track
from lscan.errors import DeviceError, InputError
from lscan.records import Progress

FEWEST_APPROACHES = 2
"""From either side: a standard deviation needs two."""


@dataclass(frozen=True)
class Move:
    """One move of the track: sent to commanded_mm, it reports reported_mm after time_s."""

    commanded_mm: float
    reported_mm: float
    time_s: float


@dataclass(frozen=True)
class Repeatability:
    """How well a place is found again, as the track itself reports it; after ISO 230-2.

    place_mm: where it was sent to, ``approaches`` times from either side.
    deviation_mm: mean of reported less commanded, over all approaches.
    upward_sigma_mm, downward_sigma_mm: standard deviations of the position reported after an
    approach from below, and from above.  reversal_mm: mean after approaches from below less
    mean after those from above.
    What the track does not see, a motor that lost steps or a loose belt, shows in none of them.
    """

    place_mm: float
    approaches: int
    deviation_mm: float
    upward_sigma_mm: float
    downward_sigma_mm: float
    reversal_mm: float


@dataclass(frozen=True)
class TrackTrial:
    """What a track turned out to be.

    Attributes
    ----------
    facts : dict, what it says of itself after the moves; none, where it is not :class:`Describing`
    repeatability : Repeatability, of the approaches, mm
    moves : tuple, all of them in their order, the last back to where it stood, or as near as it is
        sent
    """

    facts: dict[str, Fact]
    repeatability: Repeatability
    moves: tuple[Move, ...]


def try_track(
    track: Track, approaches: int = 5, step_mm: float = 1.0, progress: Progress | None = None
) -> TrackTrial:
    """Approaches to one place from ``step_mm`` below and above it, in turn, and the way back.

    The place is where the head stands, or so near as to leave ``step_mm`` within the limits on
    either side; on a track shorter than that, its middle.  One that states no limits is tried.

    Parameters
    ----------
    track : Track
        Ready to move.
    approaches : int
        How many from either side, 2 or more.
    step_mm : float
        Length of each approach, mm, above 0.
    progress : callable, optional
        Called with the number of moves done, and of all.

    Returns
    -------
    TrackTrial
        Positions in mm as the track reports them, times in s.

    Raises
    ------
    InputError
        For too few approaches, or a step that is not above 0.
    DeviceError
        Where the track fails.
    """
    if approaches < FEWEST_APPROACHES:
        raise InputError(
            "too few approaches to measure how they repeat",
            value=approaches,
            allowed=f"{FEWEST_APPROACHES} or more",
        )
    if not step_mm > 0:
        raise InputError("the step must be above 0 mm", value=step_mm)
    stood_mm = track.position_mm
    place_mm = _place_mm(track, stood_mm, step_mm)
    way_mm = [place_mm - step_mm, place_mm, place_mm + step_mm, place_mm] * approaches
    way_mm.append(stood_mm)
    moves: list[Move] = []
    for target_mm in way_mm:
        to_mm, began_s = _allowed_mm(track, target_mm), time.monotonic()
        reported_mm = track.move_to(to_mm)
        moves.append(Move(to_mm, reported_mm, time.monotonic() - began_s))
        if progress is not None:
            progress(len(moves), len(way_mm))
    return TrackTrial(
        facts=track.describe() if isinstance(track, Describing) else {},
        repeatability=repeatability(
            place_mm,
            [move.reported_mm for move in moves[1:-1:4]],
            [move.reported_mm for move in moves[3:-1:4]],
        ),
        moves=tuple(moves),
    )


def repeatability(
    place_mm: float, upward_mm: list[float], downward_mm: list[float]
) -> Repeatability:
    """From the positions in mm reported at one place, equally many from below and from above.

    ISO 230-2: estimators of unidirectional repeatability, with n - 1, and reversal value.
    """
    return Repeatability(
        place_mm=place_mm,
        approaches=len(upward_mm),
        deviation_mm=statistics.fmean([*upward_mm, *downward_mm]) - place_mm,
        upward_sigma_mm=statistics.stdev(upward_mm),
        downward_sigma_mm=statistics.stdev(downward_mm),
        reversal_mm=statistics.fmean(upward_mm) - statistics.fmean(downward_mm),
    )


def _place_mm(track: Track, stood_mm: float, step_mm: float) -> float:
    """The place nearest to where the head stands that has ``step_mm`` of way on either side."""
    if isinstance(track, Limited):
        return _allowed_mm(track, stood_mm, step_mm)
    for side_mm in (step_mm, -step_mm):
        try:
            track.move_to(stood_mm + side_mm)
        except DeviceError:
            return stood_mm - side_mm
    return stood_mm


def _allowed_mm(track: Track, position_mm: float, margin_mm: float = 0.0) -> float:
    """The position nearest to one, ``margin_mm`` within the limits: homing ends beyond them."""
    if not isinstance(track, Limited):
        return position_mm
    low_mm, high_mm = track.limits_mm
    margin_mm = min(margin_mm, (high_mm - low_mm) / 2)
    return min(max(position_mm, low_mm + margin_mm), high_mm - margin_mm)
