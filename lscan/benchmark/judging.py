"""Extractors judged on the cases of a suite: each case's errors against the truth, as sums.

The sums of cases add up to those of any group of cases, and two runs of one suite are compared case
by case.
"""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import astuple, dataclass, fields, replace
from heapq import nlargest

import numpy as np
from scipy.special import erf

from lscan.errors import InputError
from lscan.records import Floats, Ints, Mask, Status, has_value
from lscan.stripe import extract_stripe
from lscan.suites import SuiteCase

OUTLYING = 3.0  # standard deviations of the line's width, within which is 99.7 % of its light
SURE = 5.0  # stated sigmas: of a normal law a column in two million is beyond
CLEAR = 3.0  # standard deviations of noise above the threshold: a line that must be found
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


@dataclass(frozen=True)
class JudgedExtractor:
    """What an extractor, a reader of boards, a plane map or a chain made of a suite.

    Attributes
    ----------
    extractor : str, its name
    sums : mapping, of each case by its name
    worst : tuple of WorstColumn, the worst first; of extractors alone
    asked : str, what ``lscan bench`` is given to judge it; "": its name
    """

    extractor: str
    sums: dict[str, CaseSums]
    worst: tuple[WorstColumn, ...]
    asked: str = ""


def judge(
    names: Sequence[str], cases: Iterable[SuiteCase], step: Callable[[], None] = lambda: None
) -> tuple[list[JudgedExtractor], float]:
    """Each extractor on each case, in turn.

    Parameters
    ----------
    names : sequence of str, of extractors; ``package.module:function`` too
    cases : iterable
    step : callable, called after each case

    Returns
    -------
    One record for each extractor, and the median seconds of the reference workload.

    Raises
    ------
    InputError
        An extractor is unknown or fails, or a case is harmed.
    """
    judged = {name: JudgedExtractor(name, {}, ()) for name in names}
    reference = []
    for number, case in enumerate(cases):
        if number == 0:  # what is compiled or imported at the first call is no time of a picture
            for name in names:
                judge_case(name, case)
        if number % REFERENCE_EVERY == 0:
            reference.append(reference_seconds())
        for name in names:
            sums, worst = judge_case(name, case)
            known = judged[name]
            known.sums[case.name] = sums
            judged[name] = replace(known, worst=worst_of((*known.worst, *worst)))
        step()
    return list(judged.values()), float(np.median(reference or [np.nan]))


def worst_of(columns: Iterable[WorstColumn]) -> tuple[WorstColumn, ...]:
    """The ten that are farthest off, the worst first.

    Parameters
    ----------
    columns : iterable
    """
    return tuple(nlargest(WORST, columns, key=lambda one: abs(one.error_px)))


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
    line = (truth.status == Status.OK) & (truth.multiple == 0)
    valued = has_value(stripe.status)
    clear = line & (truth.height_dn > settings.threshold_dn + CLEAR * truth.noise_dn)
    both = line & valued
    error = np.where(both, stripe.centre_px - truth.centre_px, 0.0)
    sigma = np.maximum(stripe.sigma_px, 1e-9, where=both, out=np.ones(len(both)))
    z = np.abs(error) / sigma
    outlying = both & (np.abs(error) > OUTLYING * truth.sigma_px)
    core = clear & valued & ~outlying
    dark = ~beside_line(truth.status == Status.OK)
    sums = (
        clear.sum(), (clear & ~valued).sum(),
        both.sum(), (both & (z <= 3)).sum(), outlying.sum(), (outlying & (z > SURE)).sum(),
        core.sum(), error[core].sum(), (error[core] ** 2).sum(), _bound(case, core).sum(),
        np.log(np.maximum(z[core], 1e-3)).sum(), dark.sum(), (dark & valued).sum(), seconds,
        (sigma * normal_score(z))[core].sum(),
    )  # fmt: skip
    return CaseSums(*map(float, sums)), _worst(case, stripe.centre_px, stripe.sigma_px, both)


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
    scores: Floats = z * erf(z / np.sqrt(2)) + 2 * density - 1 / np.sqrt(np.pi)
    return scores


def beside_line(line: Mask) -> Mask:
    """(N,) the columns with a line in them or so near that a lens spreads it into them.

    Parameters
    ----------
    line : (N,) array, the columns with a line in them
    """
    return np.convolve(line, np.ones(2 * NEAR_PX + 1), mode="same") > 0


def _bound(case: SuiteCase, columns: Mask) -> Floats:
    """Cramér-Rao's bound of the centre for pixel noise alone, px²: docs/explanation/physics.md, 4.

    The line's own shot noise and speckle are left out, and so is that pixels are not narrow.
    """
    truth = case.truth
    height = np.maximum(truth.height_dn[columns], 1e-6)
    ratio: Floats = truth.noise_dn[columns] / height
    return ratio**2 * 2 * truth.sigma_px[columns] / np.sqrt(np.pi)


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


def reference_seconds() -> float:
    """Processor seconds of what times are held against: a picture sorted column by column."""
    picture = np.random.default_rng(1).random(REFERENCE_SHAPE)
    np.sort(picture, axis=0)  # the first touches memory that is new
    began = time.process_time()
    np.sort(picture, axis=0)
    return time.process_time() - began
