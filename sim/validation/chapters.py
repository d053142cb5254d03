"""The chapters of a figures table, measured side by side or in turn and written as they end."""

import os
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from functools import partial
from multiprocessing import get_context
from pathlib import Path

from lscan.acquisition.scan import cores
from lscan.config.rig import load_rig
from lscan.files.disk import make_folder
from lscan.records import Progress
from sim.render.backend import THREADS
from sim.validation.rows import Row, RowFile, measured

Chapters = Mapping[str, Callable[[], list[Row]]]


def run_chapters(
    chapters: Chapters,
    output: Path,
    quick: bool = False,
    progress: Progress | None = None,
) -> list[Row]:
    """The rows of all chapters, in their order; the file always holds all measured so far.

    As many chapters run side by side as there are processors, in processes of their own; those of
    a quick run take turns in this one, since to import and load the renderer anew takes longer
    than most of them.  A chapter that ends with an error is a failed row.

    Parameters
    ----------
    chapters : mapping of str to callable, which can be pickled; the longest first, so that no
        processor waits at the end
    output : Path, the JSON file
    quick : bool, whether the rows are marked as those of a quick run
    progress : Progress or None, called with (done, all) after each chapter

    Raises
    ------
    InputError
        The disk refuses.
    """
    file = RowFile(output, quick)
    if quick:
        return in_turn(chapters, file, progress)
    places = list(chapters)
    workers = max(1, min(len(chapters), cores()))
    # Spawned, not forked: Dr.Jit's threads do not survive a fork.
    spawned = get_context("spawn")
    with ProcessPoolExecutor(workers, spawned, partial(_share_threads, workers)) as pool:
        futures: dict[Future[list[Row]], str] = {
            pool.submit(chapter): name for name, chapter in chapters.items()
        }
        for done, future in enumerate(as_completed(futures), start=1):
            name = futures[future]
            file.add(measured(name, future.result), places.index(name))
            if progress is not None:
                progress(done, len(chapters))
    return file.rows


def runs_folder(scenes: Path, output: Path) -> Path:
    """The folder of a table's runs beside its file, made: the file's path without its ending.

    Parameters
    ----------
    scenes : Path, folder of the scenes of board and sandwave, of which a bad one is refused first
    output : Path, the JSON file

    Raises
    ------
    InputError
        A scene file is wrong, or the disk refuses.
    """
    for name in ("board", "sandwave"):
        load_rig(scenes / f"{name}.toml")
    folder = output.with_suffix("") if output.suffix else output.with_name(f"{output.name}-runs")
    make_folder(folder)
    return folder


def in_turn(chapters: Chapters, file: RowFile, progress: Progress | None = None) -> list[Row]:
    """The rows of all chapters, measured one after the other and added to the file.

    Parameters
    ----------
    chapters : mapping of str to callable; one that ends with an error is a failed row
    file : RowFile, to which rows are added as they are measured
    progress : Progress or None, called with (done, all) after each chapter
    """
    for done, (name, chapter) in enumerate(chapters.items(), start=1):
        file.add(measured(name, chapter))
        if progress is not None:
            progress(done, len(chapters))
    return file.rows


def _share_threads(workers: int) -> None:
    """Leave Dr.Jit's threads of the other chapters to them, before it is loaded."""
    os.environ.setdefault(THREADS, str(max(1, cores() // workers)))
