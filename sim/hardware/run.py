"""Every figure of the hardware table, measured one after the other on emulated hardware."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from lscan.disk import make_folder
from lscan.rig import load_rig
from sim.hardware.agreement import agreement_rows
from sim.hardware.campaign import Outcome, fault_rows
from sim.hardware.fields import field_rows
from sim.hardware.kills import kill_rows
from sim.hardware.livepage import livepage_rows
from sim.hardware.overhead import overhead_rows
from sim.verify.rows import Row, write_rows

Progress = Callable[[int, int], None]
NEEDED = ("board", "sandwave")


@dataclass(frozen=True)
class Evidence:
    """The rows of the table, and what became of each injected fault."""

    rows: tuple[Row, ...]
    outcomes: tuple[Outcome, ...]

    @property
    def passed(self) -> bool:
        """Whether every figure keeps its bar."""
        return all(row.passed for row in self.rows)


def run_hardware(scenes: Path, output: Path, progress: Progress | None = None) -> Evidence:
    """The figures, whose rows are also written to ``output`` as a JSON list.

    scenes: folder of the scene files.  progress: told (done, all) after each chapter.  The
    chapters take turns, because one would spoil what another measures of time.  Raises
    InputError where a scene file is wrong or the disk refuses, BrowserMissing without Chromium.
    """
    for name in NEEDED:
        load_rig(scenes / "paper" / f"{name}.toml")  # refuses a bad file before minutes of work
    make_folder(output.parent)
    outcomes: list[Outcome] = []

    def faults() -> list[Row]:
        with _quiet():
            rows, ended = fault_rows()
        outcomes.extend(ended)
        return rows

    chapters: Sequence[Callable[[], list[Row]]] = (
        lambda: livepage_rows(scenes),
        overhead_rows,
        lambda: agreement_rows(scenes),
        lambda: kill_rows(scenes / "paper" / "sandwave.toml"),
        field_rows,
        faults,
    )
    rows: list[Row] = []
    for done, chapter in enumerate(chapters, start=1):
        rows += chapter()
        if progress is not None:
            progress(done, len(chapters))
    write_rows(output, rows)
    return Evidence(tuple(rows), tuple(outcomes))


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep to itself what drivers say of each of hundreds of faults."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(before)
