"""The replay driver: a recorded run scanned again."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from device_contract import CameraContract, TrackContract

from lscan.acquisition.replay import ReplayCamera, ReplayTrack, camera_driver, track_driver
from lscan.acquisition.run import Run, open_run
from lscan.acquisition.scan import scan
from lscan.acquisition.writer import create_run
from lscan.config.rig import RigFile, load_rig, parse_rig
from lscan.errors import DeviceError, InputError
from lscan.records import Frame

MISS_MM = 0.01  # how far, at most, the recorded track stood from where it was sent
RIG = """
camera = {{ driver = "replay", width_px = 20, height_px = 16, options = {{ run_file = "{run}" }} }}
track = {{ driver = "replay", options = {{ run_file = "{run}" }} }}
plan = {{ start_mm = {start_mm}, step_mm = {step_mm}, frames = {frames}, laser = "{laser}" }}
"""


@dataclass
class StandingTrack:
    """A track of another make, standing anywhere."""

    position_mm: float = 0.0

    def move_to(self, position_mm: float) -> float:
        self.position_mm = position_mm
        return position_mm

    def close(self) -> None:
        pass


def record(
    path: Path, frames: int = 5, step_mm: float = 0.5, written: int = 5, laser: str = "untouched"
) -> Run:
    """A run from 10 mm on; its track misses each stop by another amount."""
    generator = np.random.default_rng(4)
    camera = {"driver": "gone", "width_px": 20, "height_px": 16}
    plan = {"start_mm": 10.0, "step_mm": step_mm, "frames": frames, "laser": laser}
    document = {"camera": camera, "track": {"driver": "gone"}, "plan": plan}
    rig_file = parse_rig(document, source="rig.toml", trusted=True)
    with create_run(path, rig_file) as writer:
        for index, commanded_mm in enumerate(rig_file.rig.plan.positions_mm()[:written]):
            image = generator.integers(0, 256, (16, 20, 3), dtype=np.uint8)
            miss_mm = float(generator.uniform(-MISS_MM, MISS_MM)) if step_mm else 0.0
            time_s = 0.1 * index
            position_mm = commanded_mm + miss_mm
            dark = image // 2 if laser == "pairs" else None
            writer.append(Frame(image, index, commanded_mm, position_mm, time_s, 20.0, dark))
    return open_run(path)


def replay_rig(folder: Path, **values: Any) -> RigFile:
    """A rig file beside the recorded folder "a", read as the commands read it."""
    plan = {"run": "a", "start_mm": 10.0, "step_mm": 0.5, "frames": 5, "laser": "untouched"}
    plan |= values
    (folder / "rig.toml").write_text(RIG.format(**plan))
    return load_rig(folder / "rig.toml")


class TestReplayTrack(TrackContract):
    limits_mm = (10.0, 12.0)
    tolerance_mm = MISS_MM
    name = "replay track"

    @pytest.fixture
    def track(self, tmp_path: Path) -> ReplayTrack:
        return ReplayTrack(record(tmp_path / "a"))


class TestReplayCamera(CameraContract):
    size_px = (20, 16)
    name = "replay camera"
    live = False

    @pytest.fixture
    def camera(self, tmp_path: Path) -> ReplayCamera:
        run = record(tmp_path / "a", laser="pairs")
        return ReplayCamera(run, ReplayTrack(run))


class TestReplayCameraAtOnePlace(TestReplayCamera):
    """Pictures come in turn, as many as a test takes, so that a grab too many would show."""

    @pytest.fixture
    def camera(self, tmp_path: Path) -> ReplayCamera:
        run = record(tmp_path / "a", frames=self.grabs, step_mm=0.0, written=self.grabs)
        return ReplayCamera(run, ReplayTrack(run))

    def test_a_dark_picture_is_like_any_other(self, camera: ReplayCamera) -> None:
        pytest.skip("recorded without backgrounds")


@pytest.mark.parametrize("step_mm", [0.5, -0.5, 0.0])
def test_scanning_again_gives_the_same_frames(tmp_path: Path, step_mm: float) -> None:
    recorded = record(tmp_path / "a", step_mm=step_mm)
    again = scan(replay_rig(tmp_path, step_mm=step_mm), tmp_path / "b")
    assert again.rows == recorded.rows
    for one, other in zip(again.frames(), recorded.frames(), strict=True):
        np.testing.assert_array_equal(one.image, other.image)


@pytest.mark.parametrize("step_mm", [0.5, -0.5, 0.0])
def test_pairs_scanned_again_are_the_same_pairs(tmp_path: Path, step_mm: float) -> None:
    """Also where all were recorded at one place: a background stays with its picture."""
    recorded = record(tmp_path / "a", step_mm=step_mm, laser="pairs")
    again = scan(replay_rig(tmp_path, step_mm=step_mm, laser="pairs"), tmp_path / "b")
    assert again.rows == recorded.rows
    for one, other in zip(again.frames(), recorded.frames(), strict=True):
        assert one.background is not None
        assert other.background is not None
        np.testing.assert_array_equal(one.background, other.background)


def test_the_lit_pictures_of_pairs_serve_an_ordinary_scan(tmp_path: Path) -> None:
    recorded = record(tmp_path / "a", laser="pairs")
    again = scan(replay_rig(tmp_path, laser="on"), tmp_path / "b")
    assert [row.sha256 for row in again.rows] == [row.sha256 for row in recorded.rows]


def test_a_run_without_backgrounds_serves_no_pairs(tmp_path: Path) -> None:
    run = record(tmp_path / "a")
    with pytest.raises(InputError, match=r"plan\.laser: the run .*/a was recorded without"):
        replay_rig(tmp_path, laser="pairs")
    with pytest.raises(DeviceError, match="recorded without backgrounds"):
        ReplayCamera(run, ReplayTrack(run)).grab(0, dark=True)


def test_a_coarser_scan_takes_every_other_frame(tmp_path: Path) -> None:
    recorded = record(tmp_path / "a")
    again = scan(replay_rig(tmp_path, step_mm=1.0, frames=3), tmp_path / "b")
    assert [row.sha256 for row in again.rows] == [row.sha256 for row in recorded.rows[::2]]


def test_a_stopped_run_can_be_replayed_as_far_as_it_got(tmp_path: Path) -> None:
    record(tmp_path / "a", frames=9)
    with pytest.raises(DeviceError, match=r"12\.5 mm.*10 mm to 12 mm"):
        scan(replay_rig(tmp_path, frames=9), tmp_path / "b")
    assert len(open_run(tmp_path / "b")) == 5


def test_between_two_stops_the_nearer_picture_comes(tmp_path: Path) -> None:
    recorded = record(tmp_path / "a")
    track = StandingTrack()
    camera = ReplayCamera(recorded, track)
    for index, position_mm in enumerate(recorded.positions_mm):
        for aside_mm in (-0.2, 0.2):
            track.move_to(position_mm + aside_mm)
            np.testing.assert_array_equal(camera.grab().image, recorded.frame(index).image)


@pytest.mark.parametrize("position_mm", [9.7, 12.3, np.nan])
def test_no_picture_within_half_a_step_is_an_error(tmp_path: Path, position_mm: float) -> None:
    """The outer frames lie at 10 and 12 mm to within 0.01 mm, and half a step is 0.25 mm."""
    camera = ReplayCamera(record(tmp_path / "a"), StandingTrack(position_mm))
    with pytest.raises(DeviceError, match=rf"{position_mm} mm.*half a step"):
        camera.grab()


def test_a_damaged_picture_is_named(tmp_path: Path) -> None:
    run = record(tmp_path / "a")
    (tmp_path / "a" / "frames" / "000000.png").write_bytes(b"x")
    with pytest.raises(InputError, match=r"000000\.png"):
        ReplayCamera(run, ReplayTrack(run)).grab()


def test_a_run_of_another_picture_size_is_refused(tmp_path: Path) -> None:
    record(tmp_path / "a")
    rig_file = replay_rig(tmp_path)
    camera = {**rig_file.document["camera"], "width_px": 640}
    other = parse_rig({**rig_file.document, "camera": camera}, source="rig.toml")
    with pytest.raises(InputError, match=r"camera\.width_px.*got \(640, 16\); allowed: \(20, 16\)"):
        camera_driver.validate(other)


@pytest.mark.parametrize(
    ("options", "line"),
    [
        ({}, r"track\.options\.run_file: field required"),
        ({"run_file": 3}, r"track\.options\.run_file: .*got 3"),
        ({"run_file": "a", "speed": 2}, r"track\.options\.speed: unknown key"),
    ],
)
def test_bad_options_are_named(options: dict[str, Any], line: str) -> None:
    document = {"camera": {"driver": "replay"}, "track": {"driver": "replay", "options": options}}
    with pytest.raises(InputError, match=line):
        track_driver.validate(parse_rig(document, source="rig.toml"))


def test_a_run_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"a/run\.json: cannot be read"):
        replay_rig(tmp_path)


def test_a_run_without_frames_is_refused(tmp_path: Path) -> None:
    record(tmp_path / "a", written=0)
    with pytest.raises(InputError, match=r"camera\.options\.run_file: .*: a run without frames"):
        replay_rig(tmp_path)


def test_previews_change_nothing_of_a_replayed_scan(tmp_path: Path) -> None:
    recorded = record(tmp_path / "a")
    track = ReplayTrack(recorded)
    camera = ReplayCamera(recorded, track)
    for row in recorded.rows:
        track.move_to(row.commanded_mm)
        shown, grab, again = camera.preview(), camera.grab(row.index), camera.preview()
        assert grab.time_s == shown.time_s == again.time_s == row.time_s
        np.testing.assert_array_equal(shown.image, grab.image)
    camera.close()
    with pytest.raises(DeviceError, match="is closed"):
        camera.preview()
