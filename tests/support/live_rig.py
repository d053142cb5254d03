"""A session of the live page on fake devices, and waiting for what it does."""

import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from fake_devices import FakeCamera, FakeDrivers, FakeTrack, fake_rig

import lscan.config.rig
from lscan.devices.api import Grab
from lscan.live.session import Session

LONG_S = 60.0
"""Longer than anything takes on a loaded machine; only a failure waits so long."""


def wait_for(true: Callable[[], Any]) -> Any:
    """What ``true`` returns once it is true; an AssertionError if it never is."""
    deadline_s = time.monotonic() + LONG_S
    while not (value := true()):
        assert time.monotonic() < deadline_s, "waited in vain"
        time.sleep(0.005)
    return value


@dataclass
class GatedTrack(FakeTrack):
    """Moves to the stop of frame n only once ``allow(n)`` was called; free from the start."""

    gate: threading.Semaphore | None = None

    def move_to(self, position_mm: float) -> float:
        """Wait to be let go, and move."""
        if self.gate is not None:
            assert self.gate.acquire(timeout=LONG_S)
        return super().move_to(position_mm)


@dataclass
class SeeingCamera(FakeCamera):
    """A camera that can be looked at beside its grabs."""

    previews: int = 0

    def preview(self) -> Grab:
        """A picture made as those of the grabs, which does not count as one."""
        self.previews += 1
        other = FakeCamera(self.track, self.size_px, self.colour)
        return other.grab()


@dataclass
class Bench:
    """The fake devices of a session, and the session."""

    drivers: FakeDrivers
    output: Path
    sessions: list[Session] = field(default_factory=list)

    def open(self, frames: int = 5, plan: dict[str, Any] | None = None, **options: Any) -> Session:
        """A session of a rig of so many frames, and of what else its plan says."""
        session = Session(fake_rig(frames, **(plan or {})), self.output, **options)
        self.sessions.append(session)
        return session


@contextmanager
def live_bench(
    monkeypatch: pytest.MonkeyPatch,
    output: Path,
    track: FakeTrack | None = None,
    camera: type[FakeCamera] = FakeCamera,
) -> Iterator[Bench]:
    """Sessions on these devices, closed at the end."""
    moving = track or FakeTrack()
    drivers = FakeDrivers(moving, camera(moving))
    monkeypatch.setattr(lscan.config.rig, "find_plugin", drivers.find_plugin)
    monkeypatch.setattr("lscan.live.session.RETRY_S", 0.02)
    monkeypatch.setattr("lscan.live.session.WAIT_S", 0.02)
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)  # spare the disk
    bench = Bench(drivers, output)
    try:
        yield bench
    finally:
        gate = getattr(moving, "gate", None)
        if gate is not None:
            gate.release(1000)
        for session in bench.sessions:
            session.close()
