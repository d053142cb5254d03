"""How the tank is served as hardware."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from lscan.config.documents import Strict
from sim.emulators.track import Dialect


class ServeOptions(Strict):
    """How the tank is served.

    http_port: 0 for any free one.  fps: pictures per second.  quality, subsampling: of the
    JPEGs and their chroma.  places: how many are kept, 5 MB each at 640 by 480 px.
    switched_laser: lit only by M3, else always.  prepare: render all of the plan first, and
    keep it.  dialect: of the controller.  link: a lasting name for its port.

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
