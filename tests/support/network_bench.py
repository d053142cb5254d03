"""A scan in laser pairs by an emulated controller, in real time, over TCP or a serial port."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import serial.urlhandler.protocol_socket as pyserial_tcp

from lscan.acquisition.run import Run
from lscan.acquisition.scan import acquire_into
from lscan.acquisition.writer import resume_run
from lscan.config.rig import RigFile, parse_rig
from lscan.devices.api import Grab
from lscan.devices.grbl import SerialTrack, SerialTrackOptions, open_track
from sim.emulators.grbl import GrblEmulator, MarlinEmulator, PseudoTerminal, TcpPort

QUICK = dict.fromkeys((25, 110, 111, 112), 50_000) | dict.fromkeys((120, 121, 122), 20_000)
STEP_MM = 0.1
HOME_MM = -1.0
"""Where homing leaves the head, counted from the switches."""


@pytest.fixture
def no_pause_on_closing(monkeypatch: pytest.MonkeyPatch) -> None:
    """pyserial rests 0.3 s whenever it closes a TCP connection."""
    monkeypatch.setattr(pyserial_tcp, "time", SimpleNamespace(sleep=lambda seconds: None))


@dataclass
class NetworkBench:
    """A controller, its line, and what the camera saw.

    before_grab: by number of pictures taken, what happens then.  asleep: called while the track
    waits.  seen: frame, true place of the head and laser power at each picture.
    """

    controller: GrblEmulator | MarlinEmulator
    line: TcpPort | PseudoTerminal
    frames: int
    laser: str = "pairs"
    feed_mm_min: float = 50_000
    dtr: bool = True
    answer_s: float = 60.0
    reconnects: int = 5
    before_grab: dict[int, Callable[[], None]] = field(default_factory=dict)
    asleep: Callable[[], None] = lambda: None
    seen: list[tuple[int | None, float, float]] = field(default_factory=list)
    size_px = (20, 16)

    @property
    def marlin(self) -> bool:
        """Whether Marlin runs, which is homed here; the others count from where they started."""
        return isinstance(self.controller, MarlinEmulator)

    def options(self) -> SerialTrackOptions:
        """The track's."""
        zero_mm = HOME_MM - 60.0 if self.marlin else 0.0
        return SerialTrackOptions(
            port=self.line.port,
            dtr=self.dtr,
            dialect="marlin" if self.marlin else "grbl",
            min_mm=-5.0, max_mm=45.0, zero_mm=zero_mm, homing=self.marlin,
            feed_mm_min=self.feed_mm_min, settle_s=0.0, boot_s=0.05, answer_s=self.answer_s,
            reconnects=self.reconnects, reconnect_wait_s=0.0,
        )  # fmt: skip

    def open(self) -> SerialTrack:
        """The track; it does not sleep, but lets ``asleep`` happen."""
        return open_track(self.options(), sleep=lambda seconds: self.asleep())

    @property
    def rig_file(self) -> RigFile:
        """Its plan's positions begin at 0."""
        document = {
            "camera": {"driver": "fake", "width_px": 20, "height_px": 16},
            "track": {"driver": "grbl"},
            "plan": {"step_mm": STEP_MM, "frames": self.frames, "laser": self.laser},
        }
        return parse_rig(document, source="rig.toml", trusted=True)

    def scan(self, path: Path, **how: bool) -> Run:
        """Begin the scan, or go on with it; what ends it is raised."""
        track = self.open()
        try:
            with resume_run(path, self.rig_file) as writer:
                return acquire_into(writer, self, track, **how)
        finally:
            track.close()

    def grab(self, frame: int | None = None, dark: bool = False) -> Grab:
        """A picture as bright as the laser is lit."""
        power = self.controller.laser_power
        self.seen.append((frame, self.controller.head_mm[0], power))
        self.before_grab.get(len(self.seen), lambda: None)()
        picture = np.full((16, 20), 200 if power > 0 else 3, np.uint8)
        return Grab(picture, time.monotonic(), 20.0)

    def close(self) -> None:
        """A camera's."""

    def require_true(self, run: Run) -> None:
        """Fail unless each frame was recorded once, in place, lit, with a dark background."""
        run.verify()
        assert (run.state, len(run)) == ("complete", self.frames)
        lit = {frame: place_mm for frame, place_mm, power in self.seen if power > 0}
        dark = {frame: place_mm for frame, place_mm, power in self.seen if power == 0}
        assert [*lit] == [*dark] == [*range(self.frames)]
        true_mm = np.array([*lit.values()])
        np.testing.assert_array_equal([*dark.values()], true_mm)
        planned_mm = STEP_MM * np.arange(self.frames)
        # A step of the motor, 4 µm, and half of the last decimal, of two with Marlin, each way.
        np.testing.assert_allclose(true_mm - true_mm[0], planned_mm, rtol=0, atol=0.004 + 0.01)
        for index in (0, self.frames - 1):
            frame = run.frame(index)
            assert frame.background is not None
            assert (frame.image.min(), frame.background.max()) == (200, 3)
        assert self.controller.laser_power == 0
