"""Roughness held against fields, blocks and sounds that are known."""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from tests.validation.roughness.block import block_rows
from tests.validation.roughness.fields import FULL, QUICK, RoughnessEffort, field_rows, ripple_rows
from tests.validation.roughness.sandwave import sandwave_rows
from tests.validation.roughness.sound import check_rows
from tests.validation.rows import Chapters, Request, Row

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


def chapters(request: Request) -> Chapters:
    """The chapters of roughness.

    Parameters
    ----------
    request : Request
    """
    effort = QUICK if request.quick else FULL
    return {name: partial(chapter, request.scenes, effort) for name, chapter in CHAPTERS.items()}
