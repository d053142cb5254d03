"""Drivers, faults, resuming and the live page, on hardware that the tank emulates."""

import logging

from lscan.cli.console import show, table
from lscan.config.rig import load_rig
from tests.validation.robustness.acquisition import agreement_rows, kill_rows
from tests.validation.robustness.campaign import fault_rows, field_rows, kind_cells
from tests.validation.robustness.effort import FULL, QUICK
from tests.validation.robustness.livepage import livepage_rows, moving_rows
from tests.validation.robustness.overhead import overhead_rows
from tests.validation.rows import Chapters, Request, Row


def chapters(request: Request) -> Chapters:
    """The chapters, which take turns: one would spoil what another measures of time.

    One that ends with an error, as the live page's does without Chromium, is a failed row.

    Parameters
    ----------
    request : Request; runs and a screenshot go to its folder

    Raises
    ------
    InputError
        A scene file is wrong.
    """
    scenes, folder = request.scenes, request.folder
    for name in ("board", "sandwave"):
        load_rig(scenes / "paper" / f"{name}.toml")  # before minutes of work
    effort = QUICK if request.quick else FULL
    sandwave = scenes / "paper" / "sandwave.toml"
    return {
        "live page": lambda: livepage_rows(scenes, folder / "live", effort),
        "head that moves": lambda: moving_rows(sandwave, folder / "moving", effort.moving_s),
        "overhead of a frame": lambda: overhead_rows(effort.overhead_frames, folder, sandwave),
        "scan through opencv and grbl": lambda: agreement_rows(
            scenes, folder / "agreement", effort
        ),
        "kills": lambda: kill_rows(sandwave, effort.kills, effort.kill_frames, effort.render),
        "rig files with one field wrong": lambda: field_rows(effort.every_field),
        "faults": lambda: _fault_rows(effort.faults),
    }


def _fault_rows(faults: int) -> list[Row]:
    """The rows of so many faults, of whose kinds a table is printed."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)  # drivers warn of each of hundreds of faults
    try:
        rows, outcomes = fault_rows(faults)
    finally:
        logging.disable(before)
    headings = ["", "injected", "tolerated", "stopped the scan", "not clean"]
    show(None, table("faults", headings, kind_cells(outcomes)), json=False)
    return rows
