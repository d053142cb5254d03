"""``lscan bench --suite``: extractors, what reads and maps boards, and chains, on a suite."""

import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lscan.benchmark.against import LOG_Z
from lscan.benchmark.boardjudging import judge_boards
from lscan.benchmark.chainjudging import judge_chains
from lscan.benchmark.extractors import THRESHOLD_DN, cases
from lscan.benchmark.judging import CaseSums, JudgedExtractor, judge
from lscan.benchmark.pictures import SHAPE, centres, draw
from lscan.benchmark.sharing import judge_shared
from lscan.config.rig import StripeSection
from lscan.errors import InputError
from lscan.records import Progress, Status
from lscan.stripe import find_extractor
from lscan.suites import CaseTruth, SuiteCase, SuiteContent, find_suite, open_suite

DRAWN = "drawn"
"""The suite of drawn lines, which needs no file."""
LEAST_SHARED = 100  # cases: fewer are judged before other processes have begun
USUAL_AXES = ("water", "target", "fault")


@dataclass(frozen=True)
class SuiteRun:
    """A suite's cases with their axes, and what became of each extractor.

    identity: of the suite, by which runs are comparable.  reference_s: seconds of the reference
    workload.
    """

    identity: str
    axes: Mapping[str, Mapping[str, str]]
    judged: Sequence[JudgedExtractor]
    reference_s: float


@dataclass(frozen=True)
class SuiteRow:
    """An extractor on the cases that have a value on each of some axes.

    bias_px, scatter_px: of the errors on clear lines that are not wrong; bound_ratio: their rms to
    the least that pixel noise allows.
    found: share of the columns with a clear line; wrong: share of values beyond three widths of the
    line, sure: share of values that are so and say they are not; ghosts: share of the columns
    without a line that got a value.  within_3_sigma, z_ratio: share, and geometric mean of |error|
    over sigma to that of a normal law: 1 where sigma is right, more where it is too small.
    time: to that of the reference workload.
    """

    extractor: str
    group: Mapping[str, str]
    cases: int
    bias_px: float
    scatter_px: float
    bound_ratio: float
    found: float
    wrong: float
    sure: float
    ghosts: float
    within_3_sigma: float
    z_ratio: float
    time: float


def run_suite(
    suite: str, names: Sequence[str], seed: int = 1, progress: Progress | None = None
) -> SuiteRun:
    """Judge extractors on a suite.

    Parameters
    ----------
    suite : str, DRAWN, the name of a suite that is found, or its path
    names : sequence of str, of extractors
    seed : int, of drawn lines
    progress : callable or None, called with (done, all) cases

    Raises
    ------
    InputError
        There is no such suite or extractor, or one fails.
    """
    if not names:
        raise InputError("nothing to judge", where="bench", allowed="an extractor")
    for name in names:
        find_extractor(name)
    if suite == DRAWN:
        every = list(drawn_cases(seed))
        identity, axes = f"{DRAWN} seed {seed}", {case.name: case.axes for case in every}
        shown: Iterator[SuiteCase] = iter(every)
    else:
        opened = open_suite(find_suite(suite))
        content = opened.content
        identity = _identity(content)
        axes, shown = dict(content.cases), opened.cases()
        if not axes:
            raise InputError("has no pictures of a line", where="--suite", value=suite)
        if len(axes) >= LEAST_SHARED and (os.cpu_count() or 1) > 1:
            judged, reference_s = judge_shared(opened.path, names, sorted(axes), progress)
            return SuiteRun(identity, axes, judged, reference_s)
    judged, reference_s = judge(names, shown, _stepping(progress, len(axes)))
    return SuiteRun(identity, axes, judged, reference_s)


def run_boards(
    suite: str, readers: Sequence[str], maps: Sequence[str], progress: Progress | None = None
) -> SuiteRun:
    """Judge readers of control points, in px, and plane maps, in mm, on a suite's boards.

    Parameters
    ----------
    suite : str, the name of a suite that is found, or its path
    readers, maps : sequences of str, their names
    progress : callable or None, called with (done, all) cases

    Raises
    ------
    InputError
        There is no such suite, reader or map, the suite has no boards, or a reader fails.
    """
    if not (readers or maps):
        raise InputError("nothing to judge", where="bench", allowed="a reader or a map")
    opened = open_suite(find_suite(suite))
    axes = dict(opened.content.boards)
    if not axes:
        raise InputError("has no pictures of the board", where="--suite", value=suite)
    step = _stepping(progress, len(axes))
    judged, reference_s = judge_boards(readers, maps, opened.boards(), step)
    return SuiteRun(f"boards of {_identity(opened.content)}", axes, judged, reference_s)


def run_chains(suite: str, chains: Sequence[str], progress: Progress | None = None) -> SuiteRun:
    """Judge whole chains, in mm, on a suite's scans.

    Parameters
    ----------
    suite : str, the name of a suite that is found, or its path
    chains : sequence of str, rig files or names of scenes
    progress : callable or None, called with (done, all) cases

    Raises
    ------
    InputError
        There is no such suite or chain, or the suite has no scans.
    """
    if not chains:
        raise InputError("nothing to judge", where="bench", allowed="a chain")
    opened = open_suite(find_suite(suite))
    axes = dict(opened.content.scans)
    if not axes:
        raise InputError("has no scans", where="--suite", value=suite)
    judged, reference_s = judge_chains(chains, opened.scans(), _stepping(progress, len(axes)))
    return SuiteRun(f"scans of {_identity(opened.content)}", axes, judged, reference_s)


def _stepping(progress: Progress | None, count: int) -> Callable[[], None]:
    """What is called after each case."""
    done = 0

    def step() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, count)

    return step


def _identity(content: SuiteContent) -> str:
    return f"{content.name} seed {content.seed} {content.made_by}"


def drawn_cases(seed: int) -> Iterator[SuiteCase]:
    """The drawn lines of ``lscan bench`` as cases of a suite.

    Parameters
    ----------
    seed : int, of all that is random in them
    """
    for number, case in enumerate(cases()):
        rng = np.random.default_rng([seed, number])
        true = centres(rng.random())
        image = draw(case, true, rng)
        each = np.ones(SHAPE[1])
        noise = case.noise.read_dn * each
        zeros = np.zeros(SHAPE[1], dtype=np.int64)
        truth = CaseTruth(
            true, case.sigma_px * each, case.peak_dn * each, noise, zeros, zeros + int(Status.OK)
        )
        fault = "speckle" if case.noise.speckle else "clipped" if case.saturated else "none"
        target = f"{case.sigma_px:g} px {case.peak_dn:g} DN"
        axes = {"water": case.water, "target": target, "fault": fault}
        settings = StripeSection(threshold_dn=THRESHOLD_DN, noise=case.noise)
        labels = np.zeros(SHAPE, np.uint8)
        yield SuiteCase(f"case-{number:04d}", axes, image, None, labels, truth, settings)


def usual_axes(run: SuiteRun) -> list[str]:
    """The axes that one looks at first, of those that the run's cases have.

    Parameters
    ----------
    run : SuiteRun
    """
    return [axis for axis in USUAL_AXES if all(axis in axes for axes in run.axes.values())]


def suite_rows(run: SuiteRun, by: Sequence[str]) -> list[SuiteRow]:
    """The table: a row for each extractor and each combination of values on some axes.

    Parameters
    ----------
    run : SuiteRun
    by : sequence of str, the axes; none: one row for each extractor

    Raises
    ------
    InputError
        The suite has no such axis.
    """
    groups: dict[tuple[str, ...], list[str]] = {}
    for case, axes in run.axes.items():
        if missing := [axis for axis in by if axis not in axes]:
            raise InputError(
                "no such axis", where="--by", value=missing[0], allowed=", ".join(axes)
            )
        groups.setdefault(tuple(axes[axis] for axis in by), []).append(case)
    return [
        row_of(
            one.extractor,
            {case: one.sums[case] for case in judged},
            dict(zip(by, values, strict=True)),
            sum(one.sums[case].seconds for case in judged) / len(judged) / run.reference_s,
        )
        for values, members in sorted(groups.items())
        for one in run.judged
        if (judged := [case for case in members if case in one.sums])  # not all scans have grooves
    ]


def row_of(
    name: str, sums: Mapping[str, CaseSums], group: Mapping[str, str], time: float
) -> SuiteRow:
    """A method's row of some cases.

    Parameters
    ----------
    name : str, of the extractor, reader or map
    sums : mapping, of each case
    group : mapping, the values on axes that the cases have in common
    time : float, of a case, to that of the reference workload
    """
    total = sum(sums.values(), CaseSums())
    bias, square = _share(total.error, total.core), _share(total.square, total.core)
    return SuiteRow(
        name,
        group,
        len(sums),
        bias,
        math.sqrt(max(square - bias**2, 0.0)) if total.core else math.nan,
        math.sqrt(_share(total.square, total.bound)),
        1 - _share(total.missed, total.clear),
        _share(total.outlying, total.valued),
        _share(total.sure, total.valued),
        _share(total.ghosts, total.dark),
        _share(total.honest, total.valued),
        math.exp(_share(total.log_z, total.core) - LOG_Z),
        time,
    )


def _share(part: float, whole: float) -> float:
    return part / whole if whole else math.nan
