"""How well plane maps predict marks that they have not seen.

The marks found are dealt to folds; each fold in turn is taken off the board, the map is
solved from the others and judged on it.  Control points and ruler marks take part alike.
What a map errs by on a mark held out is mostly the noise of that mark, the same for all maps:
so maps are compared mark by mark, and those whose difference is not significant are called tied.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from time import perf_counter
from typing import Annotated

import numpy as np
from pydantic import Field

from lscan.calibration.api import NamedSolver, PlaneMap, find_solver
from lscan.calibration.readings import joined_marks, without
from lscan.calibration.stored import STRICT, Count, NotNegative
from lscan.config.rig import OpticsSection
from lscan.errors import BoardNotFound, InputError
from lscan.records import BoardReading, Floats, Ints, Progress

FOLDS = 8
FEWER_FOLDS = {"refractive": 2}
"""Families whose solution takes long: so many folds are taken off the board together."""

COMPLETE = 0.95  # of the marks that any map values, which the best must value too
SAME = 1e-6  # of the pitch: marks closer on the board are one mark and share a fold


@dataclass(frozen=True)
class Score:
    """How a map did on the marks held out of it.

    Attributes
    ----------
    name : str, full name of the map
    rms_mm, max_mm : float, mm, distance from the nominal place, over the marks that got a value
    sigma_mm : float, mm, standard uncertainty that the map states of itself at those places, the
        marks' own left out: rms of the two coordinates together
    tied : bool, whether its mean squared error is no more than one standard error above the least
    points : int, how many marks got a value
    without_value : int, how many did not, because they lie beyond what the other marks cover or
        where the map has gaps
    ms : float or None, ms, median time of one solution; None where it was not kept
    refused : str or None, why the map could not be solved; it then has no figures
    """

    __pydantic_config__ = STRICT
    name: str
    rms_mm: NotNegative | None = None
    max_mm: NotNegative | None = None
    sigma_mm: NotNegative | None = None
    tied: Annotated[bool, Field(strict=True)] = False
    points: Count = 0
    without_value: Count = 0
    ms: NotNegative | None = None
    refused: str | None = None


@dataclass(frozen=True)
class Trial:
    """How a map did, mark by mark.

    Attributes
    ----------
    score : Score, mm
    square : (N,) array, mm², squared error on each mark; NaN where it has none
    solved : PlaneMap or None, the map from all marks, where the folds' solutions began at it
    """

    score: Score
    square: Floats
    solved: PlaneMap | None = None


def try_maps(
    reading: BoardReading,
    names: Sequence[str],
    optics: OpticsSection | None = None,
    folds: int = FOLDS,
    seed: int = 0,
    progress: Progress | None = None,
) -> tuple[Trial, ...]:
    """The trial of each map named, all on the same folds, in the order of ``names``.

    A map that refuses the reading, or any part of it, is scored as refused with its reason.

    Parameters
    ----------
    reading : BoardReading, px and mm, whose marks are dealt to the folds
    names : sequence of str, full names of maps
    optics : OpticsSection, optional, what is known of the camera beforehand
    folds : int, 2 or more
    seed : int, of the generator that deals the marks
    progress : callable, optional, called with the number of maps done, and of all

    Raises
    ------
    InputError
        For fewer than two folds.

    References
    ----------
    The one-standard-error rule: Breiman, Friedman, Olshen & Stone, Classification and Regression
    Trees (1984), sec. 3.4.3.
    """
    if folds < 2:
        raise InputError("too few folds", where="folds", value=folds, allowed="2 or more")
    fold = deal(reading, folds, np.random.default_rng(seed))
    trials = []
    for done, name in enumerate(names):
        if progress is not None:
            progress(done, len(names))
        together = FEWER_FOLDS.get(name.partition("-")[0], 1) if folds > 2 else 1
        trials.append(_tried(reading, name, optics, fold // together))
    return _with_ties(trials)


def deal(reading: BoardReading, folds: int, rng: np.random.Generator) -> Ints:
    """(N,) the fold of each mark: first the grid's, then each ruler's, found or not.

    Places on the board are gone through column by column; of any ``folds`` in succession,
    each goes to another fold.  So no fold takes two neighbours or a whole border away, but
    for chance at the ends of columns.  Marks at one place share a fold: they hold the same
    error, and one would betray the other.

    Parameters
    ----------
    reading : BoardReading, of N marks
    folds : int, 2 or more
    rng : Generator, of NumPy, which deals
    """
    places = joined_marks(reading).board_mm
    steps = np.round(places / (SAME * reading.pitch_mm)).astype(np.int64)
    different, place = np.unique(steps, axis=0, return_inverse=True)
    rounds = -(-len(different) // folds)
    dealt = np.concatenate([rng.permutation(folds) for _ in range(rounds)])
    return dealt[: len(different)][place.ravel()]


def _tried(reading: BoardReading, name: str, optics: OpticsSection | None, fold: Ints) -> Trial:
    try:
        return _judged(reading, find_solver(name), optics, fold)
    except (InputError, BoardNotFound) as refusal:
        return Trial(Score(name, refused=str(refusal)), np.full(len(fold), np.nan))


def _judged(
    reading: BoardReading, solver: NamedSolver, optics: OpticsSection | None, fold: Ints
) -> Trial:
    marks = joined_marks(reading)
    error, sigma = np.full((2, len(fold), 2), np.nan)
    whole, ms = None, []
    if solver.searches:
        whole, whole_ms = _timed(solver, reading, optics)
        solver = solver.near(whole)
    for number in np.unique(fold[marks.found]):
        held_out = marks.found & (fold == number)
        plane_map, fold_ms = _timed(solver, without(reading, held_out), optics)
        ms.append(fold_ms if whole is None else whole_ms)
        points = plane_map.to_plane(marks.image_px[held_out])
        error[held_out], sigma[held_out] = points.xz_mm - marks.board_mm[held_out], points.sigma_mm
    square, stated = (error**2).sum(axis=1), (sigma**2).sum(axis=1)
    score = _summary(solver.name, square[marks.found], stated[marks.found], float(np.median(ms)))
    return Trial(score, square, whole)


def _timed(
    solver: NamedSolver, reading: BoardReading, optics: OpticsSection | None
) -> tuple[PlaneMap, float]:
    """The map solved from a reading, and the milliseconds it took."""
    start = perf_counter()
    solved = solver.solve(reading, optics)
    return solved, 1e3 * (perf_counter() - start)


def _summary(name: str, square: Floats, stated: Floats, ms: float) -> Score:
    valued = np.isfinite(square)
    if not valued.any():
        return Score(name, without_value=len(square), ms=ms, refused="gives no mark a value")
    return Score(
        name=name,
        rms_mm=float(np.sqrt(square[valued].mean())),
        max_mm=float(np.sqrt(square[valued].max())),
        sigma_mm=float(np.sqrt(stated[valued].mean())),
        points=int(valued.sum()),
        without_value=int((~valued).sum()),
        ms=ms,
    )


def _with_ties(trials: Sequence[Trial]) -> tuple[Trial, ...]:
    """The trials, those tied with the least error among the complete marked.

    The one-standard-error rule (Breiman, Friedman, Olshen & Stone, Classification and
    Regression Trees (1984), sec. 3.4.3), here with the standard error of the mean difference
    of the squared errors, mark by mark: the marks' own noise is in both and drops out.
    """
    most = max((trial.score.points for trial in trials), default=0)
    complete = [t for t in trials if t.score.points > 0 and t.score.points >= COMPLETE * most]
    if not complete:
        return tuple(trials)
    best = min(complete, key=lambda trial: trial.score.rms_mm or 0.0)
    return tuple(
        replace(t, score=replace(t.score, tied=_is_tied(t.square - best.square))) for t in trials
    )


def _is_tied(more: Floats) -> bool:
    more = more[np.isfinite(more)]
    return len(more) > 1 and bool(more.mean() <= more.std(ddof=1) / np.sqrt(len(more)))
