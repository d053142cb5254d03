"""A capture in place of OpenCV's, whose faults are written into its plan."""

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np

from lscan.devices.opencv_camera import OpencvOptions
from lscan.records import Bytes

WIDTH_PX, HEIGHT_PX = 20, 16
MARK = slice(0, 4)
"""Rows and columns of the mark whose red says which scene was seen, and whose blue is 200."""

Fault = str
"""hang, gone, raise, empty, black, wrong size, same or deep."""


@dataclass
class World:
    """What cameras see, and what befalls them; shared by all captures opened in it.

    scene: what a picture exposed now shows.  faults: by number of the read, from 0 on.
    delay: pictures that are under way in the camera.  closes: times after the first opening
    that it cannot be opened.  stamps: it reports when it took a picture, else only 0; stamp: what
    its clock makes of that time.
    obeys: what a setting becomes; by default what was asked.  bits: of a grey value, from 10 on in
    the lower of 16 where nothing is converted.
    """

    scene: int = 1
    faults: dict[int, Fault] = field(default_factory=dict)
    period_s: float = 0.0005
    delay: int = 1
    closes: int = 0
    stamps: bool = False
    stamp: Callable[[float], float] = lambda exposed_s: exposed_s
    grey: bool = False
    bits: int = 8
    obeys: Callable[[int, float], float] = lambda _, value: value
    last: Bytes | None = None
    reads: int = 0
    opened: int = 0
    released: int = 0
    free: threading.Event = field(default_factory=threading.Event)
    generator: np.random.Generator = field(default_factory=lambda: np.random.default_rng(5))

    def open(self, options: OpencvOptions) -> "FakeCapture":
        """A capture; not opened while the device is away."""
        self.opened += 1
        return FakeCapture(self, away=1 < self.opened <= 1 + self.closes)


class FakeCapture:
    """Answers as ``cv2.VideoCapture`` on Video4Linux does."""

    def __init__(self, world: World, away: bool = False) -> None:
        self._world, self._away = world, away
        opened_s = time.monotonic()
        earlier_s = (opened_s - world.period_s * ago for ago in range(world.delay, 0, -1))
        self._under_way = deque((world.scene, exposed_s) for exposed_s in earlier_s)
        self._stamp_s = 0.0
        self._properties: dict[int, float] = {}

    def isOpened(self) -> bool:  # noqa: N802
        return not self._away

    def getBackendName(self) -> str:  # noqa: N802
        return "V4L2"

    def set(self, property_id: int, value: float) -> bool:
        self._properties[property_id] = self._world.obeys(property_id, value)
        return True

    def get(self, property_id: int) -> float:
        if property_id == cv2.CAP_PROP_POS_MSEC:
            return 1000 * self._stamp_s
        return self._properties.get(property_id, -1)

    def release(self) -> None:
        self._world.released += 1

    def read(self) -> tuple[bool, Any]:
        world = self._world
        time.sleep(world.period_s)
        fault = world.faults.get(world.reads)
        world.reads += 1
        if fault == "hang":
            world.free.wait(300)
            return False, None
        if fault == "gone":
            return False, None
        if fault == "empty":
            return True, None
        if fault == "raise":
            raise cv2.error("the driver broke\n in two lines")
        if fault == "same" and world.last is not None:
            return True, world.last
        world.last = _spoilt(self._deep(self._picture()), fault)
        return True, world.last

    def _picture(self) -> Bytes:
        now_s = time.monotonic()  # before the scene is looked at: a stamp is never too late
        self._under_way.append((self._world.scene, now_s))
        scene, exposed_s = self._under_way.popleft()
        self._stamp_s = world.stamp(exposed_s) if (world := self._world).stamps else 0.0
        shape = (HEIGHT_PX, WIDTH_PX) if self._world.grey else (HEIGHT_PX, WIDTH_PX, 3)
        image = self._world.generator.integers(30, 60, shape, dtype=np.uint8)
        image[MARK, MARK] = scene if self._world.grey else (200, 100, scene)
        return image

    def _deep(self, image: Bytes) -> Any:
        """The picture with noise in the bits beneath, as Video4Linux hands Y12 out unconverted."""
        bits = self._world.bits
        if bits == 8 or self._properties.get(cv2.CAP_PROP_CONVERT_RGB, 1):
            return image
        fine = self._world.generator.integers(0, 2 ** (bits - 8), image.shape, dtype=np.uint16)
        return image * np.uint16(2 ** (bits - 8)) + fine


def _spoilt(image: Bytes, fault: Fault | None) -> Any:
    if fault == "black":
        return np.zeros_like(image)
    if fault == "wrong size":
        return image[: HEIGHT_PX - 2]
    if fault == "deep":
        return image.astype(np.uint16)
    return image


def scene_of(image: Bytes) -> int:
    """Which scene an RGB picture shows; the mark's other colours must be where they belong."""
    mark = image[MARK, MARK].reshape(-1, 3)
    assert (mark[:, 1:] == (100, 200)).all()
    assert (mark[:, 0] == mark[0, 0]).all()
    return int(mark[0, 0])
