"""Methods judged by the cases of a suite: each case's errors against the truth, as sums.

The sums of cases add up to those of any group of cases, and two runs of one suite are compared case
by case.  First what is common to all, then extractors by pictures of a line, readers and maps by
pictures of the board, and chains by whole scans.
"""

import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass, fields
from functools import lru_cache, partial
from heapq import nlargest
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
from scipy.special import erf

from lscan.board import read_board
from lscan.calibration.calibrate import calibrate
from lscan.calibration.check import map_for_rig
from lscan.calibration.marks import joined_marks
from lscan.calibration.planemap import PlaneMap, find_solver
from lscan.config.board import Board
from lscan.config.documents import Document, check, merge, read_document
from lscan.config.plugins import find_plugin_or_function, foreign_error, names_code
from lscan.config.rig import OpticsSection, Rig
from lscan.config.scenes import included_file
from lscan.config.targets import GroovedBlock, Sandwave
from lscan.errors import InputError, LscanError
from lscan.measure import groove_dimensions
from lscan.pipeline import build_surface, correct, finish
from lscan.records import (
    BoardReading,
    Bytes,
    Floats,
    Ints,
    Length,
    Mask,
    Profile,
    Status,
    has_value,
)
from lscan.stripe import extract_stripe, find_extractor
from lscan.suites import BoardCase, CaseTruth, ScanCase, SuiteCase
from lscan.suites.files import AnyCase
from lscan.surface.surface import Slice, sample, to_profiles

OUTLYING = 3.0  # standard deviations of the line's width, within which is 99.7 % of its light
SURE = 5.0  # stated sigmas: of a normal law a column in two million is beyond
CLEAR_OF_NOISE = 3.0  # standard deviations of noise above the threshold: a line that must be found
NEAR_PX = 6  # columns beside a line into which a lens spreads it
WORST = 10
BESIDE_PX = (16, 12)  # of a column's picture: to either side along the line, and across
REFERENCE_SHAPE = (160, 320)
REFERENCE_EVERY = 10  # cases


@dataclass(frozen=True)
class CaseSums:
    """Sums over columns; those of a true line but for ``dark`` and ``ghosts``.

    clear: that must get a value; missed: those of them without one.  valued: with a value, honest:
    within three of its sigmas, outlying: beyond three widths of the line, sure: those of them that
    say they are not.  core: clear ones with a value that is not outlying; of these error and
    square, px and px², bound: square of the least standard deviation that pixel noise allows, px²,
    and log_z: of ln |error / sigma|.  dark: without a line in them or near; ghosts: those of them
    that got a value nevertheless.  seconds: of a processor, for the extraction.  score: of the
    sigmas of core, px: the continuous ranked probability score.
    """

    clear: float = 0.0
    missed: float = 0.0
    valued: float = 0.0
    honest: float = 0.0
    outlying: float = 0.0
    sure: float = 0.0
    core: float = 0.0
    error: float = 0.0
    square: float = 0.0
    bound: float = 0.0
    log_z: float = 0.0
    dark: float = 0.0
    ghosts: float = 0.0
    seconds: float = 0.0
    score: float = 0.0

    def __add__(self, other: "CaseSums") -> "CaseSums":
        pairs = zip(astuple(self), astuple(other), strict=True)
        return CaseSums(*(one + two for one, two in pairs))


SUMS = tuple(field.name for field in fields(CaseSums))


@dataclass(frozen=True)
class WorstColumn:
    """A column that an extractor errs in most.

    part: the picture about it.  true, found: (along, across) in its pixels.  error_px, sigma_px.
    """

    case: str
    column: int
    error_px: float
    sigma_px: float
    part: Floats
    true: tuple[float, float]
    found: tuple[float, float]


CaseRows = Mapping[str, tuple[CaseSums | None, Sequence[WorstColumn]]]
"""What becomes of a case, by the name of a method or of a part of one; None: it has no such part.

The worst columns are of extractors alone.
"""
Judge = Callable[[Any], CaseRows]
CaseResult = tuple[str, CaseRows, float]  # with its name, and seconds of the reference workload


def judge(named: Iterable[tuple[str, str]], cases: Iterable[AnyCase]) -> Iterator[CaseResult]:
    """Each case in turn: its name, what becomes of it, and the reference workload's seconds.

    Pictures of a line take milliseconds: the first is judged once before, for what is compiled or
    imported by that is no time of a picture, and the reference is NaN but for every tenth.

    Parameters
    ----------
    named : iterable of roles, as of ROLES, and names
    cases : iterable, of the kind that these are judged by

    Raises
    ------
    InputError
        There is no such method, one fails, or a case is harmed.
    """
    judges = [ROLES[role].judge(name) for role, name in named]
    for number, case in enumerate(cases):
        brief = isinstance(case, SuiteCase)
        for one in judges if brief and number == 0 else ():
            one(case)
        reference_s = math.nan if brief and number % REFERENCE_EVERY else reference_seconds()
        rows = {name: row for one in judges for name, row in one(case).items()}
        yield case.name, rows, reference_s


def worst_of(columns: Iterable[WorstColumn]) -> tuple[WorstColumn, ...]:
    """The ten that are farthest off, the worst first.

    Parameters
    ----------
    columns : iterable
    """
    return tuple(nlargest(WORST, columns, key=lambda one: abs(one.error_px)))


def coordinate_sums(
    shown: Mask,
    valued: Mask,
    error: Floats,
    sigma: Floats,
    limit: Floats | float,
    seconds: float,
    *,
    needed: Mask | bool = True,
    dark: Mask | None = None,
    bound: Floats | float = 0.0,
) -> CaseSums:
    """The sums over columns, or over the coordinates of marks and points.

    Parameters
    ----------
    shown, valued : (N,) array, whether one is to be seen, and whether it has a value
    error, sigma : (N, C) array, px or mm, of its C coordinates
    limit : (N,) array or float, of the error's length, beyond which a value is wrong
    seconds : float, that it took
    needed : (N,) array, which of those shown must have a value; else all
    dark : (N,) array, those of which a value is a ghost; else all that are not shown
    bound : (N,) array, square of the least standard deviation; 0 where none is known
    """
    both, clear = shown & valued, shown & needed
    dark = ~shown if dark is None else dark
    off = np.where(both[:, np.newaxis], error, 0.0)
    spread = np.where(both[:, np.newaxis] & (sigma > 0), sigma, 1e-9)
    z = np.abs(off) / spread
    wrong = both & (np.linalg.norm(off, axis=1) > limit)
    core = clear & valued & ~wrong
    each = float(error.shape[1])
    sums = {
        "clear": each * clear.sum(),
        "missed": each * (clear & ~valued).sum(),
        "valued": each * both.sum(),
        "honest": (z[both] <= 3).sum(),
        "outlying": each * wrong.sum(),
        "sure": each * (z[wrong] > SURE).any(axis=1).sum(),
        "core": each * core.sum(),
        "error": off[core].sum(),
        "square": (off[core] ** 2).sum(),
        "bound": np.broadcast_to(bound, core.shape)[core].sum(),
        "log_z": np.log(np.maximum(z[core], 1e-3)).sum(),
        "dark": each * dark.sum(),
        "ghosts": each * (dark & valued).sum(),
        "seconds": seconds,
        "score": (spread * normal_score(z))[core].sum(),
    }
    return CaseSums(**{name: float(of) for name, of in sums.items()})


def normal_score(z: Floats) -> Floats:
    """Continuous ranked probability scores of a normal law, in its standard deviations.

    Less is better.  On average it is least where the law stated is that of the errors: a sigma that
    is wrong and one that does not follow the errors both cost, the more the farther off.

    Parameters
    ----------
    z : array, errors in stated sigmas

    References
    ----------
    Gneiting and Raftery, Strictly proper scoring rules, prediction, and estimation, Journal of the
    American Statistical Association 102 (2007), section 4.2.
    """
    density = np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi)
    return z * erf(z / np.sqrt(2)) + 2 * density - 1 / np.sqrt(np.pi)


def reference_seconds() -> float:
    """Processor seconds of what times are held against: a picture sorted column by column."""
    picture = np.random.default_rng(1).random(REFERENCE_SHAPE)
    np.sort(picture, axis=0)  # the first touches memory that is new
    began = time.process_time()
    np.sort(picture, axis=0)
    return time.process_time() - began


def _outcome(
    name: str, call: Callable[..., Any], *given: Any, fatal: tuple[type[Exception], ...] = ()
) -> tuple[Any, float]:
    """What a callable returns, None where it refuses or is given a None, and its seconds.

    An error of ``fatal`` is none of the picture's.
    """
    if any(one is None for one in given):
        return None, 0.0
    began = time.process_time()
    try:
        found = call(*given)
    except fatal:
        raise
    except LscanError:
        found = None
    except Exception as error:  # a stranger's may raise anything
        raise InputError(f"{name} failed: {foreign_error(error)}", where="bench") from error
    return found, time.process_time() - began


# Extractors judged by a suite's pictures of a line.


def extractor_judge(name: str) -> Judge:
    """Of an extractor, ``package.module:function`` too; InputError where there is none.

    Parameters
    ----------
    name : str
    """
    find_extractor(name)
    return lambda case: {name: judge_case(name, case)}


def judge_case(name: str, case: SuiteCase) -> tuple[CaseSums, list[WorstColumn]]:
    """The sums of one case, and its worst column.

    Parameters
    ----------
    name : str, of the extractor
    case : SuiteCase

    Raises
    ------
    InputError
        The extractor fails, or gives what is no line of the picture; names the case.
    """
    settings = case.settings.model_copy(update={"extractor": name})
    began = time.process_time()
    try:
        stripe = extract_stripe(case.picture, settings, case.dark)
    except InputError as refusal:
        raise InputError(f"{refusal}, in {case.name}") from refusal
    seconds = time.process_time() - began
    truth = case.truth
    seen = truth.status == Status.OK
    clear = truth.height_dn > settings.threshold_dn + CLEAR_OF_NOISE * truth.noise_dn
    both = seen & (truth.multiple == 0) & has_value(stripe.status)
    sums = coordinate_sums(
        seen & (truth.multiple == 0),
        has_value(stripe.status),
        (stripe.centre_px - truth.centre_px)[:, np.newaxis],
        stripe.sigma_px[:, np.newaxis],
        OUTLYING * truth.sigma_px,
        seconds,
        needed=clear,
        dark=~beside_line(seen),
        bound=_centre_bound_px2(truth),
    )
    return sums, _worst(case, stripe.centre_px, stripe.sigma_px, both)


def beside_line(line: Mask) -> Mask:
    """(N,) the columns with a line in them or so near that a lens spreads it into them.

    Parameters
    ----------
    line : (N,) array, the columns with a line in them
    """
    return np.convolve(line, np.ones(2 * NEAR_PX + 1), mode="same") > 0


def _centre_bound_px2(truth: CaseTruth) -> Floats:
    """Cramér-Rao's bound of the centre for pixel noise alone, px²: docs/explanation/physics.md, 4.

    The line's own shot noise and speckle are left out, and so is that pixels are not narrow.
    """
    ratio: Floats = truth.noise_dn / np.maximum(truth.height_dn, 1e-6)
    return ratio**2 * 2 * truth.sigma_px / np.sqrt(np.pi)


def _worst(case: SuiteCase, found: Floats, sigma: Floats, columns: Mask) -> list[WorstColumn]:
    """The column of a case that errs most, with the picture about it; none where none has one."""
    error = np.where(columns, np.abs(found - case.truth.centre_px), -1.0)
    if not columns.any():
        return []
    column = int(error.argmax())
    grey = case.picture.astype(float).reshape(*case.picture.shape[:2], -1).max(axis=2)
    grey = grey if case.settings.axis == "columns" else grey.T
    places = np.array([case.truth.centre_px[column], found[column]])
    low, high = _range(places.min(), places.max(), BESIDE_PX[1], grey.shape[0])
    left, right = _range(column, column, BESIDE_PX[0], grey.shape[1])
    true, seen = ((float(column - left), float(place - low)) for place in places)
    return [
        WorstColumn(
            case.name,
            column,
            float(places[1] - places[0]),
            float(sigma[column]),
            grey[low:high, left:right],
            true,
            seen,
        )
    ]


def _range(first: float, last: float, beside: int, size: int) -> Ints:
    ends = np.array([np.floor(first) - beside, np.ceil(last) + beside + 1])
    return np.clip(ends, 0, size).astype(np.int64)


# Readers of control points and plane maps judged on a suite's pictures of the calibration board.
#
# Each coordinate of a mark, or of a place on the sheet, counts as a column of a line does: the sums
# are those of extractors, and so are the table and the comparison of two runs.


READERS = "lscan.boardreaders"
WRONG_PX = 2.0  # off, and a reader's mark is another thing: dots are four pixels wide and more
WRONG_PITCHES = 0.1  # off, and a place of a map is wrong
BoardReader = Callable[[Bytes, Board], BoardReading]
MapSolver = Callable[[BoardReading, OpticsSection], PlaneMap]


def reader_judge(name: str) -> Judge:
    """Of a reader of control points, in px; InputError where there is none.

    Parameters
    ----------
    name : str, of the group lscan.boardreaders, or ``package.module:function``
    """
    reader = cast(BoardReader, find_plugin_or_function(READERS, name))
    return lambda case: {name: (judge_reader(name, reader, case), ())}


def map_judge(name: str) -> Judge:
    """Of a plane map, in mm, solved from what lscan's own reader finds; InputError for no map.

    Parameters
    ----------
    name : str, such as polynomial-5, or ``package.module:function`` of a reading and the optics
    """
    solve = (
        cast(MapSolver, find_plugin_or_function("lscan.planemaps", name))
        if names_code(name)
        else find_solver(name).solve
    )
    return lambda case: {name: (judge_map(name, solve, _own_reading(case), case), ())}


@lru_cache(1)  # all maps are solved from one reading of a picture
def _own_reading(case: BoardCase) -> BoardReading | None:
    found: BoardReading | None
    found, _ = _outcome("read_board", read_board, case.picture, case.board)
    return found


def judge_reader(name: str, reader: BoardReader, case: BoardCase) -> CaseSums:
    """The sums of one picture, px; none of its marks is found where the reader refuses.

    Parameters
    ----------
    name : str, for errors
    reader : callable
    case : BoardCase
    """
    true = case.marks
    found, seconds = _outcome(name, reader, case.picture, case.board)
    places, sigma = np.full_like(true.image_px, np.nan), np.full(len(true.status), np.nan)
    if found is not None:
        marks = joined_marks(found)  # in the case's order
        if len(marks.status) != len(true.status):
            raise InputError(f"{name} gave another number of marks", where="bench",
                             value=len(marks.status), allowed=len(true.status))  # fmt: skip
        places = np.where(marks.found[:, np.newaxis], marks.image_px, np.nan)
        sigma = marks.sigma_px
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
    solved, seconds = _outcome(name, solve, reading, case.optics)
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


# Whole chains judged on a suite's scans: from the board's picture to points, grooves and slices.
#
# Each coordinate counts as a column of a line does, as with boards: the sums are those of
# extractors, and so are the table and the comparison of two runs.


CHAINS = ("paper/rig", "best/groove")
"""That take part unless told otherwise: the paper's, and the best."""
SECTIONS = ("stripe", "calibration", "sheet")
"""What a chain is of a rig file; all else is the rig itself."""
BOARD, POINTS, GROOVES, SLICES = PARTS = ("board", "points", "grooves", "slices")
CLEAR_OF_THRESHOLD = 1.5  # times the threshold: a line that must be found, whatever the noise
WRONG_MM = 1.0  # off, and a height or a length is wrong: what is to be measured to a millimetre


def load_chain(path: str) -> Document:
    """The sections of a rig file that say how pictures are worked on.

    Parameters
    ----------
    path : str, of a TOML file, or the name of a scene; a file of the three sections alone will do

    Raises
    ------
    InputError
        There is no such file, or it has none of them.
    """
    document = read_document(included_file(Path(), path))
    if not (chain := {name: document[name] for name in SECTIONS if name in document}):
        allowed = ", ".join(f"[{name}]" for name in SECTIONS)
        raise InputError("has no section of a chain", where=path, allowed=allowed)
    return chain


def chain_judge(name: str) -> Judge:
    """Of a whole chain, in mm, by PARTS, named "CHAIN: PART"; InputError where it is none.

    Parameters
    ----------
    name : str, as of ``load_chain``
    """
    chain = load_chain(name)

    def judge_scan(case: ScanCase) -> CaseRows:
        sums = judge_chain(name, chain, case)
        return {f"{name}: {part}": (sums.get(part), ()) for part in PARTS}

    return judge_scan


def judge_chain(name: str, chain: Document, case: ScanCase) -> dict[str, CaseSums]:
    """The sums of one scan, mm, by part; nothing of a part is found where the chain refuses.

    Parameters
    ----------
    name : str, of the chain, for errors
    chain : mapping, sections that are laid over those of the case's rig
    case : ScanCase

    Raises
    ------
    InputError
        A key of the chain is wrong.
    """
    rig = check(Rig, merge(case.rig.model_dump(exclude_unset=True), chain), where=name)
    stage = partial(_outcome, name, fatal=(InputError,))  # of what the chain says
    plane_map, board_s = stage(_chain_map, case, rig)
    profiles, line_s = stage(_chain_profiles, case, rig, plane_map)
    sums = {
        BOARD: map_sums(plane_map, case.board, board_s),
        POINTS: _point_sums(profiles, rig, case, line_s),
    }
    if isinstance(rig.workpiece, GroovedBlock):
        lengths, seconds = stage(groove_dimensions, profiles, rig.workpiece)
        sums[GROOVES] = _groove_sums(lengths, rig.workpiece, seconds)
    if isinstance(rig.workpiece, Sandwave):
        cut, seconds = stage(_chain_slice, profiles, rig, case)
        sums[SLICES] = _slice_sums(cut, rig.workpiece, case, seconds)
    return sums


def _chain_map(case: ScanCase, rig: Rig) -> PlaneMap:
    reading = read_board(case.board.picture, case.board.board, channel=rig.calibration.channel)
    return map_for_rig(calibrate(reading, rig.calibration.plane_map, rig.optics).plane_map, rig)


def _chain_profiles(case: ScanCase, rig: Rig, plane_map: PlaneMap) -> list[Profile]:
    stripes = [extract_stripe(frame, rig.stripe) for frame in case.frames]
    return to_profiles(stripes, plane_map, list(rig.plan.positions_mm()))


def _point_sums(
    profiles: list[Profile] | None, rig: Rig, case: ScanCase, seconds: float
) -> CaseSums:
    """(x, z) of every column with a clear line, corrected for what the chain corrects for.

    Beyond the board, no map is known to hold.
    """
    line, on_board = case.status == Status.OK, case.board.map_mm
    with np.errstate(invalid="ignore"):
        inside = (case.line_mm >= on_board.min(axis=0)) & (case.line_mm <= on_board.max(axis=0))
    least_dn = CLEAR_OF_THRESHOLD * rig.stripe.threshold_dn
    clear = line & (case.multiple == 0) & (case.height_dn > least_dn) & inside.all(axis=-1)
    dark: Mask = ~np.stack([beside_line(of) for of in line])
    places = np.full_like(case.line_mm, np.nan)
    sigma = np.full_like(case.line_mm, np.nan)
    if profiles is not None:
        surface = correct(build_surface(profiles, rig), rig)
        places = surface.xyz_mm[..., ::2]
        sigma = np.stack([surface.sigma_x_mm, surface.sigma_z_mm], axis=-1)
    error = (places - case.line_mm).reshape(-1, 2)
    valued = np.isfinite(places).all(axis=-1).ravel()
    return coordinate_sums(
        clear.ravel(), valued, error, sigma.reshape(-1, 2), WRONG_MM, seconds, dark=dark.ravel()
    )


def _groove_sums(
    lengths: Mapping[str, Length] | None, piece: GroovedBlock, seconds: float
) -> CaseSums:
    """The block's dimensions."""
    count = len(piece.dimensions_mm())
    error, sigma = np.full((count, 1), np.nan), np.full((count, 1), np.nan)
    if lengths is not None:
        error[:, 0] = [length.error_mm for length in lengths.values()]
        sigma[:, 0] = [length.sigma_mm for length in lengths.values()]
    valued = np.isfinite(error[:, 0])
    return coordinate_sums(np.ones(count, bool), valued, error, sigma, WRONG_MM, seconds)


def _slice_sums(cut: Slice | None, piece: Sandwave, case: ScanCase, seconds: float) -> CaseSums:
    """Heights along the slices, where the sandwave is lit and seen, its border left out."""
    x, y, z = case.slices_mm.T
    seen = case.slice_status == Status.OK
    dark = ~seen
    error, sigma = np.full((len(z), 1), np.nan), np.full((len(z), 1), np.nan)
    if cut is not None:
        seen &= piece.inset_mm(x, y) >= cut.radius_mm  # beyond it, heights of the rim are in them
        error[:, 0], sigma[:, 0] = cut.z_mm - z, cut.sigma_z_mm
    valued = np.isfinite(error[:, 0])
    return coordinate_sums(seen, valued, error, sigma, WRONG_MM, seconds, dark=dark)


def _chain_slice(profiles: list[Profile], rig: Rig, case: ScanCase) -> Slice:
    built = finish(build_surface(profiles, rig), rig)
    built.require_alignment()
    return sample(built.surface, case.slices_mm[:, :2])


class _Role(NamedTuple):
    """cases: of a suite's manifest, that judge it.  option: of ``lscan bench``."""

    cases: str
    judge: Callable[[str], Judge]
    option: str = ""


ROLES: Mapping[str, _Role] = {
    "extractor": _Role("cases", extractor_judge),
    "reader": _Role("boards", reader_judge, "--boards --reader "),
    "map": _Role("boards", map_judge, "--boards --map "),
    "chain": _Role("scans", chain_judge, "--chain "),
}
"""What a method may be."""
