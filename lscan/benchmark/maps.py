"""Every plane map on every board at several noises: rms and largest error, and its time."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from lscan.benchmark.boards import BOARDS, OPTICS, image_px, reading_of
from lscan.benchmark.extractors import share_within
from lscan.benchmark.timing import timed
from lscan.calibration.planemap import PlaneMap, find_solver
from lscan.config.board import Board
from lscan.config.rig import OpticsSection
from lscan.errors import BoardNotFound, InputError
from lscan.records import BoardReading, Floats, Status

NOISES_PX = (0.0, 0.015, 0.1)  # exact, a good picture's, a poor one's
PLACES = 4000  # at which a map is judged
POINTS = 640  # of the profile whose time is taken


Solve = Callable[[BoardReading, OpticsSection], PlaneMap]


@dataclass(frozen=True)
class MapRow:
    """One plane map on one board and noise.

    rms_mm, max_mm: distance from the truth over the covered part of the sheet, the rms over
    all draws and the largest of all.  within_3_sigma: share of the errors of x and of z within
    three of the sigmas stated.  covered: share of the board within the map.
    ms_solve, ms_profile: median milliseconds to solve it and to map 640 points.
    refused: why there is no map; the figures are NaN then.
    """

    plane_map: str
    board: str
    noise_px: float
    rms_mm: float
    max_mm: float
    within_3_sigma: float
    covered: float
    ms_solve: float
    ms_profile: float
    refused: str = ""


def board_cases(quick: bool = False) -> Iterator[tuple[str, float]]:
    """Every board and noise of its marks in px; the paper's board alone where ``quick``."""
    for label in ("paper",) if quick else BOARDS:
        for noise in NOISES_PX:
            yield label, noise


def bench_maps(
    names: Sequence[str],
    seed: int = 1,
    draws: int = 5,
    quick: bool = False,
    progress: Callable[[int], None] | None = None,
) -> list[MapRow]:
    """A row for each map, board and noise, all maps on the same readings.

    Parameters
    ----------
    names : sequence of str
        Full names of plane maps, such as "polynomial-5".
    seed : int
        Of the marks' noise.
    draws : int
        Readings of each board at each noise.
    quick : bool
        The paper's board alone.
    progress : callable, optional
        Called with how many boards at a noise are done.

    Returns
    -------
    list of MapRow

    Raises
    ------
    InputError
        For a map that does not exist.
    """
    solvers = {name: find_solver(name) for name in names}
    rows = []
    for done, (label, noise) in enumerate(board_cases(quick), start=1):
        board, number = BOARDS[label], list(BOARDS).index(label)
        places = _places(board, np.random.default_rng([seed, number]))
        generator = np.random.default_rng([seed, number, round(1e4 * noise)])
        count = 1 if noise == 0 else draws
        readings = [reading_of(board, noise, generator) for _ in range(count)]
        rows += [_row(name, solvers[name].solve, label, noise, readings, places) for name in names]
        if progress is not None:
            progress(done)
    return rows


def _row(
    name: str,
    solve: Solve,
    board: str,
    noise_px: float,
    readings: Sequence[BoardReading],
    places: Floats,
) -> MapRow:
    pixels = image_px(places)
    nan = float("nan")
    errors, ratios, covered, solving, mapping = [], [], [], [], []
    for reading in readings:
        try:
            seconds, solved = timed(partial(solve, reading, OPTICS))
        except (InputError, BoardNotFound) as refusal:
            return MapRow(name, board, noise_px, nan, nan, nan, 0.0, nan, nan, str(refusal))
        solving.append(seconds)
        answer = solved.to_plane(pixels)
        known = answer.status == Status.OK
        error_mm = answer.xz_mm[known] - places[known]
        errors.append(np.linalg.norm(error_mm, axis=1))
        ratios.append(np.abs(error_mm) / answer.sigma_mm[known])
        covered.append(float(known.mean()))
        profile = partial(solved.to_plane, pixels[:POINTS], np.full(POINTS, 0.05))
        mapping.append(timed(profile)[0])
    error, ratio = np.concatenate(errors), np.concatenate(ratios)
    if len(error) == 0:
        error = ratio = np.array([nan])
    return MapRow(
        plane_map=name,
        board=board,
        noise_px=noise_px,
        rms_mm=float(np.sqrt(np.mean(error**2))),
        max_mm=float(error.max()),
        within_3_sigma=share_within(3.0, ratio),
        covered=float(np.mean(covered)),
        ms_solve=1e3 * float(np.median(solving)),
        ms_profile=1e3 * float(np.median(mapping)),
    )


def _places(board: Board, generator: np.random.Generator) -> Floats:
    """(PLACES, 2) of (x, z) mm, even over the board between its outermost control points."""
    grid = board.grid
    width, height = (grid.columns - 1) * grid.pitch_mm, (grid.rows - 1) * grid.pitch_mm
    return generator.random((PLACES, 2)) * np.array([width, -height])
