"""Every figure of the field table, measured chapter by chapter."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

from lscan.files.disk import list_names
from lscan.records import Progress
from sim.validation.chapters import run_chapters
from sim.validation.field.boards import board_rows
from sim.validation.field.effort import FULL, QUICK, FieldEffort
from sim.validation.field.harbor import harbor_rows
from sim.validation.field.line import line_rows
from sim.validation.field.relief import relief_rows
from sim.validation.field.sheet import sheet_rows
from sim.validation.field.sigma import sigma_rows
from sim.validation.field.surface import surface_rows
from sim.validation.field.water import water_rows
from sim.validation.rows import Row

FieldChapter = Callable[[Path, FieldEffort], list[Row]]

# The longest first: chapters run side by side, and no processor shall wait at the end.
CHAPTERS: Mapping[str, FieldChapter] = {
    "relief": relief_rows,
    "any surface": surface_rows,
    "line": line_rows,
    "harbor": harbor_rows,
    "boards": board_rows,
    "sigma": sigma_rows,
    "refractive map in other water": partial(water_rows, name="refractive"),
    "metric map in other water": partial(water_rows, name="metric"),
    "metric route with glare": sheet_rows,
}


def run_field(
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
    photographs : Path or None, folder of the real pictures, whose rows are left out where it is
        None
    output : Path, the JSON file
    quick : bool, every row, with the least effort
    progress : Progress or None, called with (done, all) after each chapter

    Raises
    ------
    InputError
        ``photographs`` is not there, or the disk refuses.
    """
    if photographs is not None:
        list_names(photographs)  # refuses a folder that is not there
    effort = replace(QUICK if quick else FULL, photographs=photographs)
    work = {name: partial(chapter, scenes, effort) for name, chapter in CHAPTERS.items()}
    return run_chapters(work, output, quick, progress)
