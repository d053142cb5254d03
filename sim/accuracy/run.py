"""Every figure of the accuracy table, measured chapter by chapter."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

from lscan.disk import make_folder
from lscan.rig import load_rig
from sim.accuracy.chapters import CHAPTERS, Chapter
from sim.verify.rows import Row, write_rows

Progress = Callable[[int, int], None]
BEST = ("board", "groove", "sandwave")


def run_accuracy(
    scenes: Path, photographs: Path, output: Path, progress: Progress | None = None
) -> list[Row]:
    """The rows, also written to ``output`` as a JSON list.

    scenes: folder of the scene files.  photographs: of the real pictures, whose rows are left
    out where it is not there.  progress: told (done, all) after each chapter.  Raises
    InputError where a scene file is wrong or the disk refuses.
    """
    for name in BEST:
        load_rig(scenes / "best" / f"{name}.toml")  # refuses a bad file before minutes of work
    make_folder(output.parent)
    rows = measure(list(CHAPTERS.values()), scenes, photographs, progress)
    write_rows(output, rows)
    return rows


def measure(
    chapters: Sequence[Chapter], scenes: Path, photographs: Path, progress: Progress | None = None
) -> list[Row]:
    """The chapters' rows in their order; as many run side by side as there are processors."""
    workers = max(1, min(len(chapters), len(os.sched_getaffinity(0))))
    rows: list[Row] = []
    # Spawned, not forked: Dr.Jit's threads do not survive a fork.
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        futures = [pool.submit(chapter, scenes, photographs) for chapter in chapters]
        for done, future in enumerate(futures, start=1):
            rows += future.result()
            if progress is not None:
                progress(done, len(futures))
    return rows
