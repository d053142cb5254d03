"""Pictures with the laser off: black is as it should be, and none shows the laser still on."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from fake_capture import HEIGHT_PX, WIDTH_PX, World, scene_of
from grbl_line import DirectLine, SimulatedTime

from lscan.acquisition.scan import acquire_into
from lscan.acquisition.writer import create_run
from lscan.config.rig import CameraSection, RigFile, parse_rig
from lscan.devices.api import Grab
from lscan.devices.grbl import SerialTrack, SerialTrackOptions, open_track
from lscan.devices.opencv_camera import OpencvCamera, OpencvOptions
from lscan.errors import DeviceError
from sim.emulators.grbl import GrblEmulator, MarlinEmulator

LIT, DARK = 2, 1  # scenes of the fake camera


def camera_of(world: World, **options: object) -> OpencvCamera:
    chosen = OpencvOptions(device=0, timeout_s=10.0, reconnect_wait_s=0.0, **options)
    section = CameraSection(driver="opencv", width_px=WIDTH_PX, height_px=HEIGHT_PX)
    return OpencvCamera(section, chosen, world.open)


@pytest.fixture
def black_world() -> World:
    """From the 10th picture on, all are black to the last bit."""
    return World(faults=dict.fromkeys(range(10, 100_000), "black"))


@pytest.fixture
def black_camera(black_world: World) -> Iterator[OpencvCamera]:
    camera = camera_of(black_world, warm_up_frames=0, flush_frames=10, retries=3)
    yield camera
    camera.close()


def test_black_is_refused_lit_and_taken_dark(black_camera: OpencvCamera) -> None:
    """Over and over, though each is the one before to the byte; lit ones are still refused."""
    for _ in range(3):
        assert black_camera.grab(0, dark=True).image.max() == 0
        with pytest.raises(DeviceError, match="black picture"):
            black_camera.grab(1)


def test_a_frozen_picture_is_no_dark_one() -> None:
    """What is not black has noise, so the same bytes again are a stuck camera, dark or not."""
    world = World(faults=dict.fromkeys(range(20, 100_000), "same"))
    camera = camera_of(world, warm_up_frames=0, retries=3)
    with pytest.raises(DeviceError, match=r"same picture|picture of the grab before"):
        for _ in range(30):
            camera.grab(0, dark=True)
    camera.close()


@dataclass
class WorldSwitch:
    """A track that stands anywhere, and whose laser lights the fake camera's scene."""

    world: World
    position_mm: float = 0.0

    def move_to(self, position_mm: float) -> float:
        self.position_mm = position_mm
        return position_mm

    def laser_on(self) -> None:
        self.world.scene = LIT

    def laser_off(self) -> None:
        self.world.scene = DARK

    def close(self) -> None: ...


def rig_of(frames: int) -> RigFile:
    document = {
        "camera": {"driver": "opencv", "width_px": WIDTH_PX, "height_px": HEIGHT_PX},
        "track": {"driver": "grbl"},
        "plan": {"frames": frames, "laser": "pairs"},
    }
    return parse_rig(document, source="rig.toml", trusted=True)


@pytest.mark.parametrize(
    ("delay", "flush_frames", "stamps"), [(0, 1, False), (1, 2, False), (5, 6, False), (5, 0, True)]
)
def test_no_background_was_exposed_with_the_laser_on(
    tmp_path: Path, delay: int, flush_frames: int, stamps: bool
) -> None:
    """Pictures under way in the camera are dropped by their count, or by their time stamps."""
    world = World(scene=DARK, delay=delay, stamps=stamps)
    camera = camera_of(world, flush_frames=flush_frames)
    with create_run(tmp_path / "a", rig_of(8)) as writer:
        run = acquire_into(writer, camera, WorldSwitch(world))
    camera.close()
    for frame in run.frames():
        assert frame.background is not None
        assert (scene_of(frame.image), scene_of(frame.background)) == (LIT, DARK)


def test_with_nothing_dropped_the_test_above_would_fail(tmp_path: Path) -> None:
    world = World(scene=DARK, delay=5, period_s=0.02)
    camera = camera_of(world, flush_frames=0)
    with create_run(tmp_path / "a", rig_of(1)) as writer:
        frame = acquire_into(writer, camera, WorldSwitch(world)).frame(0)
    camera.close()
    assert frame.background is not None
    assert (scene_of(frame.image), scene_of(frame.background)) != (LIT, DARK)


# ---- through a controller -----------------------------------------------------------------


@dataclass
class BeamCamera:
    """Pictures as bright as the emulated controller's laser is strong when they are taken."""

    emulator: GrblEmulator | MarlinEmulator
    clock: "Interruptible"
    size_px: tuple[int, int] = (WIDTH_PX, HEIGHT_PX)

    def grab(self, frame: int | None = None, dark: bool = False) -> Grab:
        self.clock.sleep(0.04)
        image = np.full((HEIGHT_PX, WIDTH_PX), round(self.emulator.laser_power), np.uint8)
        return Grab(image, self.clock(), 20.0)

    def close(self) -> None: ...


class Interruptible(SimulatedTime):
    """A time in which Ctrl-C is pressed, once, at ``interrupt_s``."""

    interrupt_s = float("inf")

    def sleep(self, seconds: float) -> None:
        super().sleep(seconds)
        if self.now_s > self.interrupt_s:
            self.interrupt_s = float("inf")
            raise KeyboardInterrupt


def bench(dialect: str) -> tuple[SerialTrack, BeamCamera]:
    clock = Interruptible()
    emulator = GrblEmulator(clock=clock) if dialect == "grbl" else MarlinEmulator(clock=clock)
    options = SerialTrackOptions(
        port="here", dialect=dialect, min_mm=0, max_mm=180, zero_mm=-190, laser_power=200
    )
    track = open_track(options, DirectLine(emulator, clock), clock, clock.sleep)
    return track, BeamCamera(emulator, clock)


@pytest.mark.parametrize("dialect", ["grbl", "marlin"])
def test_pairs_through_a_controller(tmp_path: Path, dialect: str) -> None:
    track, camera = bench(dialect)
    with create_run(tmp_path / "a", rig_of(4)) as writer:
        run = acquire_into(writer, camera, track)
    assert camera.emulator.laser_power == 0
    for frame in run.frames():
        assert frame.background is not None
        assert (frame.image.min(), frame.background.max()) == (200, 0)


@pytest.mark.parametrize("dialect", ["grbl", "marlin"])
def test_stopped_in_mid_move_the_beam_is_off(tmp_path: Path, dialect: str) -> None:
    """After a motion that failed the track refuses all but to switch the laser off."""
    track, camera = bench(dialect)
    powers = []

    def stop(done: int, _: int) -> None:
        if done == 1:
            camera.clock.interrupt_s = camera.clock() + 0.5
            powers.append(camera.emulator.laser_power)

    document = {**rig_of(3).document, "plan": {"frames": 3, "laser": "on", "step_mm": 20.0}}
    rig_file = parse_rig(document, source="rig.toml", trusted=True)
    with create_run(tmp_path / "a", rig_file) as writer, pytest.raises(KeyboardInterrupt):
        acquire_into(writer, camera, track, stop)
    assert powers == [200]
    assert camera.emulator.laser_power == 0
    with pytest.raises(DeviceError, match="must be opened again"):
        track.laser_on()


@pytest.mark.parametrize("dialect", ["grbl", "marlin"])
def test_a_failed_scan_leaves_the_beam_off(tmp_path: Path, dialect: str) -> None:
    track, camera = bench(dialect)
    document = {**rig_of(2).document, "plan": {"frames": 2, "laser": "on"}}
    document["camera"] = {**document["camera"], "width_px": WIDTH_PX + 1}
    rig_file = parse_rig(document, source="rig.toml", trusted=True)
    with create_run(tmp_path / "a", rig_file) as writer, pytest.raises(DeviceError, match="px"):
        acquire_into(writer, camera, track)
    assert camera.emulator.laser_power == 0
