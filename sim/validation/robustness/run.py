"""Every figure of the hardware table, measured one after the other on emulated hardware."""

import logging
from collections.abc import Callable, Mapping
from pathlib import Path

from lscan.records import Progress
from sim.validation.chapters import in_turn, runs_folder
from sim.validation.robustness.agreement import agreement_rows
from sim.validation.robustness.campaign import Outcome, fault_rows
from sim.validation.robustness.effort import FULL, QUICK
from sim.validation.robustness.fields import field_rows
from sim.validation.robustness.kills import kill_rows
from sim.validation.robustness.livepage import livepage_rows
from sim.validation.robustness.moving import moving_rows
from sim.validation.robustness.overhead import overhead_rows
from sim.validation.rows import Row, RowFile


def run_hardware(
    scenes: Path, output: Path, quick: bool = False, progress: Progress | None = None
) -> tuple[list[Row], list[Outcome]]:
    """The rows, also written as they are measured, and what became of each fault.

    The chapters take turns, because one would spoil what another measures of time; one that ends
    with an error, as the live page's does without Chromium, is a failed row.

    Parameters
    ----------
    scenes : Path, folder of the scene files
    output : Path, the JSON file; runs and a screenshot go to a folder beside it, the file's path
        without its ending
    quick : bool, every row, with the least effort
    progress : Progress or None, called with (done, all) after each chapter

    Raises
    ------
    InputError
        A scene file is wrong, or the disk refuses.
    """
    folder = runs_folder(scenes / "paper", output)  # refuses a bad file before minutes of work
    file = RowFile(output, quick)
    effort = QUICK if quick else FULL
    outcomes: list[Outcome] = []

    def faults() -> list[Row]:
        before = logging.root.manager.disable
        logging.disable(logging.WARNING)  # drivers warn of each of hundreds of faults
        try:
            rows, ended = fault_rows(effort.faults)
        finally:
            logging.disable(before)
        outcomes.extend(ended)
        return rows

    sandwave = scenes / "paper" / "sandwave.toml"
    chapters: Mapping[str, Callable[[], list[Row]]] = {
        "live page": lambda: livepage_rows(scenes, folder / "live", effort),
        "head that moves": lambda: moving_rows(sandwave, folder / "moving", effort.moving_s),
        "overhead of a frame": lambda: overhead_rows(effort.overhead_frames, folder, sandwave),
        "scan through opencv and grbl": lambda: agreement_rows(
            scenes, folder / "agreement", effort
        ),
        "kills": lambda: kill_rows(sandwave, effort.kills, effort.kill_frames, effort.render),
        "rig files with one field wrong": lambda: field_rows(effort.every_field),
        "faults": faults,
    }
    return in_turn(chapters, file, progress), outcomes
