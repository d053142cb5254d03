"""How the tank is served as hardware."""

from dataclasses import dataclass
from pathlib import Path
from typing import Self, get_args

from lscan.errors import InputError
from sim.emulators.track import Dialect
from sim.sensor.coding import SUBSAMPLING


@dataclass(frozen=True)
class ServeOptions:
    """How the tank is served.

    http_port: 0 for any free one.  fps: pictures per second.  quality, subsampling: of the
    JPEGs, 1 to 100 and "4:4:4", "4:2:2" or "4:2:0".  places: how many are kept, 5 MB each at
    640 by 480 px.  switched_laser: lit only by M3, else always.  prepare: render all of the
    plan first, and keep it.  dialect: of the controller.  link: a lasting name for its port.

    Examples
    --------
    >>> import sim
    >>> sim.ServeOptions(fps=15.0, subsampling="4:2:2").check().dialect
    'grbl'
    """

    http_port: int = 0
    fps: float = 30.0
    quality: int = 95
    subsampling: str = "4:4:4"
    places: int = 64
    switched_laser: bool = False
    prepare: bool = False
    dialect: str = "grbl"
    link: Path | None = None

    def check(self) -> Self:
        """These options; InputError names the one that cannot be."""
        ranges = {
            "--http-port": (self.http_port, 0, 65535),
            "--fps": (self.fps, 0.1, 240),
            "--quality": (self.quality, 1, 100),
            "--places": (self.places, 1, 100_000),
        }
        for name, (value, low, high) in ranges.items():
            if not low <= value <= high:
                raise InputError(
                    "is out of range", where=name, value=value, allowed=f"{low} to {high}"
                )
        choices = {
            "--subsampling": (self.subsampling, tuple(SUBSAMPLING)),
            "--dialect": (self.dialect, get_args(Dialect)),
        }
        for name, (choice, allowed) in choices.items():
            if choice not in allowed:
                raise InputError("unknown", where=name, value=choice, allowed=", ".join(allowed))
        return self
