"""What of the instrument can be shown of Windows without one: it does without what is not there.

The commands are run by tests/support/windows.py, whose head says what that stands for.
"""

import errno
import io
import os
import subprocess
import sys
import time
import zipfile
from dataclasses import dataclass, field
from pathlib import Path

import pytest
import typer
import windows
from calibrations import drawn_calibration
from drawn_runs import flat_run, rig_file
from places import ROOT, SUPPORT

from lscan.acquisition.run import open_run
from lscan.acquisition.writer import create_run, resume_run
from lscan.calibration.calibrationfile import save_calibration
from lscan.cli.console import run_command_line
from lscan.errors import InputError, missing_package
from lscan.files.containers import open_zip
from lscan.files.disk import (
    LOCK,
    lock_folder,
    open_to_append,
    read_bytes,
    sync_folder,
    write_atomically,
)
from lscan.live import server
from lscan.surface import load_surface

pytestmark = pytest.mark.xdist_group("windows")
RIG = """
camera = { driver = "replay", width_px = 640, height_px = 480, options = { run_file = "first" } }
track = { driver = "replay", options = { run_file = "first" } }
plan = { frames = 3, step_mm = 2.0 }
stripe = { threshold_dn = 15.0, noise = { read_dn = 1.0 } }
"""


@dataclass
class Refused:
    """left: how often a file is still not replaced.  slept_s: what was slept meanwhile."""

    left: int = 0
    slept_s: list[float] = field(default_factory=list)


def on_windows(folder: Path, *commands: str) -> str:
    """What the commands print, run there; AssertionError where one fails."""
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, SUPPORT / "windows.py", *commands],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_every_module_is_imported(tmp_path: Path) -> None:
    on_windows(tmp_path)


def test_the_commands_of_a_scan_run(tmp_path: Path) -> None:
    flat_run(tmp_path / "first", 3)
    save_calibration(tmp_path / "calibration.json", drawn_calibration())
    (tmp_path / "rig.toml").write_text(RIG, encoding="utf-8")
    said = on_windows(
        tmp_path,
        *("--help", "devices", "scan rig.toml -o again", "scan rig.toml -o again --resume"),
        "extract again/frames/000001.png -o line.csv",
        "reconstruct again -c calibration.json -o surface.nc",
        "grid surface.nc -o grid.nc",
    )
    assert "serial ports" in said
    first, again = open_run(tmp_path / "first"), open_run(tmp_path / "again")
    assert again.state == "complete" and list(again.rows) == list(first.rows)
    assert load_surface(tmp_path / "surface.nc").xyz_mm.shape[0] == 3
    assert all((tmp_path / name).stat().st_size for name in ("line.csv", "grid.nc"))


@pytest.mark.slow
def test_no_name_is_used_that_other_systems_lack(tmp_path: Path) -> None:
    """By the stubs of Python's own library, which say where each name is; what stands behind
    ``hasattr`` is let pass."""
    for system in ("win32", "darwin"):
        command = [sys.executable, "-m", "mypy", "--platform", system, "--cache-dir", tmp_path]
        done = subprocess.run([*command, "lscan"], cwd=ROOT, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout


# ---- in this process, name by name -------------------------------------------------------


@pytest.fixture
def no_folder_opens(monkeypatch: pytest.MonkeyPatch) -> None:
    """No folder can be opened, and locks are those of ``msvcrt``."""
    monkeypatch.delattr(os, "O_DIRECTORY")
    monkeypatch.setitem(sys.modules, "fcntl", None)
    monkeypatch.setitem(sys.modules, "msvcrt", windows.MSVCRT)


@pytest.mark.usefixtures("no_folder_opens")
def test_a_folder_is_written_by_one_process_at_a_time(tmp_path: Path) -> None:
    lock = lock_folder(tmp_path)
    with pytest.raises(InputError, match="is being written by another scan"):
        lock_folder(tmp_path)
    os.close(lock)
    os.close(lock_folder(tmp_path))
    sync_folder(tmp_path)


@pytest.mark.usefixtures("no_folder_opens")
def test_a_run_begun_and_killed_is_gone_on_with(tmp_path: Path) -> None:
    """All that it has left may be the file of its lock."""
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / LOCK).touch()
    with resume_run(tmp_path / "run", rig_file()) as writer:
        assert writer.written == 0
        with pytest.raises(InputError, match="is being written"):
            resume_run(tmp_path / "run", rig_file())
    with pytest.raises(InputError, match="exists already"):
        create_run(tmp_path / "run", rig_file())


@pytest.fixture
def refused(monkeypatch: pytest.MonkeyPatch) -> Refused:
    """As where somebody reads a file: nobody replaces it until the count has come down to 0."""
    refused, replace = Refused(), Path.replace

    def try_to(self: Path, target: Path) -> Path:
        if refused.left:
            refused.left -= 1
            raise PermissionError(errno.EACCES, "Access is denied")
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", try_to)
    monkeypatch.setattr(time, "sleep", refused.slept_s.append)
    return refused


def test_a_file_that_is_read_is_replaced_once_it_is_closed(
    refused: Refused, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "platform", "win32")
    refused.left = 3
    write_atomically(tmp_path / "run.json", b"new")
    assert ((tmp_path / "run.json").read_bytes(), len(refused.slept_s)) == (b"new", 3)


@pytest.mark.parametrize(("system", "longest_s"), [("win32", 1.0), ("linux", 0.0)])
def test_a_file_that_stays_open_is_not_waited_for_without_end(
    system: str,
    longest_s: float,
    refused: Refused,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys, "platform", system)
    refused.left = 1000
    (tmp_path / "run.json").write_text("old")
    with pytest.raises(InputError, match="Access is denied"):
        write_atomically(tmp_path / "run.json", b"new")
    assert sum(refused.slept_s) <= longest_s
    assert {file.name: file.read_text() for file in tmp_path.iterdir()} == {"run.json": "old"}


def test_no_line_end_is_translated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As Windows does in files that are not opened as binary."""
    binary, opened, really = windows.O_BINARY, list[int](), os.open

    def spied(path: Path, flags: int, mode: int = 0o777) -> int:
        opened.append(flags)
        return really(path, flags & ~binary, mode)

    monkeypatch.setattr(os, "O_BINARY", binary, raising=False)
    monkeypatch.setattr(os, "open", spied)
    write_atomically(tmp_path / "frames.csv", b"index\r\n")
    assert read_bytes(tmp_path / "frames.csv", 10) == b"index\r\n"
    os.close(open_to_append(tmp_path / "frames.csv"))
    assert len(opened) == 4 and all(flags & binary for flags in opened)


def test_a_link_is_not_appended_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "O_NOFOLLOW")
    (tmp_path / "theirs").touch()
    (tmp_path / "frames.csv").symlink_to(tmp_path / "theirs")
    with pytest.raises(InputError, match="put the file itself there"):
        open_to_append(tmp_path / "frames.csv")


def test_members_of_an_archive_are_read_in_any_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with zipfile.ZipFile(tmp_path / "suite.zip", "w") as archive:
        archive.writestr("one", b"1" * 5000)
        archive.writestr("two", b"2" * 70000)
    monkeypatch.delattr(os, "pread")
    read = open_zip(tmp_path / "suite.zip", 2**20, "suite")
    for _ in range(2):
        assert read("two", 2**20) == b"2" * 70000
        assert read("one", 2**20) == b"1" * 5000


def test_the_live_page_takes_as_many_as_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "resource", None)
    assert server._most_files() - server.KEPT_FILES > server.MOST_CONNECTIONS


def test_what_posix_alone_has_is_no_package_to_install() -> None:
    line = missing_package(ModuleNotFoundError("No module named 'fcntl'", name="fcntl"))
    assert "WSL" in line and "pip" not in line
    assert "pip install" in missing_package(ModuleNotFoundError("", name="mitsuba"))


def test_a_page_of_codes_that_lacks_a_letter_ends_no_command(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Into a file, Windows writes in the code page of its language."""
    app = typer.Typer()
    app.command()(lambda: print("\u00b1 0.1 \u2264 \u03c3"))
    written = io.TextIOWrapper(io.BytesIO(), encoding="cp1252")
    monkeypatch.setattr(sys, "stdout", written)
    monkeypatch.setattr(sys, "argv", ["lscan"])
    with pytest.raises(SystemExit) as left:
        run_command_line(app, "lscan")
    assert left.value.code == 0
    assert written.buffer.getvalue().decode("cp1252").strip() == "\u00b1 0.1 \\u2264 \\u03c3"
