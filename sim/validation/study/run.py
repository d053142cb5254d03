"""Every figure of the studies' table, measured chapter by chapter."""

import shutil
from collections.abc import Callable, Mapping
from pathlib import Path

from lscan.records import Progress
from sim.studies.studyfile import Looked
from sim.validation.chapters import in_turn, runs_folder
from sim.validation.rows import Row, RowFile
from sim.validation.study import coverage, crosscheck, running
from sim.validation.study.designs import design_rows
from sim.validation.study.propagation import propagation_rows
from sim.validation.study.rendered import rendered_rows
from sim.validation.study.speed import speed_rows
from sim.validation.study.tiers import tier_rows
from sim.validation.study.tolerances import tolerance_rows


def run_budgets(
    scenes: Path, output: Path, quick: bool = False, progress: Progress | None = None
) -> list[Row]:
    """The rows, also written as they are measured.

    The chapters take turns, because one would spoil what another measures of time; one that ends
    with an error is a failed row.

    Parameters
    ----------
    scenes : Path, folder of the scene files
    output : Path, the JSON file; runs go to a folder beside it, the file's path without its ending
    quick : bool, the rows that need no rendering, with the least effort
    progress : Progress or None, called with (done, all) after each chapter

    Raises
    ------
    InputError
        A scene file is wrong, or the disk refuses.
    """
    folder = runs_folder(scenes / "best", output)  # refuses a bad file before minutes of work
    chapters = _quick() if quick else _full(scenes, folder)
    return in_turn(chapters, RowFile(output, quick), progress)


def _full(scenes: Path, folder: Path) -> Mapping[str, Callable[[], list[Row]]]:
    """The chapters in full."""
    paper = scenes / "studies" / "paper-budget.toml"
    return {
        "speed of a budget": lambda: speed_rows(400),
        "running studies": lambda: running.running_rows(kills=20, tasks=320),
        "coverage of intervals": coverage.coverage_rows,
        "law of propagation": propagation_rows,
        "cross-check": lambda: crosscheck.cross_check_rows(scenes, Looked()),
        "recalibration": lambda: crosscheck.recalibration_rows(scenes, Looked()),
        "tiers": lambda: tier_rows(paper),
        "rendered": lambda: rendered_rows(_none_of_before(folder / "rendered")),
        "designs": lambda: design_rows(scenes, _none_of_before(folder / "designs")),
        "tolerances": lambda: tolerance_rows(scenes, _none_of_before(folder / "tolerances")),
    }


def _none_of_before(folder: Path) -> Path:
    """The folder without an earlier measurement's runs: a study does not begin where some are."""
    if folder.exists():
        shutil.rmtree(folder)
    return folder


def _quick() -> Mapping[str, Callable[[], list[Row]]]:
    """Those that need no rendering, with the least effort; the others take minutes each."""
    return {
        "speed of a budget": lambda: speed_rows(5, workers=1),
        "running studies": lambda: [
            *running.overhead_rows(tasks=4, workers=1), *running.kill_rows(1),
        ],
        "coverage of intervals": lambda: coverage.coverage_rows(base=32, repeats=2),
        "law of propagation": lambda: propagation_rows(16, "graticule-2"),
    }  # fmt: skip
