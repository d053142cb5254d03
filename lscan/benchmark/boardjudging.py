"""Readers of control points and plane maps judged on a suite's pictures of the calibration board.

Each coordinate of a mark, or of a place on the sheet, counts as a column of a line does: the sums
are those of extractors, and so are the table and the comparison of two runs.
"""

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, cast

import numpy as np

from lscan.benchmark.judging import SURE, CaseSums, JudgedExtractor, normal_score, reference_seconds
from lscan.board import read_board
from lscan.calibration.planemap import PlaneMap, find_solver, joined_marks
from lscan.config.board import Board
from lscan.config.plugins import find_plugin_or_function, names_code, raised
from lscan.config.rig import OpticsSection
from lscan.errors import InputError, LscanError
from lscan.records import BoardReading, Bytes, Floats, Marks, Mask, Status
from lscan.suites import BoardCase

READERS = "lscan.boardreaders"
WRONG_PX = 2.0  # off, and a reader's mark is another thing: dots are four pixels wide and more
WRONG_PITCHES = 0.1  # off, and a place of a map is wrong
BoardReader = Callable[[Bytes, Board], BoardReading]
MapSolver = Callable[[BoardReading, OpticsSection], PlaneMap]


def judge_boards(
    readers: Sequence[str],
    maps: Sequence[str],
    cases: Iterable[BoardCase],
    step: Callable[[], None] = lambda: None,
) -> tuple[list[JudgedExtractor], float]:
    """Each reader, in px, and each plane map, in mm, on each picture of the board.

    A map is solved from the control points that lscan's own reader finds.

    Parameters
    ----------
    readers : sequence of str, names of the group lscan.boardreaders, or ``package.module:function``
    maps : sequence of str, plane maps, such as polynomial-5, or ``package.module:function`` of a
        reading and the optics
    cases : iterable
    step : callable, called after each case

    Returns
    -------
    One record for each reader and map, and the median seconds of the reference workload.

    Raises
    ------
    InputError
        There is no such reader or map, or one fails other than by an error of lscan's.
    """
    reading = {name: cast(BoardReader, find_plugin_or_function(READERS, name)) for name in readers}
    solving = {name: _map_solver(name) for name in maps}
    sums: dict[str, dict[str, CaseSums]] = {name: {} for name in (*readers, *maps)}
    reference = []
    for case in cases:
        reference.append(reference_seconds())
        for name, reader in reading.items():
            sums[name][case.name] = judge_reader(name, reader, case)
        own, _ = _tried("read_board", read_board, case.picture, case.board) if maps else (None, 0.0)
        for name, solver in solving.items():
            sums[name][case.name] = judge_map(name, solver, own, case)
        step()
    judged = [
        JudgedExtractor(
            name, of, (), f"--boards {'--reader' if name in reading else '--map'} {name}"
        )
        for name, of in sums.items()
    ]
    return judged, float(np.median(reference or [np.nan]))


def _map_solver(name: str) -> MapSolver:
    if names_code(name):
        return cast(MapSolver, find_plugin_or_function("lscan.planemaps", name))
    return find_solver(name).solve


def judge_reader(name: str, reader: BoardReader, case: BoardCase) -> CaseSums:
    """The sums of one picture, px; none of its marks is found where the reader refuses.

    Parameters
    ----------
    name : str, for errors
    reader : callable
    case : BoardCase
    """
    true = case.marks
    found, seconds = _tried(name, reader, case.picture, case.board)
    places, sigma = np.full_like(true.image_px, np.nan), np.full(len(true.status), np.nan)
    if found is not None:
        places, sigma = _all_marks(name, found, true)
    shown = true.status == Status.OK
    valued = np.isfinite(places[:, 0] + places[:, 1])
    error = np.where(shown[:, np.newaxis], places - true.image_px, np.nan)
    return coordinate_sums(shown, valued, error, np.column_stack([sigma, sigma]), WRONG_PX, seconds)


def judge_map(
    name: str, solve: MapSolver, reading: BoardReading | None, case: BoardCase
) -> CaseSums:
    """The sums of one picture, mm, of the map that is solved from what was read in it.

    Parameters
    ----------
    name : str, for errors
    solve : callable, of a reading and the optics
    reading : BoardReading or None where none could be had
    case : BoardCase
    """
    solved, seconds = None, 0.0
    if reading is not None:
        solved, seconds = _tried(name, solve, reading, case.optics)
    return map_sums(solved, case, seconds)


def map_sums(solved: PlaneMap | None, case: BoardCase, seconds: float) -> CaseSums:
    """The sums of a plane map, mm, over the board between its outermost control points.

    Parameters
    ----------
    solved : PlaneMap or None where none could be had
    case : BoardCase
    seconds : float, that it took
    """
    places, sigma = np.full_like(case.map_mm, np.nan), np.full_like(case.map_mm, np.nan)
    if solved is not None:
        answer = solved.to_plane(case.map_px)
        known = answer.status == Status.OK
        places[known], sigma[known] = answer.xz_mm[known], answer.sigma_mm[known]
    whole = np.ones(len(places), dtype=bool)
    valued = np.isfinite(places[:, 0] + places[:, 1])
    limit = WRONG_PITCHES * case.board.grid.pitch_mm
    return coordinate_sums(whole, valued, places - case.map_mm, sigma, limit, seconds)


def _tried(name: str, tried: Callable[..., Any], *given: Any) -> tuple[Any, float]:
    """What a callable returns, None where it refuses, and its seconds."""
    began = time.process_time()
    try:
        found = tried(*given)
    except LscanError:
        found = None
    except Exception as error:  # a stranger's may raise anything
        raise InputError(f"{name} failed: {raised(error)}", where="bench") from error
    return found, time.process_time() - began


def _all_marks(name: str, found: BoardReading, true: Marks) -> tuple[Floats, Floats]:
    """(N, 2) px and (N,) their sigmas, of control points and rulers' marks in the case's order."""
    marks = joined_marks(found)
    if len(marks.status) != len(true.status):
        raise InputError(f"{name} gave another number of marks", where="bench",
                         value=len(marks.status), allowed=len(true.status))  # fmt: skip
    return np.where(marks.found[:, np.newaxis], marks.image_px, np.nan), marks.sigma_px


def coordinate_sums(
    shown: Mask, valued: Mask, error: Floats, sigma: Floats, limit: float, seconds: float
) -> CaseSums:
    """The sums over coordinates; a value of what is not shown is a ghost.

    Parameters
    ----------
    shown, valued : (N,) array, whether a mark or point is to be seen, and whether it has a value
    error, sigma : (N, C) array, px or mm, of its C coordinates
    limit : float, of the error's length, beyond which a value is wrong
    seconds : float, that it took
    """
    both = shown & valued
    off = np.where(both[:, np.newaxis], error, 0.0)
    spread = np.where(both[:, np.newaxis] & (sigma > 0), sigma, 1e-9)
    z = np.abs(off) / spread
    wrong = both & (np.linalg.norm(off, axis=1) > limit)
    core = both & ~wrong
    each = float(error.shape[1])
    counts: Mapping[str, float] = {
        "clear": each * shown.sum(),
        "missed": each * (shown & ~valued).sum(),
        "valued": each * both.sum(),
        "honest": float((z[both] <= 3).sum()),
        "outlying": each * wrong.sum(),
        "sure": each * (z[wrong] > SURE).any(axis=1).sum(),
        "core": each * core.sum(),
        "error": float(off[core].sum()),
        "square": float((off[core] ** 2).sum()),
        "log_z": float(np.log(np.maximum(z[core], 1e-3)).sum()),
        "dark": each * (~shown).sum(),
        "ghosts": each * (~shown & valued).sum(),
        "seconds": seconds,
        "score": float((spread * normal_score(z))[core].sum()),
    }
    return CaseSums(**counts)
