"""A scan resumed on a track without homing: never a frame at a shifted place."""

from pathlib import Path

import pytest
from track_plant import FRAMES, START_MM, UNHOMED, Plant, StillCamera, spacing_is_true, stop_after

from lscan.acquisition.scan import acquire_into
from lscan.acquisition.writer import resume_run
from lscan.devices.api import PlaceChecking
from lscan.errors import DeviceError
from sim.emulators.grbl import GrblEmulator


@pytest.mark.parametrize("done", [2, 5, 7])
@pytest.mark.parametrize("homing", [False, True])
def test_a_controller_that_ran_on_is_resumed(tmp_path: Path, done: int, homing: bool) -> None:
    plant = Plant(homing=homing)
    assert plant.scan(tmp_path / "a", done) is None
    run = plant.scan(tmp_path / "a")
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
    plant.scan(tmp_path / "a", done)
    plant.emulator.power_cycle()
    with pytest.raises(DeviceError, match="reports 0 mm, the last frame was recorded at") as caught:
        plant.scan(tmp_path / "a")
    assert "\n" not in str(caught.value)
    assert len(plant.seen_mm) == done, "nothing was taken"
    assert spacing_is_true(plant)


def test_with_homing_a_restart_shifts_nothing(tmp_path: Path) -> None:
    plant = Plant(homing=True)
    plant.scan(tmp_path / "a", 4)
    plant.emulator.power_cycle()
    run = plant.scan(tmp_path / "a")
    assert run is not None
    assert spacing_is_true(plant)


@pytest.mark.parametrize("done", [1, 4])
def test_what_the_message_says_to_do_works(tmp_path: Path, done: int) -> None:
    """The head pushed back to zero with the power off, the controller switched on."""
    plant = Plant()
    plant.scan(tmp_path / "a", done)
    plant.emulator.power_cycle()
    with pytest.raises(DeviceError) as caught:
        plant.scan(tmp_path / "a")
    assert "switch it on, and resume with --position-restored" in str(caught.value)
    plant.emulator = GrblEmulator(UNHOMED, (START_MM,) * 3, plant.time)
    run = plant.scan(tmp_path / "a", position_restored=True)
    assert run is not None
    assert spacing_is_true(plant)


def test_a_head_jogged_away_is_refused_until_it_is_back(tmp_path: Path) -> None:
    plant = Plant()
    plant.scan(tmp_path / "a", 5)
    for place_mm in (15.0, -2.0):
        operator = plant.open()
        operator.move_to(place_mm)
        operator.close()
        with pytest.raises(DeviceError, match=rf"reports {place_mm:g} mm.*jog to 2 mm"):
            plant.scan(tmp_path / "a")
    operator = plant.open()
    operator.move_to(2.0)
    operator.close()
    assert plant.scan(tmp_path / "a") is not None
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
        track.check_place(last_mm, next_mm, track.zero)
    else:
        with pytest.raises(DeviceError, match="shifted places"):
            track.check_place(last_mm, next_mm, track.zero)


def test_a_track_watched_since_it_was_opened_is_not_compared(tmp_path: Path) -> None:
    """A scan paused and resumed in one session, the head moved meanwhile by the page."""
    plant = Plant()
    track, camera = plant.open(), StillCamera(plant)
    with resume_run(tmp_path / "a", plant.rig_file) as writer:
        with pytest.raises(KeyboardInterrupt):
            acquire_into(writer, camera, track, stop_after(3))
        track.move_to(20.0)
        assert acquire_into(writer, camera, track).state == "complete"
    assert spacing_is_true(plant)


def test_zero_may_lie_elsewhere() -> None:
    """zero_mm = -30: a controller that has just started reports 30 mm."""
    plant = Plant(zero_mm=-30.0)
    assert isinstance(plant.open(), PlaceChecking)
    with pytest.raises(DeviceError, match=r"reports 30 mm.*30 mm is where the head stands when"):
        plant.open().check_place(29.5, 30.0, "another")
