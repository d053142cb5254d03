"""Scans that switch the laser: what is taken when, what the run folder holds, and its readers."""

import csv
import errno
import json
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_devices import FakeCamera, LaserTrack, fake_rig, folder_bytes
from killed_scans import remnants
from places import ROOT, SUPPORT

from lscan.acquisition.run import FrameRow, Run, open_run
from lscan.acquisition.scan import acquire_into
from lscan.acquisition.writer import create_run, resume_run
from lscan.cli.app import app
from lscan.cli.console import run_command_line
from lscan.config.rig import RigFile, load_rig, parse_rig
from lscan.devices.api import Grab, LaserSwitch
from lscan.errors import DeviceError, InputError
from lscan.files import disk
from lscan.pipeline import mean_picture, read_profiles
from lscan.records import Bytes, Floats, Frame, PlanePoints, Status

PAIRED_HEADER = "index,commanded_mm,position_mm,time_s,exposure_ms,sha256,dark_sha256,crc32"
PLAIN_HEADER = "index,commanded_mm,position_mm,time_s,exposure_ms,sha256,crc32"


@pytest.fixture(autouse=True)
def unsynced(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spare the disk; when files are synced has a test of its own."""
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)


@dataclass
class TracingCamera(FakeCamera):
    """Notes in the track's trace each picture, whether it was to be dark, and the laser."""

    def grab(self, frame: int | None = None, dark: bool = False) -> Grab:
        assert isinstance(self.track, LaserTrack)
        said, seen = "dark" if dark else "lit", "lit" if self.track.lit else "dark"
        self.track.trace.append(f"grab {said}, laser {seen}")
        return super().grab(frame, dark)


def paired_rig(frames: int = 3) -> RigFile:
    return fake_rig(frames=frames, laser="pairs")


def scanned(path: Path, rig_file: RigFile, track: LaserTrack | None = None, **camera: Any) -> Run:
    track = track or LaserTrack()
    with resume_run(path, rig_file) as writer:
        return acquire_into(writer, TracingCamera(track, **camera), track)


@pytest.fixture
def run(tmp_path: Path) -> Run:
    return scanned(tmp_path / "a", paired_rig())


# ---- what is done when ------------------------------------------------------------------


def test_a_pair_is_taken_lit_then_dark_at_each_position(tmp_path: Path) -> None:
    track = LaserTrack()
    scanned(tmp_path / "a", paired_rig(2), track)
    pair = ["move", "laser on", "grab lit, laser lit", "laser off", "grab dark, laser dark"]
    assert track.trace == [*pair, *pair, "laser off"]


def test_on_lights_the_laser_for_the_whole_session(tmp_path: Path) -> None:
    track = LaserTrack()
    scanned(tmp_path / "a", fake_rig(frames=2, laser="on"), track)
    frame = ["move", "grab lit, laser lit"]
    assert track.trace == ["laser on", *frame, *frame, "laser off"]


def test_untouched_sends_nothing_and_asks_nothing_new_of_a_camera(tmp_path: Path) -> None:
    """A camera and a track of before there was a laser to switch serve as they did."""

    class OldTrack:
        position_mm = 0.0

        def move_to(self, position_mm: float) -> float:
            self.position_mm = position_mm
            return position_mm

        def close(self) -> None: ...

    @dataclass
    class OldCamera(FakeCamera):
        def grab(self, frame: int | None = None) -> Grab:  # type: ignore[override]
            return super().grab(frame)

    track = OldTrack()
    with create_run(tmp_path / "a", fake_rig(frames=2)) as writer:
        assert acquire_into(writer, OldCamera(track), track).state == "complete"
    for laser in ("on", "pairs"):
        rig_file = fake_rig(frames=2, laser=laser)
        with (
            create_run(tmp_path / laser, rig_file) as writer,
            pytest.raises(DeviceError, match=rf"plan\.laser = '{laser}': .*switches no laser"),
        ):
            acquire_into(writer, OldCamera(track), track)


def test_both_pictures_and_the_row_are_there_before_the_track_moves_on(tmp_path: Path) -> None:
    found: list[tuple[list[str], int]] = []

    class LookingTrack(LaserTrack):
        def move_to(self, position_mm: float) -> float:
            names = sorted(file.name for file in (tmp_path / "a" / "frames").iterdir())
            rows = (tmp_path / "a" / "frames.csv").read_text().count("\n") - 1
            found.append((names, rows))
            return super().move_to(position_mm)

    scanned(tmp_path / "a", paired_rig(), LookingTrack())
    both = [[f"{k:06d}-dark.png", f"{k:06d}.png"] for k in range(3)]
    assert found == [([], 0), (both[0], 1), (both[0] + both[1], 2)]


def test_each_file_is_synced_before_its_row_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trace: list[str] = []
    names: dict[int, str] = {}
    original = os.open

    def spy_open(path: Any, *args: Any, **kwargs: Any) -> int:
        descriptor = original(path, *args, **kwargs)
        names[descriptor] = Path(path).name
        return descriptor

    monkeypatch.setattr(disk, "temporary_name", lambda name: f".{name}.tmp")
    monkeypatch.setattr(os, "open", spy_open)
    monkeypatch.setattr(os, "fsync", lambda descriptor: trace.append(names[descriptor]))
    track = LaserTrack()
    with create_run(tmp_path / "a", paired_rig(1)) as writer:
        trace.clear()
        acquire_into(writer, FakeCamera(track), track)
    pictures = [".000000.png.tmp", "frames", ".000000-dark.png.tmp", "frames"]
    may_be_lit = [".run.json.tmp", "a"]
    assert trace[:7] == [*may_be_lit, *pictures, "frames.csv"]


@pytest.mark.parametrize("laser", ["on", "pairs"])
@pytest.mark.parametrize("fault", ["camera", "track", "disk", "interrupt"])
def test_whatever_fails_the_laser_is_off(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, laser: str, fault: str
) -> None:
    track = LaserTrack(fail_at=1 if fault == "track" else None)
    camera = TracingCamera(track, fail_at=1 if fault == "camera" else None)
    expected: type[BaseException] = DeviceError
    rig_file = fake_rig(frames=3, laser=laser)
    with create_run(tmp_path / "a", rig_file) as writer:
        if fault == "disk":
            expected = InputError

        def fill(done: int, _: int) -> None:
            if fault == "disk" and done == 1:
                monkeypatch.setattr(os, "write", full)

        def full(*_: Any) -> int:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        if fault == "interrupt":
            expected = KeyboardInterrupt

            def interrupted(*_: Any, **__: Any) -> Grab:
                raise KeyboardInterrupt

            monkeypatch.setattr(TracingCamera, "grab", interrupted)
        with pytest.raises(expected):
            acquire_into(writer, camera, track, fill)
    assert not track.lit
    assert "laser on" in track.trace


def test_a_laser_that_fails_too_does_not_hide_the_first_fault(tmp_path: Path) -> None:
    class StuckTrack(LaserTrack):
        def laser_off(self) -> None:
            raise DeviceError("fake track: does not answer M5")

    track = StuckTrack(fail_at=1)
    with pytest.raises(DeviceError, match="limit switch"):
        scanned(tmp_path / "a", fake_rig(frames=3, laser="on"), track)
    with pytest.raises(DeviceError, match="M5"):
        scanned(tmp_path / "b", fake_rig(frames=1, laser="on"), StuckTrack())


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"exposure_ms": 40.0}, r"background has exposure_ms 40\.0, .*laser on 20\.0"),
        ({"image": np.zeros((16, 20), np.uint8)}, r"background has shape \(16, 20\)"),
        ({"image": np.zeros((8, 20, 3), np.uint8)}, r"20 by 8 px; the rig says 20 by 16"),
        ({"image": np.zeros((16, 20, 3))}, "float64"),
        ({"time_s": 0.0}, "is an old picture"),
        ({"time_s": np.nan}, "time_s that is not finite"),
    ],
)
def test_a_background_that_does_not_fit_is_refused(
    tmp_path: Path, changed: dict[str, Any], message: str
) -> None:
    class WrongCamera(FakeCamera):
        def grab(self, frame: int | None = None, dark: bool = False) -> Grab:
            grab = super().grab(frame, dark)
            return replace(grab, **changed) if dark and frame == 1 else grab

    track = LaserTrack()
    with (
        create_run(tmp_path / "a", paired_rig()) as writer,
        pytest.raises(DeviceError, match=message),
    ):
        acquire_into(writer, WrongCamera(track), track)
    stopped = open_run(tmp_path / "a")
    stopped.verify()
    assert len(stopped) == 1
    assert len(list((tmp_path / "a" / "frames").iterdir())) == 2


def test_a_picture_older_than_the_background_before_it_is_refused(tmp_path: Path) -> None:
    class LateCamera(FakeCamera):
        def grab(self, frame: int | None = None, dark: bool = False) -> Grab:
            grab = super().grab(frame, dark)
            return replace(grab, time_s=10.0) if dark and frame == 0 else grab

    track = LaserTrack()
    with (
        create_run(tmp_path / "a", paired_rig()) as writer,
        pytest.raises(DeviceError, match="frame 1 is an old picture"),
    ):
        acquire_into(writer, LateCamera(track), track)


# ---- the run folder ---------------------------------------------------------------------


def test_a_paired_run_holds_what_the_camera_delivered(run: Run) -> None:
    track = LaserTrack()
    camera = FakeCamera(track)
    for index, frame in enumerate(run.frames()):
        assert frame.position_mm == track.move_to(1.0 + 0.1 * index)
        lit, dark = camera.grab(), camera.grab()
        np.testing.assert_array_equal(frame.image, lit.image)
        assert frame.background is not None
        np.testing.assert_array_equal(frame.background, dark.image)
        assert frame.time_s == lit.time_s
    assert run.rig_file.rig.plan.laser == "pairs"


def test_its_files_have_their_names_and_its_table_a_column(run: Run) -> None:
    names = {file.name for file in (run.path / "frames").iterdir()}
    assert names == {f"{index:06d}{end}.png" for index in range(3) for end in ("", "-dark")}
    header, *rows = (run.path / "frames.csv").read_text().splitlines()
    assert header == PAIRED_HEADER
    assert all(len(row.split(",")) == 8 for row in rows)
    assert [row.split(",")[6] for row in rows] == [row.dark_sha256 for row in run.rows]


def test_an_ordinary_run_is_as_it_was_before_there_were_pairs(tmp_path: Path) -> None:
    """The key written out with its default is the same plan, and leaves no trace in the plan."""
    run = scanned(tmp_path / "a", fake_rig(frames=2))
    manifest = json.loads((run.path / "run.json").read_text())
    assert list(manifest["plan"]) == ["start_mm", "step_mm", "frames"]
    header, *rows = (run.path / "frames.csv").read_text().splitlines()
    assert header == PLAIN_HEADER
    assert all(len(row.split(",")) == 7 for row in rows)
    assert {frame.background is None for frame in run.frames()} == {True}
    again = scanned(tmp_path / "b", fake_rig(frames=2, laser="untouched"))
    assert json.loads((again.path / "run.json").read_text())["plan"] == manifest["plan"]


@pytest.mark.parametrize("reader", ["verify", "frame"])
def test_damage_to_a_background_is_named(run: Run, reader: str) -> None:
    file = run.path / "frames" / "000001-dark.png"
    file.write_bytes(file.read_bytes()[:-1])
    with pytest.raises(InputError, match=r"000001-dark\.png.*line 3"):
        open_run(run.path).verify() if reader == "verify" else open_run(run.path).frame(1)
    with pytest.raises(InputError, match=r"000001-dark\.png"):
        resume_run(run.path, paired_rig())


def test_a_missing_background_is_named(run: Run) -> None:
    (run.path / "frames" / "000002-dark.png").unlink()
    with pytest.raises(InputError, match=r"000002-dark\.png: missing, .*line 4"):
        open_run(run.path)


def test_swapped_pictures_are_noticed(run: Run) -> None:
    lit, dark = run.path / "frames" / "000000.png", run.path / "frames" / "000000-dark.png"
    data = lit.read_bytes()
    shutil.copy(dark, lit)
    dark.write_bytes(data)
    with pytest.raises(InputError, match="checksum differs"):
        open_run(run.path).verify()


@pytest.mark.parametrize("paired", [False, True])
def test_a_row_of_the_other_kind_is_refused(paired: bool) -> None:
    row = FrameRow(0, 1.0, 1.0, 0.0, 20.0, "ab", None if paired else "cd")
    with pytest.raises(InputError, match="does not hold what it should"):
        FrameRow.from_text(row.as_text(), "here", paired)
    assert FrameRow.from_text(row.as_text(), "here", not paired) == row


@pytest.mark.parametrize("laser", ["untouched", "on", "pairs"])
def test_the_writer_takes_backgrounds_where_the_plan_has_them(tmp_path: Path, laser: str) -> None:
    image = np.zeros((16, 20), np.uint8)
    background = None if laser == "pairs" else image
    with create_run(tmp_path / "a", fake_rig(laser=laser)) as writer:
        with pytest.raises(InputError, match="background"):
            writer.append(Frame(image, 0, 1.0, 1.0, 0.0, 20.0, background))
        assert writer.written == 0


# ---- killed at any moment ---------------------------------------------------------------


def test_a_killed_paired_scan_resumes_to_the_same_bytes(tmp_path: Path) -> None:
    found = remnants(tmp_path, partial(scanned, rig_file=paired_rig(2)))
    whole = folder_bytes(tmp_path / "run")
    assert len(found) >= 70
    assert {"half a pair", "pair without row", "torn row"} <= set(map(_remnant, found))
    for path in found:
        scanned(path, paired_rig(2))
        assert folder_bytes(path) == whole, path.name


@pytest.mark.slow  # real signals; what they leave, without them, is above
def test_a_paired_scan_that_a_signal_killed_resumes_to_the_same_bytes(tmp_path: Path) -> None:
    scanned(tmp_path / "whole", paired_rig(2))
    folder = tmp_path / "killed"
    folder.mkdir()
    script = [str(SUPPORT / "killed_scans.py"), str(folder), "twice", "2", "pairs"]
    environment = {**os.environ, "PYTHONPATH": "."}
    subprocess.run([sys.executable, *script], check=True, cwd=ROOT, env=environment)
    killed = sorted(folder.iterdir())
    assert len(killed) >= 15
    for path in killed:
        scanned(path, paired_rig(2))
        assert folder_bytes(path) == folder_bytes(tmp_path / "whole"), path.name


def _remnant(path: Path) -> str:
    """What kind of half-done frame a killed scan left."""
    table = path / "frames.csv"
    if not (path / "run.json").exists():
        return "no manifest"
    text = table.read_bytes()
    if not text.endswith(b"\n"):
        return "torn row"
    pictures, rows = len(list(path.glob("frames/0*.png"))), text.count(b"\n") - 1
    return ("whole", "half a pair", "pair without row")[pictures - 2 * rows]


# ---- the readers ------------------------------------------------------------------------

LINE_V, LAMP_V = 10, 4


def lamp_and_line(lit: bool) -> Bytes:
    """A lamp's bar in row LAMP_V, brighter than the laser's line in row LINE_V."""
    image = np.full((16, 20, 3), 10, np.uint8)
    image[LAMP_V] = 200
    if lit:
        image[LINE_V] += 90
    return image


@dataclass(frozen=True)
class Identity:
    """A plane map whose millimetres are pixels."""

    name: str = "identity"

    def to_plane(self, image_px: Floats, sigma_px: Floats | None = None) -> PlanePoints:
        status = np.full(len(image_px), Status.OK)
        return PlanePoints(image_px, np.zeros_like(image_px), status)

    def parameters(self) -> dict[str, Any]:
        return {}


@pytest.fixture
def lamp_run(tmp_path: Path) -> Run:
    with create_run(tmp_path / "lamp", paired_rig(2)) as writer:
        for index in range(2):
            lit, dark = lamp_and_line(True), lamp_and_line(False)
            writer.append(Frame(lit, index, 1.0, 1.0, float(index), 20.0, dark))
        return writer.finish()


def test_profiles_are_read_from_the_difference(lamp_run: Run) -> None:
    """The pictures alone would give the lamp's bar; the pairs give the line, to the pixel."""
    for profile in read_profiles(lamp_run, Identity()):
        np.testing.assert_allclose(profile.points.xz_mm[:, 1], LINE_V, atol=1e-9)


def test_extract_reads_a_frame_with_its_background(
    lamp_run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def centres(*more: str) -> set[float]:
        table = tmp_path / "stripe.csv"
        arguments = ["extract", str(lamp_run.path), "--frame", "1", "-o", str(table), *more]
        monkeypatch.setattr(sys, "argv", ["lscan", *arguments])
        with pytest.raises(SystemExit) as left:
            run_command_line(app, "lscan")
        assert left.value.code == 0
        lines = [line for line in table.read_text().splitlines() if not line.startswith("#")]
        return {round(float(row["centre_px"]), 6) for row in csv.DictReader(lines)}

    assert centres() == {LINE_V}
    black = tmp_path / "black.png"
    shutil.copy(lamp_run.path / "frames" / "000000-dark.png", black)
    assert centres("--background", str(black)) == {LINE_V}


def test_the_mean_picture_is_that_of_the_lit_ones(lamp_run: Run) -> None:
    np.testing.assert_array_equal(mean_picture(lamp_run), lamp_and_line(True))


# ---- refused before a device is touched ---------------------------------------------------

RIG = """
camera = {{ driver = "opencv", options = {{ {source} }} }}
track = {{ driver = "{track}", options = {{ {options} min_mm = 0, max_mm = 300 }} }}
plan = {{ laser = "{laser}" }}
"""


def read(folder: Path, laser: str, track: str = "grbl", source: str = "device = 60") -> RigFile:
    options = 'port = "/dev/not-there",' if track == "grbl" else ""
    text = RIG.format(source=source, track=track, options=options, laser=laser)
    (folder / "rig.toml").write_text(text)
    return load_rig(folder / "rig.toml")


@pytest.mark.parametrize("laser", ["untouched", "on", "pairs"])
def test_a_track_that_can_switch_a_laser_may_be_asked_to(tmp_path: Path, laser: str) -> None:
    assert read(tmp_path, laser).rig.plan.laser == laser


@pytest.mark.parametrize("laser", ["on", "pairs"])
def test_a_track_that_cannot_is_refused_by_key(tmp_path: Path, laser: str) -> None:
    assert read(tmp_path, "untouched", track="manual").rig.plan.laser == "untouched"
    message = rf"plan\.laser: .*'manual'.*got '{laser}'; allowed: untouched"
    with pytest.raises(InputError, match=message):
        read(tmp_path, laser, track="manual")


def test_a_camera_that_knows_no_dark_pictures_is_refused_for_pairs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from lscan.devices.opencv_camera.camera import camera_driver

    monkeypatch.delattr(type(camera_driver), "takes_dark")
    with pytest.raises(InputError, match=r"plan\.laser: .*'opencv'.*allowed: untouched, on\)"):
        read(tmp_path, "pairs")
    assert read(tmp_path, "on").rig.plan.laser == "on"


def test_a_video_file_is_refused_for_pairs(tmp_path: Path) -> None:
    (tmp_path / "film.avi").touch()
    source = f'file = "{tmp_path / "film.avi"}"'
    with pytest.raises(InputError, match=r"plan\.laser: a video file does not see"):
        read(tmp_path, "pairs", source=source)
    assert read(tmp_path, "on", source=source).rig.plan.laser == "on"


@pytest.mark.parametrize("laser", ["off", "Pairs", ""])
def test_an_unknown_word_is_named_with_those_there_are(tmp_path: Path, laser: str) -> None:
    with pytest.raises(InputError, match=r"plan\.laser: .*'untouched', 'on' or 'pairs'"):
        read(tmp_path, laser)


def test_the_fakes_are_what_they_stand_for() -> None:
    assert isinstance(LaserTrack(), LaserSwitch)
    assert parse_rig(paired_rig().document, "again", trusted=True).rig.plan.paired
