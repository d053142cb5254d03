"""``lscan-sim study``: where an error comes from."""

from pathlib import Path
from typing import Annotated

import typer

from lscan.cli.arguments import Json
from lscan.cli.console import print_json, print_table, progress_bar
from lscan.config.scenes import scenes_folder
from sim.cli.arguments import OutputFolder, ScenesFolder

study = typer.Typer(help="Where an error comes from.", no_args_is_help=True)


@study.callback()
def _study() -> None:
    """Where an error comes from."""


@study.command()
def concavity(
    output: OutputFolder = Path("out/concavity"),
    scenes: ScenesFolder = None,
    only: Annotated[
        str, typer.Option("--only", help="The targets that have this in their name alone.")
    ] = "",
    json: Json = False,
) -> None:
    """The line's height on curved targets: its error as found, and what corrections leave."""
    from sim.studies.concavity import run_concavity

    with progress_bar("concavity") as progress:
        errors = run_concavity(scenes or scenes_folder(), output, only, progress)
    if json:
        print_json(errors)
        return
    headings = ["target", "points", "rms um", "less blur", "and thickness", "99 % um", "", ""]
    cells = [
        [one.name, one.points, *(round(1000 * mm, 1) for mm in (*one.rms_mm, *one.q99_mm))]
        for one in errors
    ]
    print_table("error of the height", headings, cells)
    print(output / "concavity.json")
