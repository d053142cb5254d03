"""What the arguments of ``lscan-sim`` name, and how its commands print where things are."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer

from lscan.cli.console import print_json

SceneFile = Annotated[
    Path, typer.Argument(help="Scene file (TOML), or a name that `lscan scenes` lists.")
]
ScenesFolder = Annotated[
    Path | None, typer.Option("--scenes", help="Folder of scene files, if not those of lscan.")
]
PaperFolder = Annotated[
    Path | None,
    typer.Option("--scenes", help="Folder with board, groove and sandwave, if not the paper's."),
]
Quick = Annotated[
    bool, typer.Option("--quick", help="Every figure with the least effort, within a minute.")
]
OutputFolder = Annotated[Path, typer.Option("--output", "-o", help="Folder to write.")]
OutputFile = Annotated[Path, typer.Option("--output", "-o", help="JSON file to write.")]


def print_places(places: Mapping[str, Path | str], json: bool) -> None:
    """Print names, and the file or address of each."""
    if json:
        print_json({name: str(place) for name, place in places.items()})
    else:
        for name, place in places.items():
            print(f"{name}: {place}")
