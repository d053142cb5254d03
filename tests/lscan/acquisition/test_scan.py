"""Acquisition: the same bytes each time, whatever the scan was killed or stopped by."""

import errno
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_devices import FakeCamera, FakeDrivers, FakeTrack, fake_rig, folder_bytes
from killed_scans import remnants
from PIL import Image
from places import ROOT, SUPPORT

import lscan.acquisition.run
import lscan.config.rig
from lscan.acquisition.run import Run, open_run
from lscan.acquisition.scan import acquire_into, scan
from lscan.acquisition.writer import create_run, resume_run
from lscan.config.rig import RigFile, parse_rig
from lscan.devices.api import Grab
from lscan.errors import DeviceError, InputError
from lscan.files import disk
from lscan.pipeline import mean_picture


@pytest.fixture(autouse=True)
def unsynced(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spare the disk: that files are synced, and when, has a test of its own."""
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)


def fake_scan(path: Path, rig_file: RigFile | None = None, **camera: Any) -> Run:
    with create_run(path, rig_file or fake_rig()) as writer:
        track = FakeTrack()
        return acquire_into(writer, FakeCamera(track, **camera), track)


def resumed(path: Path, rig_file: RigFile | None = None) -> Run:
    with resume_run(path, rig_file or fake_rig()) as writer:
        track = FakeTrack()
        return acquire_into(writer, FakeCamera(track), track)


@pytest.fixture
def drivers(monkeypatch: pytest.MonkeyPatch) -> FakeDrivers:
    track = FakeTrack()
    drivers = FakeDrivers(track, FakeCamera(track))
    monkeypatch.setattr(lscan.config.rig, "find_plugin", drivers.find_plugin)
    return drivers


# What is recorded


def test_frames_are_what_the_camera_delivered(tmp_path: Path) -> None:
    run = fake_scan(tmp_path / "a")
    track = FakeTrack()
    camera = FakeCamera(track)
    assert run.state == "complete"
    assert len(run) == 5
    for index, frame in enumerate(run.frames()):
        commanded_mm = 1.0 + index * 0.1
        assert frame.position_mm == track.move_to(commanded_mm)
        grab = camera.grab()
        np.testing.assert_array_equal(frame.image, grab.image)
        assert (frame.index, frame.commanded_mm) == (index, commanded_mm)
        assert (frame.time_s, frame.exposure_ms) == (grab.time_s, grab.exposure_ms)


def test_grey_pictures_stay_grey(tmp_path: Path) -> None:
    run = fake_scan(tmp_path / "a", colour=False)
    assert {frame.image.shape for frame in run.frames()} == {(16, 20)}


@pytest.mark.parametrize("colour", [False, True])
def test_deep_pictures_are_kept_to_the_last_bit(tmp_path: Path, colour: bool) -> None:
    """In PNG files of 16 bits, as the picture of another library says."""
    document = dict(fake_rig().document)
    document["camera"] = {**document["camera"], "bits": 12}
    deep = parse_rig(document, source="rig.toml", trusted=True)
    run = fake_scan(tmp_path / "a", deep, colour=colour, bits=12)
    camera = FakeCamera(FakeTrack(), colour=colour, bits=12)
    for index, frame in enumerate(run.frames()):
        camera.track.move_to(1.0 + index * 0.1)
        np.testing.assert_array_equal(frame.image, camera.grab().image)
        file = Image.open(tmp_path / "a" / "frames" / f"{index:06d}.png")
        assert file.mode == ("RGB" if colour else "I;16")  # Pillow shows 8 bits of deep colours
    mean = np.mean([frame.image for frame in run.frames()], axis=0)
    assert mean_picture(run).dtype == np.uint16
    np.testing.assert_array_equal(mean_picture(run), np.rint(mean))
    with pytest.raises(DeviceError, match=r"frame 0: .* uint8 .*allowed: uint16 for camera.bits"):
        fake_scan(tmp_path / "b", deep)
    with pytest.raises(DeviceError, match=r"frame 0: .* uint16 .*allowed: uint8 for camera.bits"):
        fake_scan(tmp_path / "c", bits=12)


def test_the_same_scan_gives_the_same_bytes(tmp_path: Path) -> None:
    fake_scan(tmp_path / "a")
    fake_scan(tmp_path / "deeper" / "b")
    files = folder_bytes(tmp_path / "a")
    assert files == folder_bytes(tmp_path / "deeper" / "b")
    assert len(files) == 7


def test_progress_counts_every_frame(tmp_path: Path, drivers: FakeDrivers) -> None:
    seen: list[tuple[int, int]] = []
    scan(fake_rig(), tmp_path / "a", progress=lambda *step: seen.append(step))
    assert seen == [(done, 5) for done in range(6)]


def test_frame_and_row_are_synced_before_the_track_moves_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    track = FakeTrack()
    names: dict[int, str] = {}
    original = {name: getattr(os, name) for name in ("open", "write", "fsync", "replace")}

    def spy_open(path: Any, *args: Any, **kwargs: Any) -> int:
        descriptor = original["open"](path, *args, **kwargs)
        names[descriptor] = Path(path).name
        return descriptor

    def spy(name: str) -> Any:
        def wrapper(target: Any, *args: Any) -> Any:
            what = names[target] if isinstance(target, int) else Path(target).name
            track.trace.append(f"{name} {what}")
            return original[name](target, *args)

        return wrapper

    monkeypatch.setattr(disk, "temporary_name", lambda name: f".{name}.tmp")
    monkeypatch.setattr(os, "open", spy_open)
    for name in ("write", "fsync", "replace"):
        monkeypatch.setattr(os, name, spy(name))
    with create_run(tmp_path / "a", fake_rig(frames=3)) as writer:
        track.trace.clear()
        acquire_into(writer, FakeCamera(track), track)
    steps = []
    for temporary in (f".{index:06d}.png.tmp" for index in range(3)):
        steps += ["move", f"write {temporary}", f"fsync {temporary}", f"replace {temporary}"]
        steps += ["fsync frames", "write frames.csv", "fsync frames.csv"]
    assert track.trace[: len(steps)] == steps


# Folders that exist, and resuming


def test_a_scan_asked_to_stop_ends_after_its_frame_and_goes_on(tmp_path: Path) -> None:
    rig_file, track = fake_rig(), FakeTrack()
    with create_run(tmp_path / "a", rig_file) as writer:
        run = acquire_into(writer, FakeCamera(track), track, go_on=lambda: writer.written < 3)
    assert (run.state, len(run), track.moves) == ("scanning", 3, 3)
    assert resumed(tmp_path / "a").state == "complete"
    fake_scan(tmp_path / "b")
    assert folder_bytes(tmp_path / "a") == folder_bytes(tmp_path / "b")


def test_an_existing_folder_is_refused(tmp_path: Path, drivers: FakeDrivers) -> None:
    (tmp_path / "a").mkdir()
    with pytest.raises(InputError, match=r"exists already.*another folder.*--resume.*resume=True"):
        scan(fake_rig(), tmp_path / "a")
    assert drivers.opened == 0


def test_resuming_a_complete_run_does_nothing(tmp_path: Path, drivers: FakeDrivers) -> None:
    before = scan(fake_rig(), tmp_path / "a")
    files, opened = folder_bytes(tmp_path / "a"), drivers.opened
    assert scan(fake_rig(), tmp_path / "a", resume=True) == before
    assert folder_bytes(tmp_path / "a") == files
    assert drivers.opened == opened


def test_resuming_what_is_not_there_begins_it(tmp_path: Path, drivers: FakeDrivers) -> None:
    run = scan(fake_rig(), tmp_path / "a", resume=True)
    assert (run.state, len(run)) == ("complete", 5)


def test_resuming_with_another_rig_names_the_key(tmp_path: Path) -> None:
    fake_scan(tmp_path / "a")
    with pytest.raises(InputError, match=r"begun with plan\.frames = 5, .* with plan\.frames = 6"):
        resume_run(tmp_path / "a", fake_rig(frames=6))


def test_a_foreign_folder_is_not_resumed(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("precious")
    with pytest.raises(InputError, match=r"not a run folder"):
        resume_run(tmp_path, fake_rig())
    assert folder_bytes(tmp_path) == {"thesis.txt": b"precious"}


def test_two_scans_cannot_write_to_one_folder(tmp_path: Path) -> None:
    with (
        create_run(tmp_path / "a", fake_rig()),
        pytest.raises(InputError, match="another scan"),
    ):
        resume_run(tmp_path / "a", fake_rig())
    assert resumed(tmp_path / "a").state == "complete"


def test_a_changed_frame_is_not_resumed_upon(tmp_path: Path) -> None:
    with create_run(tmp_path / "a", fake_rig()) as writer, pytest.raises(DeviceError):
        track = FakeTrack(fail_at=2)
        acquire_into(writer, FakeCamera(track), track)
    file = tmp_path / "a" / "frames" / "000001.png"
    file.write_bytes(file.read_bytes()[:-1])
    with pytest.raises(InputError, match=r"000001\.png.*line 3"):
        resume_run(tmp_path / "a", fake_rig())


# Killed at any moment


def test_a_killed_scan_resumes_to_the_same_bytes(tmp_path: Path) -> None:
    """The set-up must reach each kind of remnant, or the test shows nothing."""
    rig_file = fake_rig(frames=3)
    found = remnants(tmp_path, partial(resumed, rig_file=rig_file))
    whole = folder_bytes(tmp_path / "run")
    assert len(found) >= 60
    assert _kinds(found) == {"temporary", "frame without row", "torn row", "no manifest"}
    for path in found:
        resumed(path, rig_file)
        assert folder_bytes(path) == whole, path.name


@pytest.mark.slow  # real signals; what they leave, without them, is above
@pytest.mark.parametrize(("moments", "at_least"), [("twice", 15), ("anytime", 2)])
def test_a_scan_that_a_signal_killed_resumes_to_the_same_bytes(
    tmp_path: Path, moments: str, at_least: int
) -> None:
    fake_scan(tmp_path / "whole", fake_rig(frames=3))
    folder = tmp_path / "killed"
    folder.mkdir()
    command = [sys.executable, str(SUPPORT / "killed_scans.py"), str(folder), moments]
    subprocess.run(command, check=True, cwd=ROOT, env={**os.environ, "PYTHONPATH": "."})
    killed = sorted(folder.iterdir())
    assert len(killed) >= at_least
    for path in killed:
        resumed(path, fake_rig(frames=3))
        assert folder_bytes(path) == folder_bytes(tmp_path / "whole"), path.name


def test_what_a_killed_scan_left_is_cleared_when_taken_up(tmp_path: Path) -> None:
    """Before the next frame is written: it might not come, or have another name."""
    with create_run(tmp_path / "a", fake_rig()) as writer, pytest.raises(DeviceError):
        track = FakeTrack(fail_at=2)
        acquire_into(writer, FakeCamera(track), track)
    before = folder_bytes(tmp_path / "a")
    (tmp_path / "a" / ".run.json.tmp").write_bytes(b"{")
    (tmp_path / "a" / "frames" / ".000002.png.tmp").write_bytes(b"half")
    with (tmp_path / "a" / "frames.csv").open("ab") as table:
        table.write(b"2,1.2,1.21")
    with resume_run(tmp_path / "a", fake_rig()) as writer:
        assert writer.written == 2
    assert folder_bytes(tmp_path / "a") == before


def test_other_software_is_noted_on_resuming(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with create_run(tmp_path / "a", fake_rig()):
        pass
    monkeypatch.setattr(lscan.acquisition.run, "__version__", "99.0")
    assert [versions["lscan"] for versions in resumed(tmp_path / "a").software][1:] == ["99.0"]


def _kinds(folders: list[Path]) -> set[str]:
    found = set()
    for path in folders:
        table = path / "frames.csv"
        text = table.read_bytes() if table.exists() else b""
        if list(path.rglob(".*.tmp")):
            found.add("temporary")
        if not (path / "run.json").exists():
            found.add("no manifest")
        elif not text.endswith(b"\n"):
            found.add("torn row")
        elif len(list(path.glob("frames/*.png"))) == text.count(b"\n"):
            found.add("frame without row")
    return found


# Faults


@pytest.mark.parametrize("call", ["open", "write", "fsync", "replace"])
@pytest.mark.parametrize("fault", [errno.ENOSPC, errno.EROFS])
def test_a_disk_that_refuses_leaves_whole_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str, fault: int
) -> None:
    fake_scan(tmp_path / "whole")
    original, track = getattr(os, call), FakeTrack()
    calls = 0

    def refusing(*args: Any, **kwargs: Any) -> Any:
        nonlocal calls
        if track.moves == 3:
            calls += 1
            raise OSError(fault, os.strerror(fault))
        return original(*args, **kwargs)

    with create_run(tmp_path / "a", fake_rig()) as writer:
        monkeypatch.setattr(os, call, refusing)
        with pytest.raises(InputError, match=os.strerror(fault)):
            acquire_into(writer, FakeCamera(track), track)
        monkeypatch.setattr(os, call, original)
    assert calls > 0
    stopped = open_run(tmp_path / "a")
    stopped.verify()
    assert (stopped.state, len(stopped)) == ("scanning", 2)
    assert not list((tmp_path / "a").rglob(".*.tmp"))
    resumed(tmp_path / "a")
    assert folder_bytes(tmp_path / "a") == folder_bytes(tmp_path / "whole")


def test_a_disk_full_in_the_middle_of_a_row_takes_the_row_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    original, track = os.write, FakeTrack()

    def half_then_full(descriptor: int, data: Any) -> int:
        if track.moves == 3 and bytes(data[:2]) == b"2,":
            return original(descriptor, data[:10])
        if track.moves == 3 and bytes(data[:4]) != b"\x89PNG":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return original(descriptor, data)

    with create_run(tmp_path / "a", fake_rig()) as writer:
        monkeypatch.setattr(os, "write", half_then_full)
        with pytest.raises(InputError, match=r"frames\.csv: cannot be written: No space left"):
            acquire_into(writer, FakeCamera(track), track)
    assert len(open_run(tmp_path / "a")) == 2


def test_a_disk_full_at_the_very_start_leaves_no_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "write", full)
    with pytest.raises(InputError, match="No space left"):
        create_run(tmp_path / "a", fake_rig())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_read_only_folder_is_named(tmp_path: Path) -> None:
    tmp_path.chmod(0o555)
    try:
        with pytest.raises(InputError, match="Permission denied"):
            create_run(tmp_path / "a", fake_rig())
    finally:
        tmp_path.chmod(0o755)


def test_a_file_in_the_way_is_named(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("")
    with pytest.raises(InputError, match="Not a directory"):
        resume_run(tmp_path / "a", fake_rig())
    with pytest.raises(InputError, match="Not a directory"):
        create_run(tmp_path / "a" / "b", fake_rig())


BAD_PICTURES = {
    "too small": np.zeros((8, 20, 3), np.uint8),
    "turned": np.zeros((20, 16, 3), np.uint8),
    "float": np.zeros((16, 20, 3)),
    "16 bit": np.zeros((16, 20), np.uint16),
    "alpha": np.zeros((16, 20, 4), np.uint8),
    "flat": np.zeros(320, np.uint8),
}


@pytest.mark.parametrize("kind", [*BAD_PICTURES, "camera fails", "track fails"])
def test_a_device_fault_records_nothing_and_closes_both(
    tmp_path: Path, drivers: FakeDrivers, kind: str
) -> None:
    if kind == "track fails":
        drivers.track.fail_at = 2
    else:
        drivers.camera.fail_at = 2
        drivers.camera.bad_picture = BAD_PICTURES.get(kind)
    with pytest.raises(DeviceError):
        scan(fake_rig(), tmp_path / "a")
    assert (drivers.track.closed, drivers.camera.closed) == (1, 1)
    stopped = open_run(tmp_path / "a")
    assert (stopped.state, len(stopped)) == ("scanning", 2)
    assert len(list((tmp_path / "a" / "frames").iterdir())) == 2
    fake_scan(tmp_path / "whole")
    drivers.track.fail_at = drivers.camera.fail_at = None
    scan(fake_rig(), tmp_path / "a", resume=True)
    assert folder_bytes(tmp_path / "a") == folder_bytes(tmp_path / "whole")


def test_a_camera_of_another_size_is_refused_before_a_folder_is_made(
    tmp_path: Path, drivers: FakeDrivers
) -> None:
    with pytest.raises(DeviceError, match=r"20 by 16 px; the rig says 40 by 30 px"):
        scan(fake_rig(width_px=40, height_px=30), tmp_path / "a")
    assert not (tmp_path / "a").exists()
    assert (drivers.track.closed, drivers.camera.closed) == (1, 1)


def test_an_old_picture_is_refused(tmp_path: Path) -> None:
    """Going backwards, the fake camera's clock does too."""
    with pytest.raises(DeviceError, match="old picture"):
        fake_scan(tmp_path / "a", fake_rig(step_mm=-0.1))
    assert len(open_run(tmp_path / "a")) == 1


def test_the_picture_before_is_refused_where_it_comes_once_more(tmp_path: Path) -> None:
    class StuckCamera(FakeCamera):
        def grab(self, frame: int | None = None, dark: bool = False) -> Grab:
            return replace(super().grab(frame, dark), time_s=7.0)

    track = FakeTrack()
    with (
        create_run(tmp_path / "a", fake_rig()) as writer,
        pytest.raises(DeviceError, match=r"old picture: its time, 7\.0 s, is not after .* 7\.0 s"),
    ):
        acquire_into(writer, StuckCamera(track), track)
    assert len(open_run(tmp_path / "a")) == 1


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_position_that_is_no_number_is_refused(tmp_path: Path, value: float) -> None:
    class LostTrack(FakeTrack):
        def move_to(self, position_mm: float) -> float:
            super().move_to(position_mm)
            return value

    track = LostTrack()
    with (
        create_run(tmp_path / "a", fake_rig()) as writer,
        pytest.raises(DeviceError, match="position_mm"),
    ):
        acquire_into(writer, FakeCamera(track), track)
    assert len(open_run(tmp_path / "a")) == 0


def test_a_moved_folder_stands_alone(tmp_path: Path) -> None:
    """No driver "fake" is registered here, and the folder opens all the same."""
    run = fake_scan(tmp_path / "a")
    shutil.move(tmp_path / "a", tmp_path / "elsewhere")
    moved = open_run(tmp_path / "elsewhere")
    assert moved.rig_file.document == fake_rig().document
    assert moved.rig_file.rig == fake_rig().rig
    assert moved.rows == run.rows
