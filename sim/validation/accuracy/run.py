"""Every figure of the accuracy table, measured chapter by chapter."""

from functools import partial
from pathlib import Path

from lscan.config.rig import load_rig
from lscan.files.disk import list_names
from lscan.records import Progress
from sim.validation.accuracy.chapters import CHAPTERS, Chapter
from sim.validation.accuracy.effort import FULL, QUICK
from sim.validation.accuracy.photographs import photograph_rows
from sim.validation.chapters import run_chapters
from sim.validation.rows import Row

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
    chapters: dict[str, Chapter] = dict(CHAPTERS)
    if photographs is not None:
        chapters["photographs"] = partial(photograph_rows, photographs)
    effort = QUICK if quick else FULL
    work = {name: partial(chapter, scenes, effort) for name, chapter in chapters.items()}
    return run_chapters(work, output, quick, progress)
