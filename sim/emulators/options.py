"""How the tank is served as hardware."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from lscan.config.documents import Strict
from sim.emulators.track import Dialect


class ServeOptions(Strict):
    """How the tank is served.

    Attributes
    ----------
    http_port : int, port of the webcam; 0 for any free one
    fps : float, pictures per second
    quality : int, of the JPEGs, 1 to 100
    subsampling : str, of the JPEGs' chroma, "4:4:4", "4:2:2" or "4:2:0"
    places : int, how many rendered places are kept, 5 MB each at 640 by 480 px
    switched_laser : bool, the laser is lit only by M3, else always
    prepare : bool, render all of the plan first, and keep it
    dialect : Dialect, of the controller, "grbl" or "marlin"
    link : Path or None, a lasting name for the controller's port

    Examples
    --------
    >>> import sim
    >>> sim.ServeOptions(fps=15.0, subsampling="4:2:2").dialect
    'grbl'
    """

    http_port: Annotated[int, Field(ge=0, le=65535)] = 0
    fps: Annotated[float, Field(ge=0.1, le=240)] = 30.0
    quality: Annotated[int, Field(ge=1, le=100)] = 95
    subsampling: Literal["4:4:4", "4:2:2", "4:2:0"] = "4:4:4"
    places: Annotated[int, Field(ge=1, le=100_000)] = 64
    switched_laser: bool = False
    prepare: bool = False
    dialect: Dialect = "grbl"
    link: Path | None = None
