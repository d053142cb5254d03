"""What acquisition costs beyond camera and track: checks, PNG, checksums and syncs.

A camera and a track that cost nothing stand in for real ones; their pictures come from the
tank's sensor beforehand, with all its noise, which is what a PNG encoder has to work on.  The
cost is counted in plain savings of the same pictures, one beside each frame: what else the
machine does, and how fast it is, is in both.
"""

import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np

from lscan.acquisition.scan import acquire_into
from lscan.acquisition.writer import create_run
from lscan.config.rig import parse_rig
from lscan.devices.api import Grab
from lscan.records import Floats, Picture
from sim.render.tank import Tank
from sim.scene import load_scene
from sim.sensor import Webcam
from tests.validation.rows import Row, row

SEED = 51
PICTURES = 8  # that take turns

Clock = Callable[[], float]


@dataclass
class FreeDevices:
    """A camera and a track that cost nothing, and a stopwatch that rests while they are at work.

    pictures: those of the camera, all (H, W, 3) RGB, taken beforehand.  aside: called with each
    picture while the stopwatch rests.  frames_s: for each frame, the time from its move until
    the next, or until ``pause``, less what the devices took of it.
    """

    pictures: list[Picture]
    aside: Callable[[Picture], None]
    clock: Clock
    position_mm: float = 0.0
    frames_s: list[float] = field(default_factory=list)
    _since_s: float = 0.0

    @property
    def size_px(self) -> tuple[int, int]:
        """(width, height) of every picture."""
        height, width = self.pictures[0].shape[:2]
        return width, height

    def move_to(self, position_mm: float) -> float:
        """The position asked for, mm; what ran until now belongs to the frame before."""
        if self.frames_s:
            self.pause()
        self.frames_s.append(0.0)
        self.position_mm = position_mm
        self._since_s = self.clock()
        return position_mm

    def grab(self, frame: int | None = None, dark: bool = False) -> Grab:
        """The picture whose turn it is."""
        self.pause()
        number = frame or 0
        picture = self.pictures[number % len(self.pictures)]
        self.aside(picture)
        self._since_s = self.clock()
        return Grab(picture, float(number), 20.0)

    def pause(self) -> None:
        """Stop the clock: a device is called, or the scan has ended."""
        self.frames_s[-1] += self.clock() - self._since_s

    def close(self) -> None:
        """Nothing is held."""


@dataclass
class PlainSaver:
    """Saves pictures (H, W, 3) as a script would: OpenCV's own PNG, and a sync.

    path: the file, written anew each time.  saved_s: the time that each saving took, s.
    """

    path: Path
    clock: Clock = time.perf_counter
    saved_s: list[float] = field(default_factory=list)

    def __call__(self, picture: Picture) -> None:
        began_s = self.clock()
        _, data = cv2.imencode(".png", picture)
        with self.path.open("wb") as file:
            file.write(data.tobytes())
            file.flush()
            os.fsync(file.fileno())
        self.saved_s.append(self.clock() - began_s)


def overhead_rows(frames: int, folder: Path, scene: Path) -> list[Row]:
    """The overhead of one frame of 640 by 480 px in colour, over saving its picture plainly.

    frames: how many are scanned.  folder: on the disk that runs are written to; a memory file
    system would sync for nothing.  scene: whose sensor takes the pictures.
    Median over median, and mean over mean: the mean times the number of frames is what a scan
    takes longer; a disk that now and then hesitates shows in it, and not in the median.
    """
    pictures = noisy_pictures(scene)
    with TemporaryDirectory(dir=folder, prefix=".overhead-") as scratch:
        saver = PlainSaver(Path(scratch) / "plain.png")
        taken_s = frame_times(Path(scratch) / "run", pictures, frames, aside=saver)
    rows = []
    for name, average in (("median", np.median), ("mean", np.mean)):
        taken, saved = (1000 * float(average(times)) for times in (taken_s, saver.saved_s))
        words: dict[str, Any] = {"seed": SEED, "frames": frames, "name": name}
        rows.append(row("overhead", taken / saved, taken_ms=taken, saved_ms=saved, **words))
    return rows


def noisy_pictures(scene: Path, count: int = PICTURES) -> list[Picture]:
    """Pictures (H, W, 3) RGB uint8 of one view of the tank, each with noise of its own."""
    loaded = load_scene(scene)
    layers, webcam = Tank(loaded).render(loaded.rig.plan.start_mm), Webcam(loaded)
    generator = np.random.default_rng(SEED)
    exposure_ms = loaded.rig.camera.exposure_ms
    return [webcam.expose(layers, exposure_ms, generator) for _ in range(count)]


def frame_times(
    path: Path,
    pictures: list[Picture],
    frames: int,
    clock: Clock = time.perf_counter,
    aside: Callable[[Picture], None] = lambda picture: None,
) -> Floats:
    """(frames,) what acquisition itself took for each frame, s, scanning into the folder ``path``.

    aside: called with each picture, the time it takes left out.
    """
    devices = FreeDevices(pictures, aside, clock)
    width, height = devices.size_px
    document = {
        "camera": {"driver": "free", "width_px": width, "height_px": height},
        "track": {"driver": "free"},
        "plan": {"frames": frames},
    }
    with create_run(path, parse_rig(document, source="overhead", trusted=True)) as writer:
        acquire_into(writer, devices, devices)
        devices.pause()
    return np.array(devices.frames_s)
