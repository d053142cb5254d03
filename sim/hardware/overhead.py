"""What acquisition costs beyond camera and track: checks, PNG, checksums and syncs.

A camera and a track that cost nothing stand in for real ones; their pictures come from the
tank's sensor beforehand, with all its noise, which is what a PNG encoder has to work on.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from lscan.acquire import acquire_into
from lscan.devices.api import Grab
from lscan.records import Bytes, Floats
from lscan.rig import RigFile, parse_rig
from lscan.runwriter import create_run
from sim.scene import load_scene
from sim.sensor import Webcam
from sim.tank import Tank
from sim.verify.rows import Row

SEED = 51
FRAMES = 240
PICTURES = 8  # that take turns
BAR_MS = 10.0
SCENE = Path("scenes/paper/sandwave.toml")
BAR_FROM = "issue 5: overhead of acquisition beyond camera and track, a frame"

Clock = Callable[[], float]


@dataclass
class Stopwatch:
    """Runs while neither device is at work.

    frames_s: for each frame, the time from its move until the next, or until ``stop``, less
    what the devices took of it.
    """

    clock: Clock
    frames_s: list[float] = field(default_factory=list)
    _since_s: float = 0.0

    def begin_frame(self) -> None:
        """The track is told to move: what ran until now belongs to the frame before."""
        if self.frames_s:
            self.pause()
        self.frames_s.append(0.0)

    def pause(self) -> None:
        """A device is called, or the scan has ended."""
        self.frames_s[-1] += self.clock() - self._since_s

    def go_on(self) -> None:
        """A device has answered."""
        self._since_s = self.clock()


@dataclass
class FreeTrack:
    """A track that is at once where it is told to go."""

    watch: Stopwatch
    position_mm: float = 0.0

    def move_to(self, position_mm: float) -> float:
        """The position asked for, mm."""
        self.watch.begin_frame()
        self.position_mm = position_mm
        self.watch.go_on()
        return position_mm

    def close(self) -> None:
        """Nothing is held."""


@dataclass
class FreeCamera:
    """A camera whose pictures, all (H, W, 3) RGB, have been taken beforehand."""

    watch: Stopwatch
    pictures: list[Bytes]

    @property
    def size_px(self) -> tuple[int, int]:
        """(width, height) of every picture."""
        height, width = self.pictures[0].shape[:2]
        return width, height

    def grab(self, frame: int | None = None, dark: bool = False) -> Grab:
        """The picture whose turn it is."""
        self.watch.pause()
        grab = self._taken(0 if frame is None else frame)
        self.watch.go_on()
        return grab

    def close(self) -> None:
        """Nothing is held."""

    def _taken(self, frame: int) -> Grab:
        return Grab(self.pictures[frame % len(self.pictures)], float(frame), 20.0)


def overhead_rows(folder: Path = Path(), frames: int = FRAMES, scene: Path = SCENE) -> list[Row]:
    """The overhead of one frame of 640 by 480 px in colour, its median and its mean, ms.

    folder: on the disk that runs are written to; a memory file system would sync for nothing.
    frames: how many are scanned.  scene: whose sensor takes the pictures.
    The mean times the number of frames is what a scan takes longer; a disk that now and then
    hesitates shows in it, and not in the median.
    """
    pictures = noisy_pictures(scene)
    with TemporaryDirectory(dir=folder, prefix=".overhead-") as scratch:
        times_ms = 1000 * frame_times(Path(scratch) / "run", pictures, frames)
    what = f"overhead of a frame, 640 x 480 colour, {frames} frames"
    return [
        Row(
            what=f"{what}: {name}",
            reference="a camera and a track that cost nothing",
            figure=float(figure),
            bar=BAR_MS,
            unit="ms",
            tolerance_from=BAR_FROM,
            seed=SEED,
        )
        for name, figure in (("median", np.median(times_ms)), ("mean", times_ms.mean()))
    ]


def noisy_pictures(scene: Path = SCENE, count: int = PICTURES) -> list[Bytes]:
    """Pictures (H, W, 3) RGB uint8 of one view of the tank, each with noise of its own."""
    loaded = load_scene(scene)
    layers, webcam = Tank(loaded).render(loaded.rig.plan.start_mm), Webcam(loaded)
    generator = np.random.default_rng(SEED)
    exposure_ms = loaded.rig.camera.exposure_ms
    return [webcam.expose(layers, exposure_ms, generator) for _ in range(count)]


def frame_times(
    path: Path,
    pictures: list[Bytes],
    frames: int,
    clock: Clock = time.perf_counter,
    camera: type[FreeCamera] = FreeCamera,
) -> Floats:
    """(frames,) what acquisition itself took for each frame, s, scanning into the folder ``path``.

    camera: takes the place of the one that costs nothing.
    """
    watch = Stopwatch(clock)
    with create_run(path, _rig(pictures[0], frames)) as writer:
        acquire_into(writer, camera(watch, pictures), FreeTrack(watch))
        watch.pause()
    return np.array(watch.frames_s)


def _rig(picture: Bytes, frames: int) -> RigFile:
    height, width = picture.shape[:2]
    document = {
        "camera": {"driver": "free", "width_px": width, "height_px": height},
        "track": {"driver": "free"},
        "plan": {"frames": frames},
    }
    return parse_rig(document, source="overhead", trusted=True)
