"""A Grbl track: one controller and its head over several sessions of a scan."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from grbl_line import DirectLine, SimulatedTime

from lscan.acquisition.run import Run
from lscan.acquisition.scan import acquire_into
from lscan.acquisition.writer import resume_run
from lscan.config.rig import RigFile, parse_rig
from lscan.devices.api import Grab
from lscan.devices.grbl import SerialTrack, SerialTrackOptions, open_track
from sim.emulators.grbl import GrblEmulator

UNHOMED = {20: 0, 22: 0}  # neither soft limits nor homing, so no alarm at power-up
START_MM = -50.0  # of the head at power-up, counted from the switches
STEP_MM = 0.5
STEPPER_MM = 1 / 250  # $100
FRAMES = 8


class Killed(BaseException):
    """In place of SIGKILL."""


class _Line(DirectLine):
    """A line that a killed program no longer writes to."""

    dead = False

    def write(self, data: bytes) -> int:
        if self.dead:
            raise OSError("killed")
        return super().write(data)


@dataclass
class Plant:
    """One controller and its head, over several sessions of a scan; time is simulated."""

    homing: bool = False
    zero_mm: float = 0.0
    approach_mm: float = 1.0
    start_mm: float = 0.0
    step_mm: float = STEP_MM
    feed_mm_min: float = 500.0
    boot_s: float = 3.0
    time: SimulatedTime = field(default_factory=SimulatedTime)
    seen_mm: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        settings = None if self.homing else UNHOMED
        self.emulator = GrblEmulator(settings, (START_MM,) * 3, self.time)

    def open(self, kill_after: int | None = None) -> SerialTrack:
        """The track.  Half a step after the picture of this number the program is killed: nothing
        it sends from then on arrives."""
        options = SerialTrackOptions(
            port="here",
            min_mm=-20.0,
            max_mm=40.0,
            zero_mm=-100.0 if self.homing else self.zero_mm,
            approach_mm=self.approach_mm,
            homing=self.homing,
            feed_mm_min=self.feed_mm_min,
            boot_s=self.boot_s,
        )
        line = _Line(self.emulator, self.time)

        def sleep(seconds: float) -> None:
            self.time.sleep(seconds)
            way_mm = self.emulator.head_mm[0] - self.seen_mm[-1] if self.seen_mm else 0.0
            if len(self.seen_mm) == kill_after and way_mm >= self.step_mm / 2:
                line.dead = True
                raise Killed

        return open_track(options, line, self.time, sleep)

    def scan(
        self,
        path: Path,
        frames: int | None = None,
        kill_after: int | None = None,
        position_restored: bool = False,
    ) -> Run | None:
        """Scan, resuming what there is; stopped after ``frames`` frames of the whole, if given."""
        track, camera = self.open(kill_after), StillCamera(self)
        try:
            with resume_run(path, self.rig_file) as writer:
                return acquire_into(
                    writer,
                    camera,
                    track,
                    stop_after(frames),
                    position_restored=position_restored,
                )
        except (KeyboardInterrupt, Killed):
            return None
        finally:
            track.close()

    @property
    def rig_file(self) -> RigFile:
        document = {
            "camera": {"driver": "fake", "width_px": 20, "height_px": 16},
            "track": {"driver": "grbl"},
            "plan": {"start_mm": self.start_mm, "step_mm": self.step_mm, "frames": FRAMES},
        }
        return parse_rig(document, source="rig.toml", trusted=True)


@dataclass
class StillCamera:
    """Notes where the head truly is for each picture."""

    plant: Plant
    size_px: tuple[int, int] = (20, 16)

    def grab(self, frame: int | None = None, dark: bool = False) -> Grab:
        self.plant.time.sleep(0.04)
        self.plant.seen_mm.append(self.plant.emulator.head_mm[0])
        return Grab(np.zeros((16, 20), np.uint8), self.plant.time(), 20.0)

    def close(self) -> None: ...


def stop_after(frames: int | None) -> Callable[[int, int], None]:
    def progress(done: int, _: int) -> None:
        if done == frames:
            raise KeyboardInterrupt

    return progress


def spacing_is_true(plant: Plant) -> bool:
    """Whether the head was where the plan says at every picture, to a step of the motor."""
    true_mm = np.array(plant.seen_mm) - plant.seen_mm[0]
    planned_mm = plant.step_mm * np.arange(len(true_mm))
    return bool(np.abs(true_mm - planned_mm).max() <= STEPPER_MM + 0.001)
