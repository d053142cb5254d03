"""Every extractor on drawn lines, every map on drawn boards, and the limits they must keep."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import TypeVar

import numpy as np

from lscan.benchmark import drawn
from lscan.calibration.planemap import PlaneMap, find_solver
from lscan.config.board import Board
from lscan.config.rig import NoiseSection, OpticsSection, StripeSection
from lscan.errors import BoardNotFound, InputError
from lscan.records import BoardReading, Floats, Status, Stripe, has_value
from lscan.stripe import extract_stripe
from lscan.stripe.fit import centre_bound_px
from lscan.stripe.picture import stated_noise

# How long a call takes, by the clock that only runs forwards.

Result = TypeVar("Result")


def time_call(call: Callable[[], Result]) -> tuple[float, Result]:
    """Seconds of a call, and what it returns.

    Parameters
    ----------
    call : callable, called once

    Examples
    --------
    >>> seconds, total = time_call(lambda: sum(range(10)))
    >>> total, seconds < 1
    (45, True)
    """
    started = time.perf_counter()
    result = call()
    return time.perf_counter() - started, result


def median_seconds(call: Callable[[], object], repeats: int) -> float:
    """Median seconds of a call.

    Parameters
    ----------
    call : callable
        Takes nothing; what it returns is not used.
    repeats : int
        Calls that are timed, after a first one that is not.

    Returns
    -------
    float
    """
    call()
    return float(np.median([time_call(call)[0] for _ in range(repeats)]))


# Every stripe extractor on every kind of line: bias, scatter, bound, share found, speed.


WIDTHS_PX = (0.8, 1.5, 3.0)
PEAKS_DN = (20.0, 200.0, 500.0)  # dim, bright, and twice what the range holds
SENSOR = NoiseSection(read_dn=1.0, dn_per_electron=255 / 15_000)
SPECKLED = NoiseSection(read_dn=1.0, dn_per_electron=255 / 15_000, speckle=0.25)
THRESHOLD_DN = 8.0  # eight times the reading noise
PHASES = 16
REPEATS = 7  # of the extraction that is timed


@dataclass(frozen=True)
class ExtractorRow:
    """One extractor on one kind of line.

    bias_px: mean error.  scatter_px: standard deviation of the error.  bound_ratio: scatter
    over the Cramér-Rao bound; None for a clipped line.
    outliers: share of the errors beyond three standard deviations of the line's width.
    within_3_sigma: share of them within three of the sigmas stated; worst_z: the largest in
    units of its sigma.  found: share of the columns that got a value.
    us_a_frame: median microseconds for one picture of 640 by 480.
    Where nothing was found, the figures of the errors are NaN.
    """

    extractor: str
    case: drawn.LineCase
    bias_px: float
    scatter_px: float
    bound_ratio: float | None
    outliers: float
    within_3_sigma: float
    worst_z: float
    found: float
    us_a_frame: float


def cases(quick: bool = False) -> Iterator[drawn.LineCase]:
    """Every water, width and peak; without speckle, and the bright line with it."""
    waters = ("tap", "harbor") if quick else tuple(drawn.SKIRTS)
    widths = WIDTHS_PX[1:2] if quick else WIDTHS_PX
    for water, width, peak in product(waters, widths, PEAKS_DN):
        yield drawn.LineCase(water, width, peak, SENSOR)
    for width in widths:
        yield drawn.LineCase("tap", width, PEAKS_DN[1], SPECKLED)


def bench_extractors(
    names: Sequence[str], seed: int = 1, pictures: int = 6, quick: bool = False
) -> Iterator[ExtractorRow]:
    """A row for each case and extractor, all extractors on the same pictures.

    Parameters
    ----------
    names : sequence of str
        As in ``stripe.extractor`` of a rig file, ``package.module:function`` too.
    seed : int
        Of the pictures' noise.
    pictures : int
        Of each case.
    quick : bool
        Two waters and one width of the line alone.

    Yields
    ------
    ExtractorRow

    Raises
    ------
    InputError
        For an unknown extractor or one that fails.
    """
    times = {name: _time_us(name, seed) for name in names}
    for number, case in enumerate(cases(quick)):
        generator = np.random.default_rng([seed, number])
        phases = generator.random(pictures)
        shown = [
            (drawn.centres(phase), drawn.draw(case, drawn.centres(phase), generator))
            for phase in phases
        ]
        for name in names:
            settings = _settings(name, case)
            read = [(true, extract_stripe(image, settings)) for true, image in shown]
            yield _extractor_row(name, case, read, times[name])


def _settings(name: str, case: drawn.LineCase) -> StripeSection:
    return StripeSection(extractor=name, threshold_dn=THRESHOLD_DN, noise=case.noise)


def _extractor_row(
    name: str, case: drawn.LineCase, read: Sequence[tuple[Floats, Stripe]], us_a_frame: float
) -> ExtractorRow:
    valued = has_value(np.concatenate([stripe.status for _, stripe in read]))
    error = np.concatenate([stripe.centre_px - true for true, stripe in read])[valued]
    sigma = np.concatenate([stripe.sigma_px for _, stripe in read])[valued]
    if len(error) == 0:
        error, sigma = np.array([np.nan]), np.array([np.nan])
    scatter, z = float(error.std()), np.abs(error) / sigma
    known = not case.saturated and np.isfinite(scatter)
    return ExtractorRow(
        extractor=name,
        case=case,
        bias_px=float(error.mean()),
        scatter_px=scatter,
        bound_ratio=scatter / bound_px(case) if known else None,
        outliers=1 - share_within(3.0, np.abs(error) / case.sigma_px),
        within_3_sigma=share_within(3.0, z),
        worst_z=float(z.max()),
        found=float(valued.mean()),
        us_a_frame=us_a_frame,
    )


def share_within(limit: float, errors: Floats) -> float:
    """Share of the errors, magnitudes of any shape, up to ``limit``; NaN where one is NaN."""
    return float(np.mean(np.where(np.isnan(errors), np.nan, errors <= limit)))


def bound_px(case: drawn.LineCase) -> float:
    """The Cramér-Rao bound of a line's centre, rms over the sub-pixel phases.

    Parameters
    ----------
    case : LineCase
        A line that is not clipped.  The skirt's own shot noise is left out; for speckle the
        bound is that of normal noise of the same variance, and speckle's gamma law lets an
        extractor come a little below.

    Returns
    -------
    float
        Standard deviation, px.

    Examples
    --------
    >>> round(bound_px(drawn.LineCase("tap", 1.5, 200.0, NoiseSection(read_dn=1.0))), 4)
    0.0067
    """
    phases = (np.arange(PHASES) + 0.5) / PHASES - 0.5
    noise = stated_noise(case.noise, drawn.BACKGROUND_DN)
    return float(np.sqrt(np.mean(centre_bound_px(case.sigma_px, case.peak_dn, noise, phases) ** 2)))


def _time_us(name: str, seed: int) -> float:
    """Median microseconds for a picture of 640 by 480 with a bright line."""
    case = drawn.LineCase("tap", 1.5, 200.0, SENSOR)
    rows, columns = drawn.SHAPE
    image = np.full((480, 640), 4, dtype=np.uint8)
    line = drawn.draw(case, drawn.centres(0.3), np.random.default_rng(seed))
    image[:rows] = np.tile(line, image.shape[1] // columns)
    settings = _settings(name, case)
    return 1e6 * median_seconds(lambda: extract_stripe(image, settings), REPEATS)


# Every plane map on every board at several noises: rms and largest error, and its time.


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
    for label in ("paper",) if quick else drawn.BOARDS:
        for noise in NOISES_PX:
            yield label, noise


def bench_maps(
    names: Sequence[str], seed: int = 1, draws: int = 5, quick: bool = False
) -> Iterator[MapRow]:
    """A row for each board, noise and map, all maps on the same readings.

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

    Yields
    ------
    MapRow

    Raises
    ------
    InputError
        For a map that does not exist.
    """
    solvers = {name: find_solver(name) for name in names}
    for label, noise in board_cases(quick):
        board, number = drawn.BOARDS[label], list(drawn.BOARDS).index(label)
        places = _places(board, np.random.default_rng([seed, number]))
        generator = np.random.default_rng([seed, number, round(1e4 * noise)])
        count = 1 if noise == 0 else draws
        readings = [drawn.reading_of(board, noise, generator) for _ in range(count)]
        for name, solver in solvers.items():
            yield _map_row(name, solver.solve, label, noise, readings, places)


def _map_row(
    name: str,
    solve: Solve,
    board: str,
    noise_px: float,
    readings: Sequence[BoardReading],
    places: Floats,
) -> MapRow:
    pixels = drawn.image_px(places)
    nan = float("nan")
    errors, ratios, covered, solving, mapping = [], [], [], [], []
    for reading in readings:
        try:
            seconds, solved = time_call(partial(solve, reading, drawn.OPTICS))
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
        mapping.append(time_call(profile)[0])
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


# What every method must keep to, whoever wrote it, and which figures of a row do not.
#
# The limits are no record to beat: each says what a method must do to be of any use, and the
# simplest methods, the brightest pixel and the paper's own, keep to all of them.


LEAST_FOUND = 0.95
"""Share of columns: each holds a line, 12 standard deviations of the noise above the threshold."""

MOST_BIAS_PX = 0.5
"""Who names the right pixel and no more errs by up to half of it."""

MOST_SCATTER = 1.0
"""In standard deviations of the line's width: one photon alone determines the centre to that."""

MOST_OUTLIERS = 0.01
"""Share of centres beyond three standard deviations of the width, where 0.3 % of the light is."""

LEAST_WITHIN = 8 / 9
"""Share of errors within three stated sigmas, whatever their law, by Chebyshev's inequality."""

LEAST_WITHIN_OF_MAP = 0.5
"""The same of a map, whose errors at all places go together: one draw of the marks' noise that is
unlucky puts many beyond three sigmas, but not most."""

LEAST_COVERED = 0.95
"""Share of the board between its outermost marks; noise moves its border by less than a pixel."""

MOST_RMS_MM = 0.5
"""Half a pixel, which sees 1 mm, on boards of PITCH_MM; where marks are wider apart, more by the
square of their pitch, as is the error of interpolation along straight lines between them."""

PITCH_MM = 50.0

STANDARD_BOARD = "paper"
"""On it every map must be solved, with an honest sigma.  On others a map may be refused, and the
paper's maps, made for rulers, state what the marks' noise does to them alone."""


def failed_of_extractor(row: ExtractorRow) -> list[str]:
    """The figures of a row that are out of their limits, by name; none where all are kept.

    A line that is clipped is judged by scatter and outliers alone, over what was found of it:
    to withhold it, or to give a value of lesser quality, is an extractor's right (Status).
    """
    nothing = row.found == 0
    kept = {
        "scatter": nothing or row.scatter_px <= MOST_SCATTER * row.case.sigma_px,
        "outliers": nothing or row.outliers <= MOST_OUTLIERS,
    }
    if not row.case.saturated:
        kept = {
            "found": row.found >= LEAST_FOUND,
            "bias": nothing or abs(row.bias_px) <= MOST_BIAS_PX,
            "sigma": nothing or row.within_3_sigma >= LEAST_WITHIN,
            **kept,
        }
    return [name for name, within in kept.items() if not within]


def failed_of_map(row: MapRow) -> list[str]:
    """The figures of a row that are out of their limits, by name; none where all are kept."""
    standard = row.board == STANDARD_BOARD
    if row.refused:
        return ["refused"] if standard else []
    wider = max(1.0, drawn.BOARDS[row.board].grid.pitch_mm / PITCH_MM)
    nothing = row.covered == 0
    kept = {
        "covered": row.covered >= LEAST_COVERED,
        "rms": nothing or row.rms_mm <= MOST_RMS_MM * wider**2,
        "sigma": nothing or not standard or row.within_3_sigma >= LEAST_WITHIN_OF_MAP,
    }
    return [name for name, within in kept.items() if not within]
