"""What the arguments of ``lscan-sim`` name, and how its commands print files."""

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


def print_files(files: Mapping[str, Path], json: bool) -> None:
    """Print what the files are and where they lie."""
    if json:
        print_json({name: str(path) for name, path in files.items()})
    else:
        for name, path in files.items():
            print(f"{name}: {path}")
