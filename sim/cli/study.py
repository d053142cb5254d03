"""``lscan-sim study``: where an error comes from, cause by cause; ``concavity``: of the line."""

from collections.abc import Iterator
from pathlib import Path
from typing import get_args

from rich.table import Table
from typer import Argument, Option

from lscan.cli.console import Json, keep_notes_when_stopped, note, one_of, progress_bar, show, table
from lscan.config.scenes import scenes_folder
from lscan.errors import InputError
from sim.cli.app import STUDIES, OutputFolder, ScenesFolder, worker_processes
from sim.studies.budget import DesignTrial, OutputBudget
from sim.studies.page import comparison_text, figure, largest, tolerance_sentence, with_interval
from sim.studies.problem import Bounded
from sim.studies.results import as_document
from sim.studies.studyfile import Tier


def study(
    file: Path = Argument(help=f"Study file (TOML), or one of lscan's: {STUDIES}."),
    output: OutputFolder = Path("out/study"),
    workers: int = Option(2, help="Number of processes on this machine, one thread each."),
    scheduler: str | None = Option(
        None,
        help="Address of a Dask cluster, such as tcp://cluster:8786; it trusts all who reach it.",
    ),
    processes: str | None = Option(None, help='"none" runs all in this process, to debug.'),
    tier: str = Option("", help="geometric, rendered or both, in place of the file's own."),
    at_most: int = Option(20_000, help="Greatest number of runs allowed.", min=1),
    resume: bool = Option(False, "--resume", help="Resume with the runs that the folder holds."),
    against: list[str] = Option(
        [],
        metavar="KEY=NUMBER",
        help="Compare with the same rig with another number of its scenes, on the same draws; "
        "several make one other rig.",
    ),
    json: Json = False,
) -> None:
    """Find where the error of a rig comes from: a budget, cause by cause, with intervals."""
    from sim.studies.running import StudyOptions  # loads Mitsuba
    from sim.studies.study import run_study

    how = worker_processes(workers, processes)
    instead = one_of(tier, get_args(Tier), "--tier") if tier else None
    options = StudyOptions(how, scheduler, at_most, instead, resume)
    others = _numbers(against)
    with keep_notes_when_stopped(), progress_bar("runs") as progress:
        found = run_study(file, output, options, against=others, progress=progress, say=note)
    lines = [*_budget_tables(found.outputs), *found.notes]
    if tolerances := found.tolerances:
        headings = ["cause", "stated", "allowed", "factor"]
        rows = [[c.cause, c.stated, c.allowed or "as it is", c.factor or ""]
                for c in tolerances.causes]  # fmt: skip
        lines += [table("tolerances", headings, rows), tolerance_sentence(tolerances)]
    lines += _front_lines(found.trials)
    if found.against:
        lines += ["", comparison_text(found.against)]
    show(as_document(found), *lines, str(output / "report.html"), json=json)


def concavity(
    output: OutputFolder = Path("out/concavity"),
    scenes: ScenesFolder = None,
    only: str = Option("", help="Only the targets whose name contains this text."),
    json: Json = False,
) -> None:
    """Measure the line's height on curved targets: its error, and what corrections leave of it."""
    from sim.studies.concavity import run_concavity  # loads Mitsuba

    with progress_bar("concavity") as progress:
        errors = run_concavity(scenes or scenes_folder(), output, only, progress)
    headings = ["target", "points", "rms um", "less blur", "and thickness", "99 % um", "", ""]
    cells = [
        [one.name, one.points, *(round(1000 * mm, 1) for mm in (*one.rms_mm, *one.q99_mm))]
        for one in errors
    ]
    written = str(output / "concavity.json")
    show(errors, table("error of the height", headings, cells), written, json=json)


def _numbers(texts: list[str]) -> dict[str, float]:
    """The numbers of --against by their keys; InputError where a text is none."""
    found: dict[str, float] = {}
    for text in texts:
        key, _, number = text.partition("=")
        try:
            value = int(number) if number.strip().lstrip("+-").isdecimal() else float(number)
        except ValueError:
            allowed = "KEY=NUMBER, in the unit that the key ends in, such as lens.f_number=8"
            raise InputError("no number", where="--against", value=text, allowed=allowed) from None
        if key in found:
            raise InputError("is given twice", where="--against", value=key, allowed="once")
        found[key] = value
    return found


def _budget_tables(outputs: tuple[OutputBudget, ...]) -> Iterator[str | Table]:
    """The table of each field, cause by cause, and one of all other quantities."""
    for budget in (output for output in outputs if output.places > 1):
        again = {cause.cause: cause for cause in budget.after.causes} if budget.after else {}
        headings = ["cause", f"alone, {budget.unit}", "first index", "total index"]
        most_first = sorted(
            budget.causes,
            key=lambda one: one.alone_rms.value if one.alone_rms else 0.0,
            reverse=True,
        )
        cells = [
            [one.cause, with_interval(one.alone_rms), _percent(one.first), _percent(one.total)]
            for one in most_first
        ]
        if again:  # where anything drifts
            headings.append("alone, recalibrated")
            for row in cells:
                row.append(with_interval(again[row[0]].alone_rms))
        yield table(f"{budget.name}: rms {_rms(budget)}", headings, cells)
    headings = ["quantity", "rms error", "most of its variance", "total index"]
    cells = []
    for budget in (output for output in outputs if output.places == 1):
        most = largest(budget)
        share = _percent(most.total) if most else ""
        cells.append([budget.name, _rms(budget), most.cause if most else "", share])
    yield table("other quantities, cause by cause on the page", headings, cells)


def _front_lines(trials: tuple[DesignTrial, ...]) -> Iterator[str | Table]:
    """The designs on the front, one a line, the least error first."""
    best = [(number, trial) for number, trial in enumerate(trials, start=1) if trial.on_front]
    if not best:
        if trials:
            yield "no design keeps all limits"
        return
    best.sort(key=lambda one: float(next(iter(one[1].objectives.values())) or 0.0))
    headings = ["design", *best[0][1].objectives, "same rigs", "rendered", "parts", "status"]
    cells = [
        [number, *(v if isinstance(v, str) else figure(v) for v in trial.objectives.values()),
         figure(trial.predicted_mm), with_interval(trial.rendered_mm),
         ", ".join(map(str, trial.parts.values())), trial.status]
        for number, trial in best
    ]  # fmt: skip
    yield table(f"front of {len(trials)} designs", headings, cells)


def _rms(budget: OutputBudget) -> str:
    """What the error is in all, recalibrated, and with no cause at work."""
    words = f"{with_interval(budget.rms)} {budget.unit}"
    if budget.after:
        words += f"; recalibrated {with_interval(budget.after.rms)}"
    return words if budget.base_rms is None else f"{words}; without causes {budget.base_rms:.2g}"


def _percent(bounded: Bounded | None) -> str:
    """A share with its interval, "" where there is none."""
    if bounded is None:
        return ""
    return f"{100 * bounded.value:z.1f} ± {100 * bounded.half_width:.1f} %"
