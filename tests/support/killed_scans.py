"""Scans that are killed: what they leave in the run folder at any moment, and real processes.

:func:`remnants` needs no process.  As a script it is run by test_scan.py and test_laser_pairs.py:

``killed_scans.py FOLDER twice``: scans killed at a random call, resumed, killed again.
``killed_scans.py FOLDER anytime``: scans killed from outside after a random time.

Two more arguments are the number of frames, 3 where it is left out, and the plan's ``laser``.
"""

import os
import shutil
import signal
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_devices import FakeCamera, LaserTrack, fake_rig

from lscan.acquisition.scan import acquire_into
from lscan.acquisition.writer import resume_run

CALLS = ("mkdir", "open", "write", "fsync", "replace", "ftruncate", "unlink", "close")


def remnants(folder: Path, scan: Callable[[Path], object]) -> list[Path]:
    """Copies of the run folder as a scan leaves it that is killed at a call that touches the disk.

    One as it is just before each call and, where that is a write, one half way through it.  What
    was handed to the system stays when a process is killed, so that its folder is that copy.
    """
    found: list[Path] = []
    copying = False

    def copy_now() -> None:
        nonlocal copying
        copying = True
        if (folder / "run").exists():
            found.append(folder / f"{len(found):03d}")
            shutil.copytree(folder / "run", found[-1])
        copying = False

    def watched(name: str, original: Callable[..., Any]) -> Callable[..., Any]:
        def wrapper(*args: Any, **kwargs: Any) -> Any:
            if copying:
                return original(*args, **kwargs)
            copy_now()
            if name != "write":
                return original(*args, **kwargs)
            half = original(args[0], args[1][: len(args[1]) // 2])
            copy_now()
            return half + original(args[0], args[1][half:])

        return wrapper

    with pytest.MonkeyPatch.context() as patch:
        for name in CALLS:
            patch.setattr(os, name, watched(name, getattr(os, name)))
        scan(folder / "run")
    return found


def scan(path: Path, frames: int, plan: dict[str, str]) -> None:
    """The test's scan, begun or resumed."""
    with resume_run(path, fake_rig(frames, **plan)) as writer:
        track = LaserTrack()
        acquire_into(writer, FakeCamera(track), track)


def in_child(work: Callable[[], None]) -> int:
    """Process id of a child that does ``work`` and ends."""
    child = os.fork()
    if child == 0:
        try:
            work()
            os._exit(0)
        except BaseException as error:
            print(f"child failed: {error!r}", file=sys.stderr, flush=True)
            os._exit(1)
    return child


def was_killed(child: int) -> bool:
    """Wait for the child; False where it came to its end, an error where it failed."""
    _, status = os.waitpid(child, 0)
    if os.WIFSIGNALED(status):
        return os.WTERMSIG(status) == signal.SIGKILL
    if os.WEXITSTATUS(status) != 0:
        raise SystemExit("a scan failed instead of being killed")
    return False


Scan = Callable[[Path], None]


def scan_killed_at(scan: Scan, path: Path, call: int, half: bool) -> None:
    """Scan, and die at disk call number ``call``; with ``half``, in the middle of a write."""
    count = 0

    def watched(name: str, original: Callable[..., Any]) -> Callable[..., Any]:
        def wrapper(*args: Any, **kwargs: Any) -> Any:
            nonlocal count
            if count == call:
                if half and name == "write":
                    original(args[0], args[1][: len(args[1]) // 2])
                os.kill(os.getpid(), signal.SIGKILL)
            count += 1
            return original(*args, **kwargs)

        return wrapper

    for name in CALLS:
        setattr(os, name, watched(name, getattr(os, name)))
    scan(path)


def twice(scan: Scan, folder: Path, number: int = 20) -> None:
    """Kill at a random call, resume, kill again."""
    generator = np.random.default_rng(1)
    for index in range(number):
        for call, half in zip(generator.integers(0, 30, 2), generator.random(2) < 0.5, strict=True):
            was_killed(in_child(partial(scan_killed_at, scan, folder / f"{index}", call, half)))


def anytime(scan: Scan, folder: Path, number: int = 20) -> None:
    """Kill from outside, at moments spread over the time a scan takes."""
    begin = time.perf_counter()
    was_killed(in_child(partial(scan, folder / "whole")))
    whole_s = time.perf_counter() - begin
    for index, part in enumerate(np.random.default_rng(2).random(number)):
        child = in_child(partial(scan, folder / f"{index}"))
        time.sleep(part * whole_s)
        os.kill(child, signal.SIGKILL)
        was_killed(child)


if __name__ == "__main__":
    # A killed process loses nothing that it gave to the system; only a power failure would.
    os.fsync = lambda descriptor: None  # type: ignore[assignment]
    frames = int(sys.argv[3]) if len(sys.argv) > 3 else 3
    plan = {"laser": sys.argv[4]} if len(sys.argv) > 4 else {}
    one = partial(scan, frames=frames, plan=plan)
    {"twice": twice, "anytime": anytime}[sys.argv[2]](one, Path(sys.argv[1]))
