"""``lscan-sim study``: where an error comes from, cause by cause; ``concavity``: of the line."""

from pathlib import Path
from typing import Annotated, Literal, get_args

import typer

from lscan.cli.arguments import Json
from lscan.cli.console import note, print_json, print_table, progress_bar
from lscan.config.scenes import scenes_folder
from lscan.errors import InputError
from sim.cli.arguments import OutputFolder, ScenesFolder

MOST_WORKERS = 1024


def study(
    file: Annotated[Path, typer.Argument(help="Study file (TOML); see docs/howto/error-budget.")],
    output: OutputFolder = Path("out/study"),
    workers: Annotated[
        int, typer.Option("--workers", help="Processes of this machine, one thread each.")
    ] = 2,
    scheduler: Annotated[
        str | None,
        typer.Option("--scheduler", help="Another Dask cluster, such as tcp://cluster:8786."),
    ] = None,
    processes: Annotated[
        str | None, typer.Option("--processes", help='"none": all in this process, to debug.')
    ] = None,
    tier: Annotated[
        str, typer.Option("--tier", help="geometric, rendered or both, in place of the file's.")
    ] = "",
    at_most: Annotated[
        int, typer.Option("--at-most", help="Runs that are agreed to.", min=1)
    ] = 20_000,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with the runs that the folder holds.")
    ] = False,
    json: Json = False,
) -> None:
    """Where the error of a rig comes from: a budget, cause by cause, with intervals."""
    from sim.studies.results import as_document
    from sim.studies.study import StudyOptions, run_study
    from sim.studies.studyfile import Tier

    if processes not in (None, "none"):
        raise InputError("not known", where="--processes", value=processes, allowed="none")
    tiers: dict[str, Tier | None] = {"": None} | {known: known for known in get_args(Tier)}
    if tier not in tiers:
        allowed = ", ".join(get_args(Tier))
        raise InputError("not known", where="--tier", value=tier, allowed=allowed)
    if not 1 <= workers <= MOST_WORKERS:
        allowed = f"1 to {MOST_WORKERS}"
        raise InputError("out of range", where="--workers", value=workers, allowed=allowed)
    how: int | Literal["none"] = "none" if processes == "none" else workers
    options = StudyOptions(how, scheduler, at_most, tiers[tier], resume)
    with progress_bar("runs") as progress:
        found = run_study(file, output, options, progress=progress, say=note)
    if json:
        print_json(as_document(found))
        return
    for budget in found.outputs:
        headings = ["cause", f"alone, {budget.unit}", "first index", "total index", "after"]
        after = {cause.cause: cause for cause in budget.after.causes} if budget.after else {}
        cells = [
            [
                cause.cause,
                _shown(cause.alone_rms),
                _shown(cause.first),
                _shown(cause.total),
                _shown(after[cause.cause].alone_rms) if cause.cause in after else "",
            ]
            for cause in budget.causes
        ]
        rms = _shown(budget.rms)
        print_table(f"{budget.name}: rms {rms} {budget.unit}", headings, cells)
    for line in found.notes:
        print(line)
    print(output / "report.html")


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


def _shown(bounded: object) -> str:
    """A figure with its interval, "" where there is none."""
    from sim.studies.intervals import Bounded

    if not isinstance(bounded, Bounded):
        return ""
    return f"{bounded.value:.3g} ± {bounded.half_width:.1g}"
