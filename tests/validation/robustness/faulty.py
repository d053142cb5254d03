"""Webcam, track and disk that fail on command, behind the interfaces of real ones."""

import errno
import math
import os
import resource
import struct
import threading
import time
import zlib
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import astuple, dataclass, replace
from pathlib import Path
from typing import Any
from unittest import mock

import cv2
import numpy as np

from lscan.devices.grbl import SerialTrack, SerialTrackOptions, open_track
from lscan.devices.opencv_camera import OpencvOptions
from lscan.files.disk import packaged_table
from lscan.records import Bytes, Picture
from sim.emulators.grbl import Faults, GrblEmulator
from tests.support.grbl_line import DirectLine, SimulatedTime

# What a test picture carries in its pixels: which exposure it is, when and where it was taken.


_FIELDS = struct.Struct("<Qdd?")
_CHECK = struct.Struct("<I")
LENGTH = _FIELDS.size + _CHECK.size


@dataclass(frozen=True)
class ExposureMark:
    """One exposure.  counter: no two exposures have the same.

    exposed_s: on the machine's monotonic clock.  head_mm: where the head truly stood, counted
    from the switch.  moving: whether it moved.
    """

    counter: int
    exposed_s: float
    head_mm: float
    moving: bool


def draw_mark(image: Bytes, mark: ExposureMark) -> None:
    """Write the mark, with its CRC-32, into the first pixels of the top row.

    image: (H, W, 3) uint8, W at least LENGTH.  All colours get the same bytes, so that it
    does not matter in which order they are kept.
    """
    data = _FIELDS.pack(*astuple(mark))
    data += _CHECK.pack(zlib.crc32(data))
    image[0, :LENGTH] = np.frombuffer(data, np.uint8)[:, None]


def read_mark(image: Picture) -> ExposureMark | None:
    """The mark of a picture; None where it carries none that is whole.

    Parameters
    ----------
    image : (H, W, 3) uint8 array
    """
    if image.ndim != 3 or image.shape[1] < LENGTH:
        return None
    first = image[0, :LENGTH]
    if (first != first[:, :1]).any():
        return None
    data = first[:, 0].tobytes()
    if zlib.crc32(data[: _FIELDS.size]) != _CHECK.unpack(data[_FIELDS.size :])[0]:
        return None
    return ExposureMark(*_FIELDS.unpack(data[: _FIELDS.size]))


# A webcam behind OpenCV's interface that fails on command, and marks what it saw when.


_BENCH = packaged_table("tests.validation.robustness", "bench.toml")
_CAMERA = _BENCH["camera"]
WIDTH_PX, HEIGHT_PX = _CAMERA["width_px"], _CAMERA["height_px"]
PERIOD_S = 0.001
UNDER_WAY = 1
"""Pictures exposed but not delivered at any time, as in the buffers of a webcam."""

Look = Callable[[], tuple[float, bool]]


class FaultyCamera:
    """The camera itself, which outlives the captures opened on it.

    look: the head's true position, mm, and whether it moves.  stamped: each picture says
    when it was exposed (POS_MSEC), on the machine's monotonic clock.
    """

    def __init__(self, look: Look, seed: int, stamped: bool) -> None:
        self._look, self._generator = look, np.random.default_rng(seed)
        self.stamped = stamped
        self.stamp_offset_s = 0.0
        self._lock = threading.Lock()
        self._counter = 0
        self._kind, self._left, self._garbage = "", 0.0, 0
        self.freed = threading.Event()
        self.asked = threading.Event()
        self.under_way: deque[tuple[Bytes, float]] = deque()
        self.last: Bytes | None = None

    # ---- the world's side ---------------------------------------------------------------

    def inject(self, kind: str, strength: float) -> None:
        """Let a fault begin.

        camera late: ``strength`` pictures are held back until the next grab.  camera clock set:
        the stamps go by ``strength`` seconds wrong.  garbage: which garbage it is.  All others:
        for how many readings the fault lasts, infinite where it stays.
        """
        if kind == "camera late":
            self.asked.clear()
            self.under_way.extend(self.expose() for _ in range(int(strength)))
        elif kind == "camera clock set":
            self.stamp_offset_s = strength
        elif kind == "camera garbage":
            self._kind, self._left, self._garbage = kind, math.inf, int(strength)
        else:
            self._kind, self._left = kind, strength

    def clear(self) -> None:
        """End every fault; readings that hang come back."""
        self._kind, self._left, self.stamp_offset_s = "", 0.0, 0.0
        self.asked.set()
        self.freed.set()

    def grab_begins(self) -> None:
        """Let go of the pictures that were held back."""
        self.asked.set()

    # ---- the captures' side -------------------------------------------------------------

    def open(self, options: OpencvOptions) -> "FaultyCapture":
        """A capture; it does not open while the camera is gone."""
        away = self.due_fault("camera gone")
        self.under_way.clear()
        self.freed.clear()
        self.asked.set()
        return FaultyCapture(self, away)

    def due_fault(self, *kinds: str) -> str:
        """The fault of this reading, if it is one of ``kinds`` (of any, if none are named)."""
        if self._left <= 0 or (kinds and self._kind not in kinds):
            return ""
        self._left -= 1
        return self._kind

    def expose(self) -> tuple[Bytes, float]:
        """A marked picture (H, W, 3) uint8 of noise, and when it was exposed, s."""
        with self._lock:
            self._counter += 1
            head_mm, moving = self._look()
            mark = ExposureMark(self._counter, time.monotonic(), head_mm, moving)
            shape = (HEIGHT_PX, WIDTH_PX, 3)
            image = self._generator.integers(30, 60, shape, dtype=np.uint8)
        draw_mark(image, mark)
        return image, mark.exposed_s

    def corrupted(self, image: Bytes, kind: str) -> Any:
        """What the fault makes of a picture."""
        if kind == "camera black":
            return np.zeros_like(image)
        if kind == "camera wrong size":
            return image[: HEIGHT_PX // 2]
        if kind == "camera same twice" and self.last is not None:
            return self.last.copy()
        if kind == "camera garbage":
            return GARBAGE[self._garbage](image)
        return image


GARBAGE: tuple[Callable[[Bytes], Any], ...] = (
    lambda image: image.astype(np.uint16),
    lambda image: np.full(image.shape, math.nan),
    lambda image: np.dstack([image, image[:, :, :1]]),
    lambda image: image[:, :, :2],
    lambda image: image.ravel(),
    lambda image: image[:0],
    lambda image: image[None],
    lambda image: "no picture",
    lambda image: [[1, 2], [3, 4]],
    lambda image: image[:, :, 0].copy(),
)
"""What is no picture of the rig; the last, a grey one, only after pictures in colour."""


class FaultyCapture:
    """One opening of the camera; answers as ``cv2.VideoCapture`` on Video4Linux does."""

    def __init__(self, camera: FaultyCamera, away: str) -> None:
        self._camera, self._away = camera, bool(away)
        self._stamp_s = 0.0
        self._properties: dict[int, float] = {}

    def isOpened(self) -> bool:  # noqa: N802 - OpenCV's name
        """Whether the camera is there."""
        return not self._away

    def getBackendName(self) -> str:  # noqa: N802 - OpenCV's name
        """Linux's."""
        return "V4L2"

    def set(self, property_id: int, value: float, /) -> bool:
        """Obey."""
        self._properties[property_id] = value
        return True

    def get(self, property_id: int, /) -> float:
        """What was set, or the last picture's time stamp."""
        if property_id == cv2.CAP_PROP_POS_MSEC:
            return 1000 * self._stamp_s
        return self._properties.get(property_id, -1)

    def release(self) -> None:
        """Nothing is held."""

    def read(self) -> tuple[bool, Any]:
        """The next picture, or what a fault makes of it."""
        camera = self._camera
        camera.asked.wait(60)
        if len(camera.under_way) <= UNDER_WAY:  # else what was held back comes in one burst
            time.sleep(PERIOD_S)
        fault = camera.due_fault()
        if fault == "camera hung":
            camera.freed.wait(60)
        if fault in ("camera hung", "camera gone"):
            return False, None
        if fault == "camera breaks":
            raise cv2.error("the driver broke\n in two lines")
        while len(camera.under_way) <= UNDER_WAY:
            camera.under_way.append(camera.expose())
        image, exposed_s = camera.under_way.popleft()
        self._stamp_s = exposed_s + camera.stamp_offset_s if camera.stamped else 0.0
        seen = camera.corrupted(image, fault)
        camera.last = seen if fault == "camera same twice" else image
        return True, seen


# A Grbl track in simulated time, whose controller or line fails on command.


ZERO_MM: float = _BENCH["track"]["options"]["zero_mm"]
"""Where, counted from the switch, the track's position is 0."""

_FAULTS = packaged_table("tests.validation.robustness", "faults.toml")
FAULTS = {kind: Faults(**fields) for kind, fields in _FAULTS["track"].items()}


class TimeWithBell(SimulatedTime):
    """Simulated time in which something can be made to happen at a set moment."""

    def __init__(self) -> None:
        super().__init__()
        self._when_s, self._action = float("inf"), lambda: None

    def at(self, when_s: float, action: Callable[[], None]) -> None:
        """Let ``action`` happen once, when the time comes to ``when_s``."""
        self._when_s, self._action = when_s, action

    def sleep(self, seconds: float) -> None:
        """Let ``seconds`` pass at once, and what is due in them happen in its moment."""
        end_s = self.now_s + seconds
        if self._when_s <= end_s:
            self.now_s, self._when_s = max(self.now_s, self._when_s), float("inf")
            self._action()
        self.now_s = end_s


class FaultyTrack:
    """The machine and its line, which outlive the tracks opened on them."""

    def __init__(self) -> None:
        self.time = TimeWithBell()
        self._emulator = GrblEmulator({25: 5000}, clock=self.time)
        self._kind = ""

    def open(self, options: SerialTrackOptions) -> SerialTrack:
        """The track as lscan's own driver opens it."""
        line = DirectLine(self._emulator, self.time)
        return open_track(options, line, self.time, self.time.sleep)

    def look(self) -> tuple[float, bool]:
        """The head's true position on the track, mm, and whether it moves."""
        before_mm = self._emulator.head_mm[0]
        return before_mm - ZERO_MM, self._emulator.state not in ("Idle", "Alarm")

    def inject(self, kind: str, strength: float) -> None:
        """Let a fault begin now; strength: of the noise, or how many ok are lost."""
        self._kind, fault = kind, FAULTS[kind]
        if fault.garble:
            fault = replace(fault, garble=strength, seed=int(1e9 * strength))
        if fault.lose_oks:
            fault = replace(fault, lose_oks=int(strength))
        self._emulator.inject(replace(fault, begin_s=self.time()))

    def clear(self) -> None:
        """End the fault; a controller whose cable was pulled has lost its power too."""
        self._emulator.inject(Faults())
        if self._kind == "serial unplugged":
            self._emulator.power_cycle()


# The system calls that write a run folder, made to fail on command.


WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC
CALLS_A_FRAME = 8
"""open, write, fsync, rename, open and fsync of the folder; write and fsync of the row."""

REFUSED = _FAULTS["disk"]
"""Kind of fault to the name of the error and the calls it refuses."""

PARTLY = frozenset({"disk full", "disk error", "disk pulled"})
"""Faults under which the write they hit still writes its first bytes."""


class FaultyDisk:
    """What lies beneath one run folder.

    on_call: called before each watched system call, with its number.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._aside = folder.with_name(f"{folder.name}.gone")
        self.on_call: Callable[[], None] = lambda: None
        self._descriptors: set[int] = set()
        self._kind, self._part = "", 0.0
        self._limits = resource.getrlimit(resource.RLIMIT_FSIZE)

    def inject(self, kind: str, strength: float) -> None:
        """Let a fault begin; strength, 0 to 1: which part of the first write still succeeds.

        folder vanished: it is renamed.  file size limit: the kernel's own, at ``strength``
        times 8 kB; a real refusal of the system, as of a full disk.
        """
        self._kind, self._part = kind, strength
        if kind == "folder vanished":
            with suppress(FileNotFoundError):
                self._folder.rename(self._aside)
        elif kind == "file size limit":
            resource.setrlimit(resource.RLIMIT_FSIZE, (int(8000 * strength), self._limits[1]))

    def clear(self) -> None:
        """End the fault."""
        self._kind = ""
        resource.setrlimit(resource.RLIMIT_FSIZE, self._limits)
        if self._aside.exists():
            self._aside.rename(self._folder)

    @contextmanager
    def watched(self) -> Iterator[None]:
        """Within the block the system calls on this folder go through this object."""
        calls = dict.fromkeys(("write", "fsync", "ftruncate", "close"), self._on_descriptor)
        calls |= dict.fromkeys(("open", "replace", "mkdir", "unlink"), self._on_path)
        with ExitStack() as patches:
            for name, watching in calls.items():
                call = watching(name, getattr(os, name))
                patches.enter_context(mock.patch.object(os, name, call))
            yield

    def _on_descriptor(self, name: str, real: Callable[..., Any]) -> Callable[..., Any]:
        def call(descriptor: int, *args: Any) -> Any:
            if descriptor not in self._descriptors:
                return real(descriptor, *args)
            if name == "close":
                self._descriptors.discard(descriptor)
                return real(descriptor)
            self.on_call()
            if name == "write" and self._kind in PARTLY and self._part > 0:
                first = bytes(args[0])[: int(self._part * len(args[0]))]
                self._part = 0.0
                if first:
                    return real(descriptor, first)
            self._refuse(name)
            return real(descriptor, *args)

        return call

    def _on_path(self, name: str, real: Callable[..., Any]) -> Callable[..., Any]:
        def call(path: Any, *args: Any, **kwargs: Any) -> Any:
            if not isinstance(path, str | Path) or not self._is_ours(Path(path)):
                return real(path, *args, **kwargs)
            self.on_call()
            if name != "open" or (args and args[0] & WRITING):
                self._refuse(name)
            result = real(path, *args, **kwargs)
            if name == "open":
                self._descriptors.add(result)
            return result

        return call

    def _is_ours(self, path: Path) -> bool:
        return path == self._folder or self._folder in path.parents

    def _refuse(self, name: str) -> None:
        refused = REFUSED.get(self._kind)
        if refused is not None and name in refused["calls"]:
            number = getattr(errno, refused["error"])
            raise OSError(number, os.strerror(number))
