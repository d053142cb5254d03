"""Which faults there are, when they occur, and a bench of real drivers to inject them into."""

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Final, Literal, get_args
from unittest import mock

import numpy as np

import lscan.acquisition.scan
import lscan.config.rig
from lscan.acquisition.run import Run
from lscan.config.rig import RigFile, parse_rig
from lscan.devices.api import Camera, Grab, Track
from lscan.devices.grbl import SerialTrack, track_driver as serial_driver
from lscan.devices.opencv_camera import OpencvCamera, OpencvOptions
from lscan.files.disk import packaged_table
from tests.validation.robustness.faulty import (
    CALLS_A_FRAME,
    GARBAGE,
    FaultyCamera,
    FaultyDisk,
    FaultyTrack,
)

# Which faults there are, at which moments they occur, and how one is drawn.

RIG: Final = packaged_table("tests.validation.robustness", "bench.toml")
FRAMES: Final[int] = RIG["plan"]["frames"]
"""Frames of each experiment's scan."""

Device = Literal["camera", "track", "disk", "clock"]
Phase = Literal["opening", "before the move", "in mid-move", "before the grab", "in the write"]
PHASES: Final[tuple[Phase, ...]] = get_args(Phase)


@dataclass(frozen=True)
class FaultKind:
    """A kind of fault.

    says: what an error it leads to must say of what to do, as a regular expression; "" where
    it must not lead to an error.
    """

    device: Device
    says: str


_TABLE = packaged_table("tests.validation.robustness", "faults.toml")
KINDS: Final[Mapping[str, FaultKind]] = {
    kind: FaultKind(**fields) for kind, fields in _TABLE["kinds"].items()
}


@dataclass(frozen=True)
class InjectedFault:
    """One fault.

    Attributes
    ----------
    kind : str, a key of KINDS
    frame : int, in whose turn it occurs
    phase : Phase, when within that turn
    part : float, where within the phase, 0 to 1 of the way, or of the system calls that write the
        frame
    strength : float, as the device's ``inject`` takes it
    stamped : bool, whether the camera stamps its pictures with their time
    """

    kind: str
    frame: int
    phase: Phase
    part: float
    strength: float
    stamped: bool

    @property
    def call(self) -> int:
        """Number of the system call of the frame's write at which it occurs."""
        return int(self.part * CALLS_A_FRAME)


def draw_fault(kind: str, generator: np.random.Generator) -> InjectedFault:
    """A fault of a kind, its moment and its strength drawn.

    Parameters
    ----------
    kind : str, a key of KINDS
    generator : Generator, all is drawn from it
    """
    device = KINDS[kind].device
    phase: Phase = PHASES[int(generator.integers(len(PHASES)))]
    if kind == "folder vanished" and phase == "opening":  # there is none yet
        phase = "before the move"
    if device == "disk" and generator.random() < 0.5:
        phase = "in the write"
    # A fault of the devices after the last picture's move has no effect any more.
    last = FRAMES if device == "disk" or phase == "before the move" else FRAMES - 1
    stamped = bool(generator.integers(2)) or kind == "camera clock set"
    return InjectedFault(
        kind=kind,
        frame=0 if phase == "opening" else int(generator.integers(last)),
        phase=phase,
        part=float(generator.random()),
        strength=_strength(kind, phase, stamped, generator),
        stamped=stamped,
    )


def _strength(kind: str, phase: Phase, stamped: bool, generator: np.random.Generator) -> float:
    """How strong: see ``inject`` of the device."""
    device = KINDS[kind].device
    if kind in ("serial garbled", "serial noisy"):
        low, high = (-1.0, -0.3) if kind == "serial garbled" else (-4.0, -1.0)
        return float(10 ** generator.uniform(low, high))
    if kind == "lost ok":
        return float(generator.integers(1, 4))
    if kind == "camera late":
        # Without time stamps lateness is known only by counting: flush_frames is 2, and one
        # picture is always under way.
        return float(generator.integers(1, 21)) if stamped else 1.0
    if kind in ("camera clock set", "wall clock set"):
        sign = -1.0 if kind == "wall clock set" or generator.random() < 0.75 else 1.0
        return sign * float(10 ** generator.uniform(-2, 3))
    if kind == "camera garbage":
        # A camera that is grey from the start has no fault.
        return float(generator.integers(len(GARBAGE) - (phase == "opening")))
    if device == "camera":
        return math.inf if generator.random() < 0.6 else float(generator.integers(1, 6))
    return float(generator.random())


# A rig on the bench: real drivers on faulty devices, and a fault injected at its moment.


SPEED_MM_S: Final = RIG["track"]["options"]["feed_mm_min"] / 60

PATIENCE_S: Final = {"camera hung": 0.15, "camera clock set": 0.5}
"""Time-out under faults that wait for it; how each ends is the same however long it is.  A clock
set wrong by less is tolerated, so there it must be long for a picture on a busy machine."""


@dataclass
class FaultBench:
    """The devices of one experiment and its fault.

    Attributes
    ----------
    fault : InjectedFault, the fault, its moment and its strength
    folder : Path, of the run
    seed : int, of what the devices draw
    reported : int, frames reported as done so far
    asked_s : dict, frame to when its last grab began, s, on the monotonic clock
    injected : bool, whether the fault's moment came
    """

    fault: InjectedFault
    folder: Path
    seed: int
    reported: int = 0
    injected: bool = False
    asked_s: dict[int, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.rig_file: RigFile = parse_rig(RIG, source="bench.toml", trusted=True)
        self.track = FaultyTrack()
        self.camera = FaultyCamera(self.track.look, self.seed, self.fault.stamped)
        self.disk = FaultyDisk(self.folder)
        self.disk.on_call = self._disk_called
        self._calls: int | None = None
        self._over = False
        self._clock_offset_s = 0.0

    def scan(self) -> Run:
        """The complete run, begun or resumed as by ``lscan scan``; errors as there."""
        with (
            mock.patch.object(lscan.config.rig, "find_plugin", self._driver),
            mock.patch.object(time, "time", self._wall_clock(time.time)),
            mock.patch.object(SerialTrack, "move_to", self._watched_move(SerialTrack.move_to)),
            mock.patch.object(OpencvCamera, "grab", self._watched_grab(OpencvCamera.grab)),
            self.disk.watched(),
        ):
            if self.fault.phase == "opening":
                self._inject()
            return lscan.acquisition.scan.scan(
                self.rig_file, self.folder, resume=self._over, progress=self._report
            )

    def clear(self) -> None:
        """End the fault; from now on scans are resumed, and no fault occurs any more."""
        self._over = self.injected = True
        self._clock_offset_s = 0.0
        self.camera.clear()
        self.track.clear()
        self.disk.clear()

    # ---- moments ------------------------------------------------------------------------

    def _move_begins(self, target_mm: float, from_mm: float) -> None:
        """The track is about to be sent to ``target_mm``, mm, from where it stands."""
        self._calls = None
        if self._is_turn(self._frame_at(target_mm), "before the move"):
            self._inject()
        if self._is_turn(self._frame_at(target_mm), "in mid-move"):
            way_s = abs(target_mm - from_mm) / SPEED_MM_S
            self.track.time.at(self.track.time() + self.fault.part * way_s, self._inject)

    def _watched_move(self, real: Callable[[SerialTrack, float], float]) -> Callable[..., float]:
        def move_to(track: SerialTrack, position_mm: float) -> float:
            self._move_begins(position_mm, track.position_mm)
            return real(track, position_mm)

        return move_to

    def _watched_grab(self, real: Callable[..., Grab]) -> Callable[..., Grab]:
        def grab(camera: OpencvCamera, frame: int, dark: bool = False) -> Grab:
            if self._is_turn(frame, "before the grab"):
                self._inject()
            self.asked_s[frame] = time.monotonic()
            self.camera.grab_begins()
            taken = real(camera, frame, dark)
            if self._is_turn(frame, "in the write"):  # what is written from now on is this frame
                self._calls = 0
            return taken

        return grab

    def _disk_called(self) -> None:
        if self._calls is not None:
            if self._calls == self.fault.call:
                self._inject()
            self._calls += 1

    def _is_turn(self, frame: int, phase: str) -> bool:
        return not self.injected and (frame, phase) == (self.fault.frame, self.fault.phase)

    def _frame_at(self, target_mm: float) -> int:
        plan = self.rig_file.rig.plan
        return round((target_mm - plan.start_mm) / plan.step_mm)

    def _inject(self) -> None:
        if self.injected:
            return
        self.injected = True
        kind, strength = self.fault.kind, self.fault.strength
        inject: dict[str, Callable[[str, float], None]] = {
            "camera": self.camera.inject,
            "track": self.track.inject,
            "disk": self.disk.inject,
            "clock": self._set_clock,
        }
        inject[KINDS[kind].device](kind, strength)

    def _set_clock(self, _: str, offset_s: float) -> None:
        self._clock_offset_s = offset_s

    # ---- what the scan gets -------------------------------------------------------------

    def _report(self, done: int, planned: int) -> None:
        self.reported = max(self.reported, done)

    def _driver(self, group: str, name: str, where: object = None) -> SimpleNamespace:
        opening = self._open_track if group == "lscan.tracks" else self._open_camera
        return SimpleNamespace(open=opening)

    def _open_track(self, rig_file: RigFile) -> Track:
        return self.track.open(serial_driver.options(rig_file))

    def _open_camera(self, rig_file: RigFile, track: Track) -> Camera:
        return OpencvCamera(rig_file.rig.camera, self._camera_options(), self.camera.open)

    def _camera_options(self) -> OpencvOptions:
        """The rig's, with less patience for faults that would only be waited for."""
        options = OpencvOptions(**self.rig_file.rig.camera.options)
        if self.fault.kind in PATIENCE_S and not self._over:
            return options.model_copy(update={"timeout_s": PATIENCE_S[self.fault.kind]})
        return options

    def _wall_clock(self, real: Callable[[], float]) -> Callable[[], float]:
        return lambda: real() + self._clock_offset_s
