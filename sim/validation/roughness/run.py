"""Every figure of the roughness table, measured chapter by chapter."""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from lscan.records import Progress
from sim.validation.chapters import run_chapters
from sim.validation.roughness.block import block_rows
from sim.validation.roughness.effort import FULL, QUICK, RoughnessEffort
from sim.validation.roughness.fields import field_rows, ripple_rows
from sim.validation.roughness.sandwave import sandwave_rows
from sim.validation.roughness.sound import check_rows
from sim.validation.rows import Row

RoughnessChapter = Callable[[Path, RoughnessEffort], list[Row]]


def _fields(_: Path, effort: RoughnessEffort) -> list[Row]:
    return field_rows(effort)


def _ripples(_: Path, effort: RoughnessEffort) -> list[Row]:
    return ripple_rows(effort)


def _sound(_: Path, _effort: RoughnessEffort) -> list[Row]:
    return check_rows()


# The longest first: chapters run side by side, and no processor shall wait at the end.
CHAPTERS: Mapping[str, RoughnessChapter] = {
    "random fields": _fields,
    "sandwave": sandwave_rows,
    "block": block_rows,
    "ripples": _ripples,
    "sound": _sound,
}


def run_roughness(
    scenes: Path, output: Path, quick: bool = False, progress: Progress | None = None
) -> list[Row]:
    """The rows, also written as a JSON list, chapter by chapter.

    A chapter that ends with an error is a failed row.

    Parameters
    ----------
    scenes : Path, folder of the scene files
    output : Path, the JSON file
    quick : bool, every row, with the least effort
    progress : Progress or None, called with (done, all) after each chapter

    Raises
    ------
    InputError
        The disk refuses.
    """
    effort = QUICK if quick else FULL
    work = {name: partial(chapter, scenes, effort) for name, chapter in CHAPTERS.items()}
    return run_chapters(work, output, quick, progress)
