"""The instrument in pictures, waters and on surfaces unlike the paper's."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

from tests.validation.rows import Chapters, Request, Row
from tests.validation.surfaces.boards import board_rows
from tests.validation.surfaces.drawn import FULL, QUICK, FieldEffort
from tests.validation.surfaces.harbor import harbor_rows
from tests.validation.surfaces.line import line_rows
from tests.validation.surfaces.relief import relief_rows, sigma_rows
from tests.validation.surfaces.sheet import sheet_rows
from tests.validation.surfaces.surface import surface_rows
from tests.validation.surfaces.water import water_rows

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


def chapters(request: Request) -> Chapters:
    """The chapters of the field's figures.

    Parameters
    ----------
    request : Request
    """
    effort = replace(QUICK if request.quick else FULL, photographs=request.photographs)
    return {name: partial(chapter, request.scenes, effort) for name, chapter in CHAPTERS.items()}
