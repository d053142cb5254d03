"""How well plane maps predict marks that they have not seen.

The marks found are dealt to folds; each fold in turn is taken off the board, the map is
solved from the others and judged on it.  Control points and ruler marks take part alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np

from lscan.errors import BoardNotFound, InputError
from lscan.planemap.api import find_solver
from lscan.records import BoardReading, Floats, Ints, Marks, Mask, Status
from lscan.rig import OpticsSection

FOLDS = 8
SAME = 1e-6  # of the pitch: marks closer on the board are one mark and share a fold


@dataclass(frozen=True)
class Score:
    """How a map did on the marks held out of it.

    rms_mm, max_mm: distance from the nominal place, over the marks that got a value.
    points: how many did.  without_value: how many did not, because they lie beyond what the
        other marks cover or where the map has gaps.
    ms: median time of one solution; None where it was not kept.
    refused: why the map could not be solved; it then has no figures.
    """

    name: str
    rms_mm: float | None = None
    max_mm: float | None = None
    points: int = 0
    without_value: int = 0
    ms: float | None = None
    refused: str | None = None


def cross_validated(
    reading: BoardReading,
    names: Sequence[str],
    optics: OpticsSection | None = None,
    folds: int = FOLDS,
    seed: int = 0,
) -> tuple[Score, ...]:
    """The score of each map named, all on the same folds, in the order of ``names``.

    A map that refuses the reading, or any part of it, is scored as refused with its reason.
    seed: of the generator that deals the marks.  Raises InputError for fewer than two folds.
    """
    if folds < 2:
        raise InputError("too few folds", where="folds", value=folds, allowed="2 or more")
    fold = deal(reading, folds, np.random.default_rng(seed))
    return tuple(_score(reading, name, optics, fold) for name in names)


def deal(reading: BoardReading, folds: int, rng: np.random.Generator) -> Ints:
    """(N,) the fold of each mark: first the grid's, then each ruler's, found or not.

    Places on the board are gone through column by column; of any ``folds`` in succession,
    each goes to another fold.  So no fold takes two neighbours or a whole border away, but
    for chance at the ends of columns.  Marks at one place share a fold: they hold the same
    error, and one would betray the other.
    """
    places = np.vstack([marks.board_mm for marks in _all_marks(reading)])
    steps = np.round(places / (SAME * reading.pitch_mm)).astype(np.int64)
    different, place = np.unique(steps, axis=0, return_inverse=True)
    rounds = -(-len(different) // folds)
    dealt = np.concatenate([rng.permutation(folds) for _ in range(rounds)])
    return dealt[: len(different)][place.ravel()]


def without(reading: BoardReading, held_out: Mask) -> BoardReading:
    """The reading as if the marks held out, (N,) in the order of ``deal``, were not found."""
    taken = iter(np.split(held_out, np.cumsum([len(m.status) for m in _all_marks(reading)])))
    grid = _hidden(reading.grid, next(taken))
    rulers = [replace(ruler, marks=_hidden(ruler.marks, next(taken))) for ruler in reading.rulers]
    return replace(reading, grid=grid, rulers=tuple(rulers))


def _all_marks(reading: BoardReading) -> list[Marks]:
    return [reading.grid, *(ruler.marks for ruler in reading.rulers)]


def _hidden(marks: Marks, hide: Mask) -> Marks:
    hide = hide & marks.found
    return Marks(
        board_mm=marks.board_mm,
        image_px=np.where(hide[:, None], np.nan, marks.image_px),
        sigma_px=np.where(hide, np.nan, marks.sigma_px),
        status=np.where(hide, int(Status.NOT_FOUND), marks.status),
    )


def _score(reading: BoardReading, name: str, optics: OpticsSection | None, fold: Ints) -> Score:
    found = np.concatenate([marks.found for marks in _all_marks(reading)])
    times, error = [], np.full((len(fold), 2), np.nan)
    for number in np.unique(fold[found]):
        held_out = found & (fold == number)
        start = perf_counter()
        try:
            plane_map = find_solver(name).solve(without(reading, held_out), optics)
        except (InputError, BoardNotFound) as refusal:
            return Score(name, refused=str(refusal))
        times.append(1e3 * (perf_counter() - start))
        image = np.vstack([marks.image_px for marks in _all_marks(reading)])[held_out]
        known = np.vstack([marks.board_mm for marks in _all_marks(reading)])[held_out]
        error[held_out] = plane_map.to_plane(image).xz_mm - known
    return _summary(name, error[found], float(np.median(times)))


def _summary(name: str, error: Floats, ms: float) -> Score:
    distance = np.hypot(*error.T)
    valued = np.isfinite(distance)
    if not valued.any():
        return Score(name, without_value=len(error), ms=ms, refused="gives no mark a value")
    return Score(
        name=name,
        rms_mm=float(np.sqrt(np.mean(distance[valued] ** 2))),
        max_mm=float(distance[valued].max()),
        points=int(valued.sum()),
        without_value=int((~valued).sum()),
        ms=ms,
    )
