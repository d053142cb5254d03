"""Kept tables: made once, by one at a time, and never believed where they are broken."""

import logging
import os
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from shown_work import ShownWork

from lscan.errors import DiskError
from lscan.files.cache import cache_folder, long_work_shown, read_cached
from lscan.records import Floats
from lscan.suites.files import suite_cache
from sim.water import tablecache
from sim.water.tablecache import kept_arrays

HOLD = """
import fcntl, sys, time
file = open(sys.argv[1], "a")
fcntl.flock(file, fcntl.LOCK_EX)
print("held", flush=True)
time.sleep(600)
"""


class Maker:
    """Counts how often it was asked."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self) -> dict[str, Floats]:
        self.calls += 1
        return {"a": np.arange(6.0).reshape(2, 3), "b": np.array(self.calls, dtype=float)}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "lscan"


def test_a_table_is_made_once(folder: Path) -> None:
    make = Maker()
    made, kept = kept_arrays("one", make), kept_arrays("one", make)
    assert make.calls == 1
    assert made.keys() == kept.keys()
    assert all(np.array_equal(made[name], kept[name]) for name in made)
    kept_arrays("another", make)
    assert make.calls == 2


def test_tables_of_a_mesh_of_a_million_triangles_are_kept(folder: Path) -> None:
    """Each triangle holds a node at least, with eight neighbours and their shares as float32."""
    make = Maker()
    node = np.ones((1_100_000, 8), np.float32)
    for _ in range(2):
        kept_arrays("mesh", lambda: make() | {"near": node, "shares": node})
    assert make.calls == 1


def test_the_tables_used_longest_ago_are_removed(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three of equal size where there is room for two: the one that was read last stays."""
    make = Maker()
    for when, name in enumerate(("one", "two")):
        kept_arrays(name, make)
        os.utime(folder / name, (1000 + when, 1000 + when))
    (folder / "llvm.json").write_text("{}")
    monkeypatch.setattr(tablecache, "MOST_BYTES", 2 * (folder / "one").stat().st_size)
    kept_arrays("one", make)  # is used again
    kept_arrays("three", make)
    names = {path.name for path in folder.iterdir()}
    assert names == {"one", "one.lock", "three", "three.lock", "llvm.json"}
    assert make.calls == 3


@pytest.mark.parametrize("cut", [0, 10, 200, -1])
def test_a_broken_file_is_made_anew(folder: Path, cut: int) -> None:
    make = Maker()
    kept_arrays("one", make)
    data = (folder / "one").read_bytes()
    (folder / "one").write_bytes(data[:cut])
    assert kept_arrays("one", make)["b"] == 2.0
    (folder / "one").write_bytes(data[:40] + bytes([data[40] ^ 1]) + data[41:])
    assert kept_arrays("one", make)["b"] == 3.0
    assert kept_arrays("one", make)["b"] == 3.0


def test_who_comes_second_waits_for_the_first(folder: Path) -> None:
    begun, go_on = threading.Event(), threading.Event()

    def slowly() -> dict[str, Floats]:
        begun.set()
        assert go_on.wait(60)
        return {"a": np.ones(2)}

    second, found = Maker(), []
    first = threading.Thread(target=kept_arrays, args=("one", slowly))
    first.start()
    assert begun.wait(60)
    other = threading.Thread(target=lambda: found.append(kept_arrays("one", second)))
    shown = ShownWork()
    with long_work_shown(shown):
        other.start()
        while other.is_alive() and not shown.titles:  # until it waits
            other.join(0.01)
        go_on.set()
    for thread in (first, other):
        thread.join(60)
    assert second.calls == 0
    assert np.array_equal(found[0]["a"], np.ones(2))


def test_the_lock_of_a_killed_process_does_not_hold(folder: Path) -> None:
    folder.mkdir()
    command = [sys.executable, "-S", "-c", HOLD, str(folder / "one.lock")]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == b"held\n"
        make = Maker()
        shown = ShownWork()
        with long_work_shown(shown):
            waiting = threading.Thread(target=kept_arrays, args=("one", make))
            waiting.start()
            waiting.join(0.2)
            assert waiting.is_alive()
            assert make.calls == 0
            holder.kill()
            waiting.join(60)
    assert make.calls == 1
    assert shown.titles == ["wait for a table that another process makes"]


def test_a_cache_that_cannot_be_written_gives_a_table_and_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))  # no folder can be made in it
    with caplog.at_level(logging.WARNING):
        assert kept_arrays("one", Maker())["b"] == 1.0
    assert "made again" in caplog.text


def test_a_full_disk_gives_a_table_and_a_warning(
    folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(file: Path, data: bytes) -> None:
        raise DiskError("cannot be written: no space left", where=file)

    monkeypatch.setattr(tablecache, "write_atomically", full)
    with caplog.at_level(logging.WARNING):
        assert kept_arrays("one", Maker())["b"] == 1.0
    assert "no space left" in caplog.text
    assert not (folder / "one").exists()


def test_a_maker_that_fails_leaves_nothing_and_no_lock(folder: Path) -> None:
    def failing() -> dict[str, Floats]:
        raise MemoryError

    with pytest.raises(MemoryError):
        kept_arrays("one", failing)
    assert kept_arrays("one", Maker())["b"] == 1.0


def another_user(monkeypatch: pytest.MonkeyPatch) -> None:
    """This process runs as a user who owns none of what there is."""
    mine = os.getuid()
    monkeypatch.setattr(os, "getuid", lambda: mine + 1)


def test_a_folder_of_another_user_is_no_cache(
    folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    make = Maker()
    kept_arrays("one", make)
    before = (folder / "one").read_bytes()
    another_user(monkeypatch)
    with caplog.at_level(logging.WARNING):
        assert kept_arrays("one", make)["b"] == 2.0
    assert "no cache of this user's own" in caplog.text
    assert (folder / "one").read_bytes() == before
    assert (cache_folder(), suite_cache()) == (None, None)


def test_a_table_that_another_user_laid_there_is_made_anew(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As into a folder that was open to all before."""
    make = Maker()
    kept_arrays("one", make)
    theirs, whose = os.getuid() + 1, Path.stat

    def stat(path: Path, **options: Any) -> Any:
        of = whose(path, **options)
        return SimpleNamespace(st_uid=theirs) if path.name == "one" else of

    monkeypatch.setattr(Path, "stat", stat)
    assert read_cached(folder / "one", 2**20) is None
    monkeypatch.undo()
    assert read_cached(folder / "one", 2**20) == (folder / "one").read_bytes()


@pytest.mark.parametrize("mode", [0o755, 0o777, 0o2770])
def test_nobody_else_gets_into_the_cache(folder: Path, mode: int) -> None:
    folder.mkdir()
    folder.chmod(mode)
    assert cache_folder() == folder
    assert folder.stat().st_mode & 0o777 == 0o700


def test_without_home_the_cache_is_a_folder_of_ones_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the folder that all share: a link that is there already leads nowhere."""
    for name in ("HOME", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(tempfile, "gettempdir", lambda: str(tmp_path))
    folder = tmp_path / f"lscan-{os.getuid()}"
    (tmp_path / "theirs").mkdir()
    folder.symlink_to(tmp_path / "theirs")
    assert cache_folder() is None
    folder.unlink()
    assert cache_folder() == folder
    assert folder.stat().st_mode & 0o777 == 0o700
    another_user(monkeypatch)
    folder.rename(tmp_path / f"lscan-{os.getuid()}")
    assert cache_folder() is None
