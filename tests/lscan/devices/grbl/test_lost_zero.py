"""What a Grbl does when it is reset or in alarm, and what a scan that is resumed makes of it."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from grbl_line import DirectLine, SimulatedTime
from track_plant import FRAMES, START_MM, STEPPER_MM, UNHOMED, Plant, StillCamera, spacing_is_true

from lscan.acquisition.run import MANIFEST
from lscan.acquisition.scan import acquire_into
from lscan.acquisition.writer import resume_run
from lscan.devices.grbl import SerialTrackOptions, open_track
from lscan.errors import DeviceError
from sim.emulators.grbl import Faults, GrblEmulator, MarlinEmulator

SLOW = {"start_mm": 0.0, "step_mm": 5.0, "feed_mm_min": 100.0, "boot_s": 0.1}
"""A scan whose approaches take 3 s, on a controller that is open again after 0.1 s."""


def moving(plant: Plant, path: Path) -> Plant:
    """The plant after two frames, killed on its way to the third and still moving."""
    plant.scan(path, kill_after=2)
    assert plant.emulator.state == "Jog"
    assert len(plant.seen_mm) == 2
    return plant


def reset_in_motion(plant: Plant) -> None:
    """Another program, or the reset button: steps are lost, here 3 mm."""
    plant.emulator.receive(b"\x18")
    assert plant.emulator.state == "Alarm"
    there_mm = plant.emulator._axes._offset_mm
    plant.emulator._axes._offset_mm = (there_mm[0] + 3.0, *there_mm[1:])


@pytest.mark.parametrize("homing", [False, True])
def test_a_scan_killed_in_a_long_approach_is_resumed(tmp_path: Path, homing: bool) -> None:
    """The jog is cancelled before the soft reset, which in motion would be ALARM:3."""
    plant = moving(Plant(homing=homing, **SLOW), tmp_path / "a")
    run = plant.scan(tmp_path / "a")
    assert run is not None
    assert len(run) == FRAMES
    assert spacing_is_true(plant)


def test_what_another_program_left_running_is_held_before_the_reset() -> None:
    """G1 cannot be cancelled as a jog: it is held, and reset once at rest, position kept."""
    plant = Plant(boot_s=0.1)
    plant.emulator.transmit()  # its banner was read by that program
    plant.emulator.receive(b"G1X30F600\n")
    track = plant.open()
    assert plant.emulator.state == "Idle"
    assert 0 < track.position_mm < 30
    assert abs(track.position_mm - (plant.emulator.head_mm[0] - START_MM)) <= STEPPER_MM


def test_a_run_with_a_number_is_motion_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """grblHAL reports Run:1 while a hold is pending; a reset in it would be ALARM:3."""
    plant = Plant(boot_s=0.1)
    state = plant.emulator._state
    monkeypatch.setattr(plant.emulator, "_state", lambda: state().replace("Hold:1", "Run:1"))
    plant.emulator.transmit()
    plant.emulator.receive(b"G1X30F600\n")
    track = plant.open()
    assert plant.emulator.state == "Idle"
    assert abs(track.position_mm - (plant.emulator.head_mm[0] - START_MM)) <= STEPPER_MM


def test_braking_may_take_longer_than_an_answer() -> None:
    """1800 mm/min at Grbl's default of 10 mm/s² ($120) end in 3 s; answer_s is 2."""
    plant = Plant(boot_s=0.1)
    plant.emulator.transmit()
    plant.emulator.receive(b"$120=10\n$J=X500F1800\n")
    plant.time.sleep(10.0)
    assert plant.open().position_mm > 0
    assert plant.emulator.state == "Idle"


def test_an_alarm_names_what_unlocks_and_what_it_costs(tmp_path: Path) -> None:
    """Where $22=0 nothing sends the user to $H, which would answer error:5."""
    plant = moving(Plant(**SLOW), tmp_path / "a")
    reset_in_motion(plant)
    with pytest.raises(
        DeviceError, match=r"state Alarm; .*\$X.*position lost.*\(\$22=0\)"
    ) as caught:
        plant.open()
    assert "$H" not in str(caught.value)
    homed = GrblEmulator({}, clock=plant.time)  # $22=1: locked from power-up
    options = SerialTrackOptions(port="here", min_mm=0, max_mm=9, zero_mm=-50, homing=False)
    with pytest.raises(DeviceError, match=r"state Alarm; .*home \(\$H.*\$X only unlocks"):
        open_track(options, DirectLine(homed, plant.time), plant.time, plant.time.sleep)


@pytest.mark.parametrize("looked", [False, True])
def test_unlocked_without_homing_a_scan_does_not_go_on(tmp_path: Path, looked: bool) -> None:
    """Also where the track was opened in between, as by lscan devices or the live page."""
    plant = moving(Plant(**SLOW), tmp_path / "a")
    reset_in_motion(plant)
    plant.emulator.receive(b"$X\n")
    if looked:
        plant.open().close()
    with pytest.raises(DeviceError, match=r"restarted, reset or in alarm.*--position-restored"):
        plant.scan(tmp_path / "a")
    assert len(plant.seen_mm) == 2, "nothing was taken"


def test_once_restored_it_stays_so(tmp_path: Path) -> None:
    plant = moving(Plant(**SLOW), tmp_path / "a")
    reset_in_motion(plant)
    plant.emulator = GrblEmulator(UNHOMED, (START_MM,) * 3, plant.time)  # pushed back by hand
    with pytest.raises(DeviceError, match="--position-restored"):
        plant.scan(tmp_path / "a")
    assert plant.scan(tmp_path / "a", 4, position_restored=True) is None
    assert plant.scan(tmp_path / "a") is not None
    assert spacing_is_true(plant)


def test_an_alarm_met_in_a_scan_is_kept_in_the_run(tmp_path: Path) -> None:
    """A controller may be unlocked without a reset: the run itself says what was lost."""
    plant = Plant(**SLOW)
    plant.scan(tmp_path / "a", 2)
    begun = json.loads((tmp_path / "a" / MANIFEST).read_text())["track_zero"]
    track = plant.open()
    plant.emulator.inject(replace(Faults(alarm=True), begin_s=plant.time()))
    with resume_run(tmp_path / "a", plant.rig_file) as writer, pytest.raises(DeviceError):
        acquire_into(writer, StillCamera(plant), track)
    kept = json.loads((tmp_path / "a" / MANIFEST).read_text())["track_zero"]
    assert begun.startswith("F")
    assert kept == "lost"


def test_a_homed_run_keeps_nothing(tmp_path: Path) -> None:
    Plant(homing=True).scan(tmp_path / "a", 2)
    assert "track_zero" not in json.loads((tmp_path / "a" / MANIFEST).read_text())


def test_marlin_ends_what_was_begun_and_without_homing_asks() -> None:
    """It reports no restart between two openings, and M410 would lose steps."""
    time = SimulatedTime()
    emulator = MarlinEmulator(clock=time)
    options = SerialTrackOptions(
        port="here", dialect="marlin", min_mm=0, max_mm=40, homing=False, boot_s=0.1
    )
    emulator.receive(b"G1 X30 F600\n")
    track = open_track(options, DirectLine(emulator, time), time, time.sleep)
    assert track.position_mm == 30.0
    assert emulator.head_mm[0] == pytest.approx(START_MM + 30.0)
    track.move_to(31.0)
    track.check_place(30.0, 31.0, track.zero)
    with pytest.raises(DeviceError, match=r"Marlin does not report.*--position-restored"):
        track.check_place(30.0, 31.0, "that of an earlier opening")
