"""A rig on the bench: real drivers on faulty devices, and a fault injected at its moment."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Final
from unittest import mock

import lscan.acquisition.scan
import lscan.config.rig
from lscan.acquisition.run import Run
from lscan.config.rig import RigFile, parse_rig
from lscan.devices.api import Camera, Grab, Track
from lscan.devices.grbl import SerialTrack, track_driver as serial_driver
from lscan.devices.opencv_camera import OpencvCamera, OpencvOptions
from lscan.files.disk import packaged_table
from sim.testing.faults import KINDS, InjectedFault
from sim.testing.faultycamera import FaultyCamera
from sim.testing.faultydisk import FaultyDisk
from sim.testing.faultytrack import FaultyTrack

RIG: Final = packaged_table("sim.testing", "bench.toml")
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
