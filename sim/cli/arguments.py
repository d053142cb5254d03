"""What the arguments of ``lscan-sim`` name, and how its commands print where things are."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

import typer

from lscan.cli.console import one_of, show
from lscan.errors import InputError

MOST_WORKERS = 1024
STUDIES = "cross-check, first-rig, paper-budget, recalibration, seasons, tolerances"
ALONE: tuple[Literal["none"]] = ("none",)

SceneFile = Annotated[
    Path, typer.Argument(help="Scene file (TOML), or a name that `lscan scenes` lists.")
]
ScenesFolder = Annotated[
    Path | None, typer.Option("--scenes", help="Folder of scene files, in place of lscan's own.")
]
PaperFolder = Annotated[
    Path | None,
    typer.Option("--scenes", help="Folder with other board, groove and sandwave scenes."),
]
Quick = Annotated[
    bool,
    typer.Option("--quick", help="Every figure at the least effort, within a minute."),
]
OutputFolder = Annotated[Path, typer.Option("--output", "-o", help="Folder to write.")]
OutputFile = Annotated[Path, typer.Option("--output", "-o", help="JSON file to write.")]


def one_process(processes: str | None) -> Literal["none"] | None:
    """What --processes says: all in this process, or None; InputError for another word."""
    return None if processes is None else one_of(processes, ALONE, "--processes")


def require_workers(workers: int) -> None:
    """Refuse a number of processes that no machine has."""
    if not 1 <= workers <= MOST_WORKERS:
        allowed = f"1 to {MOST_WORKERS}"
        raise InputError("out of range", where="--workers", value=workers, allowed=allowed)


def show_places(places: Mapping[str, Path | str], json: bool, *more: str) -> None:
    """Print names, the file or address of each, and what more there is to be said in words."""
    lines = [f"{name}: {place}" for name, place in places.items()]
    show({name: str(place) for name, place in places.items()}, *lines, *more, json=json)
