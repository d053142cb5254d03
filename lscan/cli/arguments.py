"""The arguments that several commands take, and what is checked of them before any work."""

import os
from pathlib import Path
from typing import Annotated

import typer

from lscan.errors import InputError

RigOrScene = Annotated[
    Path, typer.Argument(help="Rig file or scene file (TOML), or a scene's name.")
]
PictureOrRun = Annotated[Path, typer.Argument(help="Picture file or run folder.")]
EXTRACTORS = (
    "max, centroid, centroid-relative, centroid-squared, gaussian, ml, blais-rioux, smoothed-peak, "
    "steger; or package.module:function."
)
MAPS = (
    "graticule-1, -2, -bspline, each also with -norulers; polynomial-1 to -9; projective, spline, "
    "refractive"
)
ChannelName = Annotated[str | None, typer.Option("--channel", help="red, green, blue or grey.")]
Overlay = Annotated[
    Path | None,
    typer.Option("--overlay", help="Write the picture with what was found drawn on it."),
]
RunFolder = Annotated[Path, typer.Argument(help="Run folder.")]
CalibrationFile = Annotated[
    Path, typer.Option("--calibration", "-c", help="Calibration file (JSON).")
]
ShaftFile = Annotated[
    Path | None,
    typer.Option("--shaft", help="TOML file with the [shaft] found; a run folder has its own."),
]
AlignmentFile = Annotated[
    Path | None,
    typer.Option("--alignment", help="Alignment kept from a scan of the block (JSON)."),
]
Trust = Annotated[
    bool, typer.Option("--trust", help="Run the code that a run folder names as its extractor.")
]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]


def require_folders(*outputs: Path | None) -> None:
    """Refuse, before any work is done, an output whose folder does not exist."""
    for output in outputs:
        if output is not None and not os.path.isdir(output.parent):  # noqa: PTH112 - takes any
            raise InputError("the folder to write to does not exist", where=output)
