"""The whole run: measure every chapter, then write the figures and the page."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from lscan.disk import make_folder
from sim.verify.chapters import chapters
from sim.verify.gallery import Plate, gallery, scene_files
from sim.verify.report import write_page
from sim.verify.rows import Check, Row, rows_of, write_rows

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Evidence:
    """What a run found: its checks, the pictures of the scenes, and how long it took."""

    checks: tuple[Check, ...]
    plates: tuple[Plate, ...]
    seconds: float
    full: bool

    @property
    def rows(self) -> list[Row]:
        """All rows, in the order of the page."""
        return rows_of(self.checks)

    @property
    def passed(self) -> bool:
        """Whether every figure is within its bar."""
        return all(row.passed for row in self.rows)


def run_verify(
    folder: Path, full: bool = False, scenes: Path | None = None, progress: Progress | None = None
) -> Evidence:
    """The evidence, also written to ``folder`` as verify.json and report.html.

    full: with the slow half and one picture of each scene file beneath ``scenes``.
    progress: told (done, all) after each chapter.  Raises InputError where the disk refuses
    or a scene file is wrong.
    """
    if full and scenes is not None:
        scene_files(scenes)  # refuses a folder that is not there before minutes of work
    make_folder(folder)
    started = time.perf_counter()
    checks = []
    measures = chapters(full)
    for done, measure in enumerate(measures.values(), start=1):
        checks.append(measure())
        if progress is not None:
            progress(done, len(measures))
    plates = gallery(scenes) if full and scenes is not None else ()
    evidence = Evidence(tuple(checks), plates, time.perf_counter() - started, full)
    write_rows(folder / "verify.json", evidence.rows)
    write_page(folder / "report.html", evidence.checks, plates, evidence.seconds)
    return evidence
