"""Trying out a track: where it is sent, what is made of what it reports, what it says of itself."""

from itertools import pairwise
from typing import Any

import pytest
from drawn_examples import examples
from grbl_line import DirectLine, SimulatedTime
from hypothesis import given, strategies as st

from lscan.devices.api import Describing, Track
from lscan.devices.grbl import SerialTrack, SerialTrackOptions, open_track
from lscan.devices.trials import repeatability, try_track
from lscan.errors import DeviceError, InputError
from sim.emulators.grbl import GrblEmulator, MarlinEmulator

REVERSAL_MM, OFFSET_MM = 0.03, 0.01


class EndlessTrack:
    """States no limits, and has some: 0 to 10 mm.

    It reports ``OFFSET_MM`` more than where it was sent, and after a move downwards
    ``REVERSAL_MM`` less than that.
    """

    def __init__(self, position_mm: float) -> None:
        self.position_mm = self._sent_mm = position_mm

    def move_to(self, position_mm: float) -> float:
        if not 0 <= position_mm <= 10:
            raise DeviceError(f"track: cannot move to {position_mm} mm; limits 0 and 10 mm")
        downwards = position_mm < self._sent_mm
        self._sent_mm = position_mm
        self.position_mm = position_mm + OFFSET_MM - REVERSAL_MM * downwards
        return self.position_mm

    def close(self) -> None:
        pass


class LimitedTrack:
    """Stands beyond its limits when it is opened, as after homing; refuses to be sent there."""

    tolerance_mm = 0.0

    def __init__(self, position_mm: float, low_mm: float, high_mm: float) -> None:
        self.position_mm, self.limits_mm = position_mm, (low_mm, high_mm)

    def move_to(self, position_mm: float) -> float:
        if not self.limits_mm[0] <= position_mm <= self.limits_mm[1]:
            raise DeviceError(f"track: cannot move to {position_mm} mm")
        self.position_mm = position_mm
        return position_mm

    def close(self) -> None:
        pass


# ---- repeatability ----------------------------------------------------------------------


def test_repeatability_of_numbers_worked_by_hand() -> None:
    """1, 2, 3 µm: mean 2, standard deviation 1; 5, 5, 8 µm: mean 6, standard deviation √3."""
    found = repeatability(10.0, [10.001, 10.002, 10.003], [10.005, 10.005, 10.008])
    assert (found.place_mm, found.approaches) == (10.0, 3)
    assert found.deviation_mm == pytest.approx(0.004)
    assert found.upward_sigma_mm == pytest.approx(0.001)
    assert found.downward_sigma_mm == pytest.approx(0.001 * 3**0.5)
    assert found.reversal_mm == pytest.approx(-0.004)


def test_a_reversal_is_distinguished_from_an_offset() -> None:
    found = try_track(EndlessTrack(5.0), approaches=4).repeatability
    assert found.reversal_mm == pytest.approx(REVERSAL_MM)
    assert found.deviation_mm == pytest.approx(OFFSET_MM - REVERSAL_MM / 2)
    # What is left of equal numbers: rounding, near 5 mm.
    assert max(found.upward_sigma_mm, found.downward_sigma_mm) < 1e-12


# ---- where it is sent -------------------------------------------------------------------


@pytest.mark.parametrize(("stood_mm", "place_mm"), [(5.0, 5.0), (0.0, 1.0), (0.4, 1.4), (9.8, 8.8)])
def test_a_track_of_unknown_limits_is_tried_within_them(stood_mm: float, place_mm: float) -> None:
    trial = try_track(EndlessTrack(stood_mm), approaches=2)
    assert trial.repeatability.place_mm == pytest.approx(place_mm)
    sent_mm = [move.commanded_mm for move in trial.moves]
    way_mm = [place_mm - 1, place_mm, place_mm + 1, place_mm] * 2
    assert sent_mm == pytest.approx([*way_mm, stood_mm])
    assert trial.facts == {}
    assert all(move.time_s >= 0 for move in trial.moves)


@examples(100)
@given(
    low_mm=st.floats(-1000, 1000),
    length_mm=st.floats(0, 300),
    beyond=st.floats(-0.2, 1.2),
    step_mm=st.floats(0.01, 20),
)
def test_a_track_is_never_sent_beyond_its_limits(
    low_mm: float, length_mm: float, beyond: float, step_mm: float
) -> None:
    """It would refuse.  The place is approached from both sides, the end is where it began."""
    high_mm = low_mm + length_mm
    stood_mm = low_mm + beyond * length_mm
    trial = try_track(LimitedTrack(stood_mm, low_mm, high_mm), 2, step_mm)
    sent_mm = [move.commanded_mm for move in trial.moves]
    assert all(low_mm <= target_mm <= high_mm for target_mm in sent_mm)
    assert sent_mm[-1] == min(max(stood_mm, low_mm), high_mm)
    way_mm = min(step_mm, length_mm / 2)
    rounding_mm = 1e-12 * 2000  # of numbers up to 1300 mm, a few times
    ways_mm = [abs(after - before) for before, after in pairwise(sent_mm[:-1])]
    assert ways_mm == pytest.approx([way_mm] * 7, abs=rounding_mm)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"approaches": 1}, r"too few approaches.*got 1; allowed: 2 or more"),
        ({"step_mm": 0.0}, r"step must be above 0 mm.*got 0.0"),
        ({"step_mm": float("nan")}, r"step must be above 0 mm"),
    ],
)
def test_what_cannot_be_tried_is_refused_before_a_move(
    values: dict[str, Any], message: str
) -> None:
    track = LimitedTrack(5.0, 0.0, 10.0)
    with pytest.raises(InputError, match=message):
        try_track(track, **values)
    assert track.position_mm == 5.0


def test_progress_counts_every_move() -> None:
    steps: list[tuple[int, int]] = []
    try_track(EndlessTrack(5.0), 2, progress=lambda done, total: steps.append((done, total)))
    assert steps == [(done, 9) for done in range(1, 10)]


# ---- controllers ------------------------------------------------------------------------


class NoisyLine(DirectLine):
    """On which, as soon as it is opened, ``noise`` comes before what is answered."""

    noise = b""

    def read(self, size: int = 1, /) -> bytes:
        noise, self.noise = self.noise, b""
        return noise + super().read(size)


def serial_track(
    machine: dict[int, float] | None = None, noise: bytes = b"", **values: Any
) -> SerialTrack:
    plain = {"port": "here", "min_mm": 0.0, "max_mm": 180.0, "zero_mm": -190.0}
    options = SerialTrackOptions(**{**plain, **values})
    time = SimulatedTime()
    kind = GrblEmulator if options.dialect == "grbl" else MarlinEmulator
    emulator = kind(machine, clock=time)
    line = NoisyLine(emulator, time)
    line.noise = noise
    return open_track(options, line, time, time.sleep)


def test_grbl_says_what_it_is_and_how_far_it_goes() -> None:
    """Travel of 200 mm below the switch at machine 0, which is 190 mm in the track's frame."""
    machine = {110: 3000.0, 120: 50.0, 100: 200.0}
    facts = serial_track(machine).describe()
    assert facts["firmware"] == "Grbl 1.1h"
    assert facts["state"] == "Idle"
    assert facts["noise_bytes"] == 0
    assert (facts["travel_low_mm"], facts["travel_high_mm"]) == (-10.0, 190.0)
    assert (facts["step_mm"], facts["max_mm_min"], facts["accel_mm_s2"]) == (1 / 200, 3000.0, 50.0)


def test_travel_is_reported_in_positions_also_where_they_run_the_other_way() -> None:
    facts = serial_track(invert=True, zero_mm=-10.0).describe()
    assert (facts["travel_low_mm"], facts["travel_high_mm"]) == (-10.0, 190.0)


def test_travel_without_limits_is_not_reported() -> None:
    facts = serial_track({20: 0.0}).describe()
    assert facts["travel_low_mm"] is facts["travel_high_mm"] is None


def test_noise_on_the_line_is_counted() -> None:
    """Five bytes before a line, and a line of six and its end with one unprintable within."""
    facts = serial_track(noise=bytes(range(0x80, 0x85)) + b"\r\nabc\x9cde\n").describe()
    assert facts["noise_bytes"] == 5 + 7


def test_marlin_says_its_name_and_no_more_than_it_knows() -> None:
    facts = serial_track(dialect="marlin").describe()
    assert facts["firmware"] == "Marlin bugfix-2.1.x (Dec 19 2022 12:00:00)"
    assert facts["travel_low_mm"] is facts["max_mm_min"] is facts["accel_mm_s2"] is None
    assert facts["step_mm"] == 0.01  # the last decimal of M114
    assert "state" not in facts


@pytest.mark.parametrize("dialect", ["grbl", "marlin"])
def test_a_controller_is_tried_from_both_sides(dialect: str) -> None:
    """Every stop is reached upwards, so that no reversal is left but the report's rounding.

    Homing leaves the head beyond max_mm, where it cannot be sent again.
    """
    track: Track = serial_track(dialect=dialect)
    assert isinstance(track, Describing)
    assert track.position_mm > 180.0
    trial = try_track(track)
    assert trial.facts == track.describe()
    assert trial.repeatability.place_mm == 179.0
    assert abs(trial.repeatability.reversal_mm) <= 0.005
    assert trial.moves[-1].commanded_mm == 180.0


def test_a_closed_track_says_nothing_of_itself() -> None:
    track = serial_track()
    track.close()
    with pytest.raises(DeviceError, match="grbl track on here: is closed"):
        track.describe()
