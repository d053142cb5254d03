"""Every figure of the accuracy table, measured chapter by chapter."""

import os
from collections.abc import Iterable, Mapping
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from functools import partial
from multiprocessing import get_context
from pathlib import Path

from lscan.config.rigfile import load_rig
from lscan.files.disk import list_names
from lscan.records import Progress
from sim.validation.accuracy.chapters import CHAPTERS, Chapter
from sim.validation.accuracy.effort import FULL, QUICK, AccuracyEffort
from sim.validation.accuracy.photographs import photograph_rows
from sim.validation.rows import Row, RowFile, measured

BEST = ("board", "groove", "sandwave")


def run_accuracy(
    scenes: Path,
    photographs: Path | None,
    output: Path,
    quick: bool = False,
    progress: Progress | None = None,
) -> list[Row]:
    """The rows, also written as a JSON list, chapter by chapter.

    A chapter that ends with an error is a failed row.

    Parameters
    ----------
    scenes : Path, folder of the scene files
    photographs : Path or None, folder of the real pictures, whose chapter is skipped where it is
        None
    output : Path, the JSON file
    quick : bool, every row, with the least effort
    progress : Progress or None, called with (done, all) after each chapter

    Raises
    ------
    InputError
        A scene file is wrong, ``photographs`` is not there, or the disk refuses.
    """
    if photographs is not None:
        list_names(photographs)  # refuses a folder that is not there
    for name in BEST:
        load_rig(scenes / "best" / f"{name}.toml")  # refuses a bad file before minutes of work
    file = RowFile(output, quick)
    effort = QUICK if quick else FULL
    chapters: dict[str, Chapter] = dict(CHAPTERS)
    if photographs is not None:
        chapters["photographs"] = partial(photograph_rows, photographs)
    places = list(chapters)
    for done, (name, rows) in enumerate(measure(chapters, scenes, effort), start=1):
        file.add(rows, places.index(name))
        if progress is not None:
            progress(done, len(chapters))
    return file.rows


def measure(
    chapters: Mapping[str, Chapter], scenes: Path, effort: AccuracyEffort
) -> Iterable[tuple[str, list[Row]]]:
    """Name and rows of each chapter as it ends; as many run side by side as processors."""
    workers = max(1, min(len(chapters), len(os.sched_getaffinity(0))))
    # Spawned, not forked: Dr.Jit's threads do not survive a fork.
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        futures: dict[Future[list[Row]], str] = {
            pool.submit(chapter, scenes, effort): name for name, chapter in chapters.items()
        }
        for future in as_completed(futures):
            yield futures[future], measured(futures[future], future.result)
