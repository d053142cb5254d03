"""The tank's camera and track: the contract of every device, and what is theirs alone."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helper_spies import calls_made, readiness
from places import SCENES

from lscan.config.rig import RigFile, load_rig, parse_rig
from lscan.devices.signals import interruption_kept
from lscan.errors import DeviceError, InputError
from sim.devices import SimCamera, SimTrack, TankCamera, TrackOptions, camera_driver, track_driver
from sim.render.plugins.camera import RefractiveCamera
from sim.render.tank import Tank
from sim.scene import scene_of

PAPER = SCENES / "paper"


def small(rig_file: RigFile, **sections: Any) -> RigFile:
    """The scene at 160 by 120 px, with sections laid over it."""
    document = dict(rig_file.document)
    lens = {**document["lens"], "focal_px": 212.5, "centre_px": [79.5, 59.5]}
    small_camera = {**document["camera"], "width_px": 160, "height_px": 120}
    document |= {"lens": lens, "camera": small_camera}
    for name, keys in sections.items():
        document[name] = {**document.get(name, {}), **keys} if isinstance(keys, dict) else keys
    return parse_rig(document, source="small")


@pytest.fixture(scope="module")
def rig_file() -> RigFile:
    return small(load_rig(PAPER / "sandwave.toml"), render={"scatter_samples": 0})


@pytest.fixture
def track() -> Iterator[SimTrack]:
    track = SimTrack(TrackOptions())
    yield track
    track.close()


@pytest.fixture
def camera(rig_file: RigFile, track: SimTrack) -> Iterator[SimCamera]:
    camera = camera_driver.open(rig_file, track)
    yield camera
    camera.close()


def test_pictures_depend_on_place_and_index_alone(rig_file: RigFile, track: SimTrack) -> None:
    """A camera opened anew, as a resumed scan does, gives the same bytes at the same index."""
    first = camera_driver.open(rig_file, track)
    for index, position in enumerate((0.0, 30.0, 60.0)):
        track.move_to(position)
        picture = first.grab(index)
    again = first.grab()
    grab = camera_driver.open(rig_file, track).grab(2)
    assert grab.image.tobytes() == picture.image.tobytes()
    assert grab.time_s == picture.time_s
    assert again.image.tobytes() != picture.image.tobytes(), "noise differs from grab to grab"
    assert again.time_s > picture.time_s


@pytest.mark.slow
def test_pictures_taken_ahead_are_the_same(
    track: SimTrack, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All orders of light, backgrounds, and what changes with each picture, in another process."""
    ready, made = readiness(monkeypatch), calls_made(monkeypatch)

    @contextmanager
    def one_more() -> Iterator[list[dict[str, str]]]:
        yield [{"LSCAN_THREADS": "2"}]

    monkeypatch.setattr("sim.render.backend.sharing", one_more)
    rig_file = small(
        load_rig(PAPER / "sandwave.toml"),
        plan={"frames": 100, "laser": "pairs"},
        render={"samples": 1},
        change=[{"key": "sensor.gain", "uniform": 0.1, "relative": True}],
    )
    scene = scene_of(rig_file)
    pictures, camera = TankCamera(scene), camera_driver.open(rig_file, track)
    for frame, position_mm in enumerate(rig_file.rig.plan.positions_mm()[:4]):
        track.move_to(position_mm)
        for dark in (False, True):
            track.laser_off() if dark else track.laser_on()
            found = camera.grab(frame, dark)
            alone = pictures(frame, position_mm, dark, not dark)
            assert found.image.tobytes() == alone.image.tobytes(), (frame, dark)
            assert (found.time_s, found.exposure_ms) == (alone.time_s, alone.exposure_ms)
            if (frame, dark) == (0, False):  # the others begin after the first picture
                assert ready.acquire(timeout=60.0)
    camera.close()
    assert len(made) > 2, "none was taken ahead"


def test_the_line_moves_with_the_track(camera: SimCamera, track: SimTrack) -> None:
    """Over the tilted block the line rises or falls; over the floor it stays where it is."""
    rows = []
    for position in (20.0, 100.0):
        track.move_to(position)
        rows.append(camera.grab().image[..., 0].argmax(axis=0))
    changed = np.abs(rows[0] - rows[1])
    assert changed[40:120].max() >= 1
    assert changed[:20].max() <= 1


def test_options_are_strict(rig_file: RigFile) -> None:
    wrong = small(rig_file, track={"options": {"speed": 3}})
    with pytest.raises(InputError, match=r"track\.options\.speed: unknown key"):
        track_driver.validate(wrong)
    wrong = small(rig_file, camera={"options": {"zoom": 2}})
    with pytest.raises(InputError, match=r"camera\.options\.zoom: unknown key"):
        camera_driver.validate(wrong)


def test_travel_is_enforced(rig_file: RigFile) -> None:
    travel = {"options": {"max_mm": 10.0}}
    with pytest.raises(InputError, match=r"leaves the track's travel \(got 199\.5"):
        track_driver.open(small(rig_file, track=travel))
    track = track_driver.open(small(rig_file, track=travel, plan={"frames": 2}))
    with pytest.raises(DeviceError, match=r"11 mm.*-1000 mm to 10 mm"):
        track.move_to(11.0)
    assert track.position_mm == 0.0


@pytest.mark.parametrize("of", ["plug-in", "loop"])
@pytest.mark.parametrize(
    ("behind", "expected"), [(KeyboardInterrupt, KeyboardInterrupt), (ValueError, RuntimeError)]
)
def test_ctrl_c_in_mitsuba_or_drjit_is_not_taken_for_a_fault(
    rig_file: RigFile, monkeypatch: pytest.MonkeyPatch, of: str, behind: Any, expected: Any
) -> None:
    """Mitsuba has what was raised in the text of its own error, Dr.Jit behind its own."""

    def broken(*_: object) -> Any:
        raise behind

    monkeypatch.setattr(RefractiveCamera, "__init__", broken)
    with pytest.raises(expected):
        if of == "plug-in":
            Tank(scene_of(rig_file))
        with interruption_kept():
            dr.while_loop((mi.UInt32(0),), lambda number: number < 9, broken)


def test_the_picture_after_one_that_was_interrupted_is_as_without(
    rig_file: RigFile, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a picture's own numbers change is computed by whichever is taken next."""
    scene = scene_of(rig_file)
    other = scene.with_tank(laser={"tilt_deg": scene.tank.laser.tilt_deg + 0.2})
    tank = Tank(scene)
    before = tank.render(0.0).direct
    tank.take(other)
    with monkeypatch.context() as during:
        during.setattr(tank, "_focus", lambda _: signal.raise_signal(signal.SIGINT))
        with pytest.raises(KeyboardInterrupt):
            tank.render(0.0)
    again = tank.render(0.0).direct
    fresh = Tank(scene)
    fresh.take(other)
    assert not np.array_equal(again, before)
    np.testing.assert_array_equal(again, fresh.render(0.0).direct)
