"""What a serial track refuses, and what it says, while it is being opened."""

import logging
from typing import Any

import pytest
from grbl_line import DirectLine, SimulatedTime

from lscan.devices.grbl import SerialTrack, SerialTrackOptions, open_track
from lscan.errors import DeviceError
from sim.emulators.grbl import GrblEmulator, MarlinEmulator

FASTEST_MM_MIN = 1234.5


def opened(
    emulator: type[GrblEmulator] | type[MarlinEmulator] = GrblEmulator,
    machine: dict[int, float] | None = None,
    **values: Any,
) -> SerialTrack:
    time = SimulatedTime()
    plain = {"port": "here", "min_mm": 0.0, "max_mm": 40.0, "zero_mm": -190.0}
    options = SerialTrackOptions(**{**plain, **values})
    line = DirectLine(emulator(machine, clock=time), time)
    return open_track(options, line, time, time.sleep)


def test_a_feed_above_the_controllers_is_refused_with_both_numbers() -> None:
    machine = {110: FASTEST_MM_MIN}
    with pytest.raises(DeviceError, match=r"feed_mm_min is 1235, .* 1234\.5 mm/min; lower it"):
        opened(machine=machine, feed_mm_min=1235.0)
    opened(machine=machine, feed_mm_min=FASTEST_MM_MIN).close()


def test_only_the_tracks_own_axis_limits_its_feed() -> None:
    machine = {110: 3000.0, 112: 300.0}
    opened(machine=machine, feed_mm_min=3000.0).close()
    with pytest.raises(DeviceError, match=r"feed_mm_min is 3000, .* 300 mm/min"):
        opened(machine=machine, feed_mm_min=3000.0, axis="Z")


def test_a_refused_feed_moves_nothing() -> None:
    time = SimulatedTime()
    emulator = GrblEmulator({110: FASTEST_MM_MIN}, clock=time)
    before_mm = emulator.head_mm
    options = SerialTrackOptions(
        port="here", min_mm=0, max_mm=40, zero_mm=-190, feed_mm_min=2 * FASTEST_MM_MIN
    )
    with pytest.raises(DeviceError):
        open_track(options, DirectLine(emulator, time), time, time.sleep)
    assert emulator.head_mm == before_mm


def test_marlin_on_grbl_names_the_dialect() -> None:
    with pytest.raises(DeviceError, match=r"M115.*set track\.options\.dialect = 'grbl'"):
        opened(GrblEmulator, dialect="marlin")


def test_grbl_on_marlin_names_the_dialect() -> None:
    with pytest.raises(DeviceError, match=r"no Grbl banner.*track\.options\.dialect.*'marlin'"):
        opened(MarlinEmulator, dialect="grbl")


@pytest.mark.parametrize("dialect", ["grbl", "marlin"])
def test_homing_is_announced_before_it_begins(
    dialect: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING)
    emulator = GrblEmulator if dialect == "grbl" else MarlinEmulator
    opened(emulator, dialect=dialect, homing_s=45.0).close()
    assert caplog.messages == [f"{dialect} track on here: homing, within 45 s"]


def test_homing_that_fails_has_been_announced(caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(DeviceError):
        opened(machine={20: 0, 22: 0})
    assert "grbl track on here: homing, within 60 s" in caplog.messages


def test_without_homing_nothing_is_announced(caplog: pytest.LogCaptureFixture) -> None:
    opened(machine={20: 0, 22: 0}, homing=False, zero_mm=0.0).close()
    assert caplog.messages == []
