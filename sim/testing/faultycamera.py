"""A webcam behind OpenCV's interface that fails on command, and marks what it saw when."""

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

from lscan.devices.opencv_camera import OpencvOptions
from lscan.files.disk import packaged_table
from lscan.records import Bytes
from sim.testing.marks import ExposureMark, draw_mark

_CAMERA = packaged_table("sim.testing", "bench.toml")["camera"]
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
