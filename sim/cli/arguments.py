"""What the arguments of ``lscan-sim`` name, and how its commands print where things are."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

from typer import Argument, Option

from lscan.cli.console import one_of, show
from lscan.errors import InputError

MOST_WORKERS = 1024
STUDIES = "cross-check, first-rig, paper-budget, recalibration, seasons, tolerances"
ALONE: tuple[Literal["none"]] = ("none",)

SceneFile = Annotated[Path, Argument(help="Scene file (TOML), or a name from `lscan scenes`.")]
ScenesFolder = Annotated[Path | None, Option(help="Folder of scene files in place of lscan's own.")]
PaperFolder = Annotated[
    Path | None, Option("--scenes", help="Folder with other board, groove and sandwave scenes.")
]
Quick = Annotated[bool, Option("--quick", help="Every figure at least effort, within a minute.")]
OutputFolder = Annotated[Path, Option("--output", "-o", help="Folder to write.")]


def worker_processes(workers: int, processes: str | None = None) -> int | Literal["none"]:
    """As many processes as --workers says, or "none" as --processes may say; InputError else."""
    alone = None if processes is None else one_of(processes, ALONE, "--processes")
    if not 1 <= workers <= MOST_WORKERS:
        allowed = f"1 to {MOST_WORKERS}"
        raise InputError("out of range", where="--workers", value=workers, allowed=allowed)
    return alone or workers


def show_places(places: Mapping[str, Path | str], json: bool, *more: str) -> None:
    """Print names, the file or address of each, and what more there is to be said in words."""
    lines = [f"{name}: {place}" for name, place in places.items()]
    show({name: str(place) for name, place in places.items()}, *lines, *more, json=json)
