"""The command ``lscan scan``: a thin face over lscan.acquisition.scan."""

from pathlib import Path
from typing import Annotated

import typer

from lscan.cli.arguments import Json, RigOrScene
from lscan.cli.console import keep_notes_when_stopped, note, print_json, progress_bar


def scan(
    rig: RigOrScene,
    output: Annotated[Path, typer.Option("--output", "-o", help="Run folder to write.")],
    resume: Annotated[bool, typer.Option("--resume", help="Go on with a stopped run.")] = False,
    position_restored: Annotated[
        bool,
        typer.Option(
            "--position-restored",
            help="With --resume, after the track lost its zero: the head was put back by hand.",
        ),
    ] = False,
    json: Json = False,
) -> None:
    """Move the track, take the pictures, write a run folder."""
    from lscan.acquisition.scan import scan as acquire
    from lscan.acquisition.writer import holds_no_run
    from lscan.config.rig import load_rig
    from lscan.errors import InputError

    if position_restored and not resume:
        raise InputError("goes with --resume only", where="--position-restored")
    rig_file = load_rig(rig)
    if resume and holds_no_run(output):
        note(f"there is nothing to resume in {output}; a new run is begun")
    with keep_notes_when_stopped(), progress_bar("scan") as progress:
        run = acquire(
            rig_file, output, resume=resume, position_restored=position_restored, progress=progress
        )
    if json:
        print_json({"run": run.path, "frames": len(run), "state": run.state})
    else:
        print(f"{len(run)} {'frame' if len(run) == 1 else 'frames'} in {run.path}")
