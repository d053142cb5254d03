"""A track and a camera without hardware, for tests of what is done with their pictures.

The picture depends on the position and on how often it was grabbed there, counted from 0 in
each process, as with the simulated camera; so does the clock.
"""

import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lscan.config.rig import RigFile, parse_rig
from lscan.devices.api import Grab, Track
from lscan.errors import DeviceError

WIDTH, HEIGHT = 20, 16


def fake_rig(
    frames: int = 5, width_px: int = WIDTH, height_px: int = HEIGHT, **plan: Any
) -> RigFile:
    """A rig of the fake devices; ``plan`` holds start_mm, step_mm and laser."""
    document = {
        "name": "Prüfstand",
        "camera": {
            "driver": "fake",
            "width_px": width_px,
            "height_px": height_px,
            "options": {"seed": 3},
        },
        "track": {"driver": "fake"},
        "stripe": {"extractor": "centroid-relative"},
        "plan": {"frames": frames, "start_mm": 1.0, "step_mm": 0.1, **plan},
        "water": {"salinity_psu": 0.1, "layers": [[0, 1.5], [1, 2.5]]},
    }
    return parse_rig(document, source="rig.toml", trusted=True)


@dataclass
class FakeTrack:
    """Misses each commanded position by a fixed 0.013 mm; ``trace`` notes all that is done."""

    trace: list[str] = field(default_factory=list)
    fail_at: int | None = None
    position_mm: float = 0.0
    moves: int = 0
    closed: int = 0

    def move_to(self, position_mm: float) -> float:
        """Move, or fail at move number ``fail_at``."""
        if self.moves == self.fail_at:
            raise DeviceError("fake track: the limit switch at 12 mm opened")
        self.moves += 1
        self.trace.append("move")
        self.position_mm = position_mm + 0.013
        return self.position_mm

    def close(self) -> None:
        """Count the closings."""
        self.closed += 1


@dataclass
class LaserTrack(FakeTrack):
    """A track that switches the laser too, and notes it in its trace."""

    lit: bool = False

    def laser_on(self) -> None:
        """Light the laser."""
        self.trace.append("laser on")
        self.lit = True

    def laser_off(self) -> None:
        """Put the laser out."""
        self.trace.append("laser off")
        self.lit = False


@dataclass
class FakeCamera:
    """Noise whose seed is made of the position and of the number of grabs there."""

    track: Track
    size_px: tuple[int, int] = (WIDTH, HEIGHT)
    colour: bool = True
    bits: int = 8
    fail_at: int | None = None
    bad_picture: Any = None
    grabs: dict[float, int] = field(default_factory=dict)
    closed: int = 0

    def grab(self, frame: int | None = None, dark: bool = False) -> Grab:
        """A picture; at grab number ``fail_at`` the bad one, or a failure."""
        if sum(self.grabs.values()) == self.fail_at:
            if self.bad_picture is None:
                raise DeviceError("fake camera: no picture within 2 s")
            return Grab(self.bad_picture, 1e6, 20.0)
        position_mm = self.track.position_mm
        count = self.grabs.get(position_mm, 0)
        self.grabs[position_mm] = count + 1
        seed = [zlib.crc32(repr(position_mm).encode()), count]
        width, height = self.size_px
        shape = (height, width, 3) if self.colour else (height, width)
        image: Any = np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)
        if self.bits > 8:
            image = image * np.uint16(2 ** (16 - self.bits))
        return Grab(image, time_s=position_mm / 3 + 1e-6 * count, exposure_ms=20.0)

    def close(self) -> None:
        """Count the closings."""
        self.closed += 1


@dataclass
class FakeDrivers:
    """Stands in for ``find_plugin``: both drivers are this object's two halves."""

    track: FakeTrack
    camera: FakeCamera
    opened: int = 0

    def find_plugin(self, group: str, name: str, where: object = None) -> Any:
        """The driver of the group, which opens the one device it has."""
        assert name == "fake"
        return _FakeDriver(self, self.track if group == "lscan.tracks" else self.camera)


@dataclass
class _FakeDriver:
    drivers: FakeDrivers
    device: Any

    def open(self, rig_file: RigFile, track: Track | None = None) -> Any:
        self.drivers.opened += 1
        return self.device


def folder_bytes(folder: Path) -> dict[str, bytes]:
    """Every file beneath ``folder``, name to content; hidden ones too."""
    files = (file for file in sorted(folder.rglob("*")) if file.is_file())
    return {str(file.relative_to(folder)): file.read_bytes() for file in files}
