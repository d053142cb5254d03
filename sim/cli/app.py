"""The command line ``lscan-sim``: its commands by name, and the arguments that several take."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

from typer import Argument, Option

from lscan.cli.console import before_any_command, command_line, one_of, run_program, show
from lscan.errors import InputError

COMMANDS = {
    "demo": "sim.cli.pictures:demo",
    "render": "sim.cli.pictures:render",
    "check": "sim.cli.pictures:check",
    "truth": "sim.cli.pictures:truth",
    "views": "sim.cli.pictures:views",
    "serve": "sim.cli.serve:serve",
    "study": "sim.cli.study:study",
    "concavity": "sim.cli.study:concavity",
    "dataset": "sim.cli.dataset:dataset",
}
SUITE_COMMANDS = {"make": "sim.cli.dataset:make_suite"}

app = command_line(
    "The tank in software: demo, check, render, truth, views, serve, study, concavity, dataset, "
    "suite.",
    COMMANDS,
)
app.callback()(before_any_command)
app.add_typer(
    command_line("Suites of rendered pictures with their truth: make.", SUITE_COMMANDS),
    name="suite",
)

# What the arguments of its commands name, and how they print where things are.

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


def main() -> None:
    """Entry point of the console script ``lscan-sim``."""
    run_program(app, "lscan-sim")


if __name__ == "__main__":
    main()
