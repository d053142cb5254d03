"""What ``lscan scan`` says and leaves with when it is resumed, stopped or cannot write."""

import errno
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from fake_devices import HEIGHT, WIDTH, FakeCamera, FakeTrack

from lscan.cli.app import app
from lscan.cli.console import run_command_line
from lscan.devices.api import Grab
from lscan.errors import DiskError, InputError
from lscan.files.disk import disk_errors

FRAMES = 5
UNPLUGGED = f"""
[camera]
driver = "opencv"
width_px = {WIDTH}
height_px = {HEIGHT}
options = {{ device = "/dev/no-such-camera" }}
[track]
driver = "grbl"
options = {{ port = "/dev/no-such-port", min_mm = 0, max_mm = 40 }}
[plan]
frames = {FRAMES}
step_mm = 0.1
"""
Scan = Callable[..., tuple[int, str]]


@pytest.fixture
def scan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> Scan:
    """Runs ``lscan scan RIG -o FOLDER ...`` with devices that are not there."""
    rig = tmp_path / "rig.toml"
    rig.write_text(UNPLUGGED)

    def run(folder: Path, *options: str) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["lscan", "scan", str(rig), "-o", str(folder), *options])
        with pytest.raises(SystemExit) as left:
            run_command_line(app, "lscan")
        assert isinstance(left.value.code, int)
        return left.value.code, capsys.readouterr().err

    return run


class StoppedCamera(FakeCamera):
    """At its third picture the user presses Ctrl-C."""

    def grab(self, frame: int | None = None, dark: bool = False) -> Grab:
        if frame == 2:
            raise KeyboardInterrupt
        return super().grab(frame, dark)


@pytest.fixture
def plugged_in(monkeypatch: pytest.MonkeyPatch) -> Callable[[FakeCamera, FakeTrack], None]:
    """Puts these devices in the place of the rig's."""

    def plug_in(camera: FakeCamera, track: FakeTrack) -> None:
        @contextmanager
        def devices(_: object) -> Iterator[tuple[FakeCamera, FakeTrack]]:
            yield camera, track

        monkeypatch.setattr("lscan.acquisition.scan.open_devices", devices)

    return plug_in


# A name that holds no run


@pytest.mark.parametrize("there", [False, True])
def test_resuming_nothing_says_so_before_a_device_is_opened(
    tmp_path: Path, scan: Scan, there: bool
) -> None:
    """Where no folder is, and where a killed scan left an empty one; then there is a run."""
    folder = tmp_path / "frist"
    if there:
        folder.mkdir()
    code, said = scan(folder, "--resume")
    note, error = said.splitlines()
    assert note == f"lscan: note: there is nothing to resume in {folder}; a new run is begun"
    assert (code, "/dev/no-such-port" in error) == (1, True)
    code, said = scan(folder, "--resume")
    assert (code, "note" in said, "nothing to resume" in said) == (1, False, False)


def test_a_folder_of_something_else_is_not_said_to_be_begun(tmp_path: Path, scan: Scan) -> None:
    (tmp_path / "thesis.txt").write_text("precious")
    code, said = scan(tmp_path, "--resume")
    assert (code, said.count("\n"), "not a run folder" in said) == (2, 1, True)


def test_a_scan_without_resume_says_nothing_of_it(tmp_path: Path, scan: Scan) -> None:
    assert "nothing to resume" not in scan(tmp_path / "a")[1]


def test_position_restored_is_a_word_about_resuming(tmp_path: Path, scan: Scan) -> None:
    code, said = scan(tmp_path / "a", "--position-restored")
    assert (code, said) == (2, "lscan: --position-restored: goes with --resume only\n")
    assert not (tmp_path / "a").exists()


# Ctrl-C


@pytest.mark.parametrize("options", [(), ("--resume",)])
def test_ctrl_c_says_how_many_frames_are_kept(
    tmp_path: Path,
    scan: Scan,
    plugged_in: Callable[[FakeCamera, FakeTrack], None],
    options: tuple[str, ...],
) -> None:
    track = FakeTrack()
    plugged_in(StoppedCamera(track), track)
    code, said = scan(tmp_path / "a", *options)
    kept = f"2 of {FRAMES} frames are kept in {tmp_path / 'a'}; go on with --resume"
    assert (code, said.splitlines()[-1]) == (130, f"lscan: stopped; {kept}")


def test_ctrl_c_before_there_is_a_run_speaks_of_none(
    tmp_path: Path, scan: Scan, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("lscan.acquisition.scan.open_devices", stop)
    assert scan(tmp_path / "a") == (130, "lscan: stopped\n")


# The disk, the memory


@pytest.mark.parametrize(("said", "line"), [("", ""), ("22 GiB", ": 22 GiB")])
def test_too_little_memory_is_one_line(
    tmp_path: Path, scan: Scan, monkeypatch: pytest.MonkeyPatch, said: str, line: str
) -> None:
    def exhaust(_: object) -> None:
        raise MemoryError(said)

    monkeypatch.setattr("lscan.acquisition.scan.open_devices", exhaust)
    assert scan(tmp_path / "a") == (1, f"lscan: there is not enough memory{line}\n")


def test_a_disk_full_in_mid_scan_leaves_with_the_code_of_a_failed_device(
    tmp_path: Path,
    scan: Scan,
    plugged_in: Callable[[FakeCamera, FakeTrack], None],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    track, write = FakeTrack(), os.write

    def full(descriptor: int, data: Any) -> int:
        if track.moves == 3:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write(descriptor, data)

    plugged_in(FakeCamera(track), track)
    monkeypatch.setattr(os, "write", full)
    code, said = scan(tmp_path / "a")
    assert (code, "make room on the disk; 2 of 5 frames are kept" in said) == (1, True)


@pytest.mark.parametrize(
    ("number", "kind"),
    [
        (errno.ENOSPC, DiskError),
        (errno.EDQUOT, DiskError),
        (errno.EFBIG, DiskError),
        (errno.EIO, DiskError),
        (errno.EACCES, InputError),
        (errno.ENOENT, InputError),
        (errno.ENAMETOOLONG, InputError),
    ],
)
def test_only_a_disk_that_is_full_or_failed_is_no_bad_input(
    tmp_path: Path, number: int, kind: type[InputError]
) -> None:
    with pytest.raises(InputError) as refused, disk_errors(tmp_path):
        raise OSError(number, os.strerror(number))
    assert type(refused.value) is kind
    assert refused.value.exit_code == (1 if kind is DiskError else 2)
