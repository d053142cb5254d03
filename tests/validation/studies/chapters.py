"""Studies against closed forms, rendered scans and the clock."""

import shutil
from pathlib import Path

from lscan.config.rig import load_rig
from sim.studies.studyfile import Looked
from tests.validation.rows import Chapters, Request
from tests.validation.studies import coverage, crosscheck, running
from tests.validation.studies.comparison import comparison_rows
from tests.validation.studies.designs import design_rows, tolerance_rows
from tests.validation.studies.propagation import propagation_rows
from tests.validation.studies.rigs import check_rows
from tests.validation.studies.tiers import tier_rows
from tests.validation.studies.twelve import rendered_rows, speed_rows


def chapters(request: Request) -> Chapters:
    """The chapters of studies; those of a quick run need no rendering.

    Parameters
    ----------
    request : Request

    Raises
    ------
    InputError
        A scene file is wrong.
    """
    for name in ("board", "sandwave"):
        load_rig(request.scenes / "best" / f"{name}.toml")  # before minutes of work
    return _quick() if request.quick else _full(request.scenes, request.folder)


def _full(scenes: Path, folder: Path) -> Chapters:
    """The chapters in full."""
    paper = scenes / "studies" / "paper-budget.toml"
    return {
        "speed of a budget": lambda: speed_rows(400),
        "running studies": lambda: running.running_rows(kills=20, tasks=320),
        "coverage of intervals": coverage.coverage_rows,
        "two rigs on the same draws": comparison_rows,
        "law of propagation": propagation_rows,
        "cross-check": lambda: crosscheck.cross_check_rows(scenes, Looked()),
        "rigs checked": lambda: check_rows(scenes),
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


def _quick() -> Chapters:
    """Those that need no rendering, with the least effort; the others take minutes each."""
    return {
        "speed of a budget": lambda: speed_rows(5, workers=1),
        "running studies": lambda: [
            *running.overhead_rows(tasks=4, workers=1), *running.kill_rows(1),
        ],
        "coverage of intervals": lambda: coverage.coverage_rows(base=32, repeats=2),
        "two rigs on the same draws": lambda: comparison_rows(base=32, repeats=1),
        "law of propagation": lambda: propagation_rows(16, "graticule-2"),
    }  # fmt: skip
