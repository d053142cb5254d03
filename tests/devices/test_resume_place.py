"""A scan resumed on a track without homing: never a frame at a shifted place."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from lscan.acquire import acquire_into
from lscan.devices.api import Grab, PlaceChecking
from lscan.devices.grbl import SerialTrack, SerialTrackOptions, open_track
from lscan.errors import DeviceError
from lscan.rig import RigFile, parse_rig
from lscan.run import Run
from lscan.runwriter import resume_run
from sim.grbl import DirectLine, GrblEmulator, SimulatedTime

UNHOMED = {20: 0, 22: 0}  # neither soft limits nor homing, so no alarm at power-up
START_MM = -50.0  # of the head at power-up, counted from the switches
STEP_MM = 0.5
STEPPER_MM = 1 / 250  # $100
FRAMES = 8


@dataclass
class Plant:
    """One controller and its head, over several sittings; time is simulated."""

    homing: bool = False
    zero_mm: float = 0.0
    approach_mm: float = 1.0
    start_mm: float = 0.0
    step_mm: float = STEP_MM
    time: SimulatedTime = field(default_factory=SimulatedTime)
    seen_mm: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        settings = None if self.homing else UNHOMED
        self.emulator = GrblEmulator(settings, (START_MM,) * 3, self.time)

    def open(self) -> SerialTrack:
        options = SerialTrackOptions(
            port="here",
            min_mm=-20.0,
            max_mm=40.0,
            zero_mm=-100.0 if self.homing else self.zero_mm,
            approach_mm=self.approach_mm,
            homing=self.homing,
        )
        return open_track(options, DirectLine(self.emulator, self.time), self.time, self.time.sleep)

    def sitting(self, path: Path, frames: int | None = None) -> Run | None:
        """Scan, resuming what there is; stopped after ``frames`` frames of the whole, if given."""
        track, camera = self.open(), _Camera(self)
        try:
            with resume_run(path, self.rig_file) as writer:
                return acquire_into(writer, camera, track, _stop_after(frames))
        except KeyboardInterrupt:
            return None
        finally:
            track.close()

    @property
    def rig_file(self) -> RigFile:
        document = {
            "camera": {"driver": "fake", "width_px": 20, "height_px": 16},
            "track": {"driver": "grbl"},
            "plan": {"start_mm": self.start_mm, "step_mm": self.step_mm, "frames": FRAMES},
        }
        return parse_rig(document, source="rig.toml", trusted=True)


@dataclass
class _Camera:
    """Notes where the head truly is for each picture."""

    plant: Plant
    size_px: tuple[int, int] = (20, 16)

    def grab(self, frame: int | None = None, dark: bool = False) -> Grab:
        self.plant.time.sleep(0.04)
        self.plant.seen_mm.append(self.plant.emulator.head_mm[0])
        return Grab(np.zeros((16, 20), np.uint8), self.plant.time(), 20.0)

    def close(self) -> None: ...


def _stop_after(frames: int | None):
    def progress(done: int, _: int) -> None:
        if done == frames:
            raise KeyboardInterrupt

    return progress


def spacing_is_true(plant: Plant) -> bool:
    """Whether the head was where the plan says at every picture, to a step of the motor."""
    true_mm = np.array(plant.seen_mm) - plant.seen_mm[0]
    planned_mm = plant.step_mm * np.arange(len(true_mm))
    return bool(np.abs(true_mm - planned_mm).max() <= STEPPER_MM + 0.001)


@pytest.mark.parametrize("done", [2, 5, 7])
@pytest.mark.parametrize("homing", [False, True])
def test_a_controller_that_ran_on_is_resumed(tmp_path: Path, done: int, homing: bool) -> None:
    plant = Plant(homing=homing)
    assert plant.sitting(tmp_path / "a", done) is None
    run = plant.sitting(tmp_path / "a")
    assert run is not None
    assert len(run) == FRAMES
    assert spacing_is_true(plant)


@pytest.mark.parametrize("start_mm", [0.0, 10.0, -3.0])
@pytest.mark.parametrize("step_mm", [0.5, -0.5, 2.0])
@pytest.mark.parametrize("done", [1, 2, 3, 6])
def test_a_restarted_controller_is_refused(
    tmp_path: Path, start_mm: float, step_mm: float, done: int
) -> None:
    """Also near the place where it started, where the window for the head holds zero."""
    plant = Plant(start_mm=start_mm, step_mm=step_mm)
    plant.sitting(tmp_path / "a", done)
    plant.emulator.power_cycle()
    with pytest.raises(DeviceError, match="reports 0 mm, the last frame was recorded at") as caught:
        plant.sitting(tmp_path / "a")
    assert "\n" not in str(caught.value)
    assert len(plant.seen_mm) == done, "nothing was taken"
    assert spacing_is_true(plant)


def test_with_homing_a_restart_shifts_nothing(tmp_path: Path) -> None:
    plant = Plant(homing=True)
    plant.sitting(tmp_path / "a", 4)
    plant.emulator.power_cycle()
    run = plant.sitting(tmp_path / "a")
    assert run is not None
    assert spacing_is_true(plant)


@pytest.mark.parametrize("done", [1, 4])
def test_what_the_message_says_to_do_works(tmp_path: Path, done: int) -> None:
    """The head pushed back to zero with the power off, the controller switched on, a jog."""
    plant = Plant()
    plant.sitting(tmp_path / "a", done)
    plant.emulator.power_cycle()
    with pytest.raises(DeviceError) as caught:
        plant.sitting(tmp_path / "a")
    jog_mm = float(str(caught.value).partition("then jog to ")[2].split()[0])
    pushed = GrblEmulator(UNHOMED, (START_MM,) * 3, plant.time)
    plant.emulator = pushed
    operator = plant.open()
    operator.move_to(jog_mm)
    operator.close()
    run = plant.sitting(tmp_path / "a")
    assert run is not None
    assert spacing_is_true(plant)


def test_a_head_jogged_away_is_refused_until_it_is_back(tmp_path: Path) -> None:
    plant = Plant()
    plant.sitting(tmp_path / "a", 5)
    for place_mm in (15.0, -2.0):
        operator = plant.open()
        operator.move_to(place_mm)
        operator.close()
        with pytest.raises(DeviceError, match=rf"reports {place_mm:g} mm.*jog to 2\.5 mm"):
            plant.sitting(tmp_path / "a")
    operator = plant.open()
    operator.move_to(2.5)
    operator.close()
    assert plant.sitting(tmp_path / "a") is not None
    assert spacing_is_true(plant)


# Frames at 4 and 4.5 mm; approach 1 mm; tolerance 0.02 mm.
@pytest.mark.parametrize(
    ("stands_mm", "accepted"),
    [(2.95, False), (3.0, True), (4.0, True), (4.5, True), (4.55, False)],
)
@pytest.mark.parametrize("step_mm", [0.5, -0.5])
def test_the_window_reaches_from_the_approach_to_the_farther_place(
    stands_mm: float, accepted: bool, step_mm: float
) -> None:
    plant = Plant(approach_mm=1.0)
    plant.open().move_to(stands_mm)
    last_mm, next_mm = (4.0, 4.5) if step_mm > 0 else (4.5, 4.0)
    track = plant.open()
    if accepted:
        track.check_place(last_mm, next_mm)
    else:
        with pytest.raises(DeviceError, match="shifted places"):
            track.check_place(last_mm, next_mm)


def test_a_track_watched_since_it_was_opened_is_not_compared(tmp_path: Path) -> None:
    """A scan paused and taken up in one sitting, the head moved meanwhile by the page."""
    plant = Plant()
    track, camera = plant.open(), _Camera(plant)
    with resume_run(tmp_path / "a", plant.rig_file) as writer:
        with pytest.raises(KeyboardInterrupt):
            acquire_into(writer, camera, track, _stop_after(3))
        track.move_to(20.0)
        assert acquire_into(writer, camera, track).state == "complete"
    assert spacing_is_true(plant)


def test_zero_may_lie_elsewhere() -> None:
    """zero_mm = -30: a controller that has just started reports 30 mm."""
    plant = Plant(zero_mm=-30.0)
    assert isinstance(plant.open(), PlaceChecking)
    with pytest.raises(DeviceError, match=r"reports 30 mm.*takes where the head stands for 30 mm"):
        plant.open().check_place(29.5, 30.0)
