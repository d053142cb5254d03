"""``lscan-sim study``: where an error comes from, cause by cause; ``concavity``: of the line."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, get_args

import typer

from lscan.cli.console import (
    Json,
    keep_notes_when_stopped,
    note,
    print_json,
    print_table,
    progress_bar,
)
from lscan.config.scenes import scenes_folder
from lscan.errors import InputError
from sim.cli.arguments import OutputFolder, ScenesFolder

if TYPE_CHECKING:
    from sim.studies.budget import CauseBudget, DesignTrial, OutputBudget
    from sim.studies.indices import Bounded

MOST_WORKERS = 1024
STUDIES = "cross-check, first-rig, paper-budget, recalibration, seasons, tolerances"


def study(
    file: Annotated[Path, typer.Argument(help=f"Study file (TOML), or one of lscan's: {STUDIES}.")],
    output: OutputFolder = Path("out/study"),
    workers: Annotated[
        int, typer.Option("--workers", help="Processes of this machine, one thread each.")
    ] = 2,
    scheduler: Annotated[
        str | None,
        typer.Option(
            "--scheduler",
            help="A Dask cluster, such as tcp://cluster:8786; it trusts all who reach it.",
        ),
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
    from sim.studies.page import kept
    from sim.studies.results import as_document
    from sim.studies.run.running import StudyOptions
    from sim.studies.study import run_study
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
    with keep_notes_when_stopped(), progress_bar("runs") as progress:
        found = run_study(file, output, options, progress=progress, say=note)
    if json:
        print_json(as_document(found))
        return
    _print_budgets(found.outputs)
    for line in found.notes:
        print(line)
    if tolerances := found.tolerances:
        headings = ["cause", "stated", "allowed", "factor"]
        rows = [[c.cause, c.stated, c.allowed or "as it is", c.factor or ""]
                for c in tolerances.causes]  # fmt: skip
        print_table("tolerances", headings, rows)
        print(kept(tolerances))
    _print_front(found.trials)
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


def _print_budgets(outputs: "tuple[OutputBudget, ...]") -> None:
    """The table of each field, cause by cause, and one of all other quantities."""
    from sim.studies.page import largest

    for budget in (output for output in outputs if output.places > 1):
        again = {cause.cause: cause for cause in budget.after.causes} if budget.after else {}
        headings = ["cause", f"alone, {budget.unit}", "first index", "total index"]
        cells = [
            [cause.cause, _shown(cause.alone_rms), _percent(cause.first), _percent(cause.total)]
            for cause in sorted(budget.causes, key=_alone, reverse=True)
        ]
        if again:  # where anything drifts
            headings.append("alone, recalibrated")
            for row in cells:
                row.append(_shown(again[row[0]].alone_rms))
        print_table(f"{budget.name}: rms {_rms(budget)}", headings, cells)
    headings = ["quantity", "rms error", "most of its variance", "total index"]
    cells = []
    for budget in (output for output in outputs if output.places == 1):
        most = largest(budget)
        share = _percent(most.total) if most else ""
        cells.append([budget.name, _rms(budget), most.cause if most else "", share])
    print_table("other quantities, cause by cause on the page", headings, cells)


def _print_front(trials: "tuple[DesignTrial, ...]") -> None:
    """The designs on the front, one a line, the least error first."""
    from sim.studies.page import figure

    best = [(number, trial) for number, trial in enumerate(trials, start=1) if trial.on_front]
    if not best:
        if trials:
            print("no design keeps all limits")
        return
    best.sort(key=lambda one: float(next(iter(one[1].objectives.values())) or 0.0))
    headings = ["design", *best[0][1].objectives, "same rigs", "rendered", "parts", "status"]
    cells = [
        [number]
        + [v if isinstance(v, str) else figure(v) for v in trial.objectives.values()]
        + [figure(trial.predicted_mm)]
        + [_shown(trial.rendered_mm), ", ".join(map(str, trial.parts.values())), trial.status]
        for number, trial in best
    ]
    print_table(f"front of {len(trials)} designs", headings, cells)


def _alone(cause: "CauseBudget") -> float:
    return cause.alone_rms.value if cause.alone_rms else 0.0


def _rms(budget: "OutputBudget") -> str:
    """What the error is in all, recalibrated, and with no cause at work."""
    words = f"{_shown(budget.rms)} {budget.unit}"
    if budget.after:
        words += f"; recalibrated {_shown(budget.after.rms)}"
    return words if budget.base_rms is None else f"{words}; without causes {budget.base_rms:.2g}"


def _shown(bounded: "Bounded | None") -> str:
    """A figure with its interval, "" where there is none."""
    return "" if bounded is None else f"{bounded.value:.3g} ± {bounded.half_width:.1g}"


def _percent(bounded: "Bounded | None") -> str:
    """A share with its interval, "" where there is none."""
    if bounded is None:
        return ""
    return f"{100 * bounded.value:z.1f} ± {100 * bounded.half_width:.1f} %"
