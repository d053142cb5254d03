"""``lscan bench --suite``: methods judged by a suite's cases, and what differs between two runs.

A few cases at a time are judged by several processes; runs are kept in files.
"""

import math
import os
import signal
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import asdict, astuple, dataclass
from functools import lru_cache, partial
from itertools import chain
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import ndtri
from scipy.stats import wilcoxon

from lscan.acquisition.scan import require_guarded_main
from lscan.benchmark.drawn import SHAPE, centres, draw, draw_worst
from lscan.benchmark.judging import ROLES, SUMS, CaseResult, CaseSums, WorstColumn, judge, worst_of
from lscan.benchmark.methods import THRESHOLD_DN, cases
from lscan.config.plugins import others_versions
from lscan.config.rig import StripeSection
from lscan.errors import InputError
from lscan.files.disk import make_folder, read_json, write_atomically, write_json
from lscan.records import Floats, Progress, Status
from lscan.suites import CaseTruth, SuiteCase, find_suite, open_suite

DRAWN = "drawn"
"""The suite of drawn lines, which needs no file."""
AT_ONCE = 20  # cases
LEAST_SHARED = 100  # cases: fewer are judged before other processes have begun
USUAL_AXES = ("water", "target", "fault")
_IN_WORDS: Mapping[str, tuple[str, str]] = {
    "cases": ("pictures of a line", "an extractor"),
    "boards": ("pictures of the board", "a reader or a map"),
    "scans": ("scans", "a chain"),
}
"""A suite's kinds of cases: what they are, and what is judged by them."""

_opened = lru_cache(1)(open_suite)


@dataclass(frozen=True)
class SuiteRun:
    """A suite's cases, and what became of each method: extractor, reader, map or part of a chain.

    Attributes
    ----------
    identity : str, of the suite, by which runs are comparable
    axes : mapping, by case, its values
    sums : mapping, by method and case
    worst : mapping, by method, the columns that it errs in most; of extractors alone
    reference_s : float, seconds of the reference workload
    asked : str, what ``lscan bench`` is given to judge the same methods
    """

    identity: str
    axes: Mapping[str, Mapping[str, str]]
    sums: Mapping[str, Mapping[str, CaseSums]]
    worst: Mapping[str, Sequence[WorstColumn]]
    reference_s: float
    asked: str


def run_suite(
    suite: str,
    methods: Mapping[str, Sequence[str]],
    seed: int = 1,
    progress: Progress | None = None,
) -> SuiteRun:
    """Judge methods by the cases of a suite.

    Parameters
    ----------
    suite : str, DRAWN, the name of a suite that is found, or its path
    methods : mapping, names by what they are of: "extractor", judged in px by pictures of a line;
        "reader" of control points and plane "map", in px and mm by pictures of the board; or
        "chain", rig files or names of scenes, in mm by scans
    seed : int, of drawn lines
    progress : callable or None, called with (done, all) cases

    Raises
    ------
    InputError
        There is no such suite or method, the suite has no such cases, or a method fails.
    """
    (kind,) = {ROLES[role].cases for role in methods}
    shown, allowed = _IN_WORDS[kind]
    if not (named := [(role, name) for role, names in methods.items() for name in names]):
        raise InputError("nothing to judge", where="bench", allowed=allowed)
    for role, name in named:
        ROLES[role].judge(name)  # unknown ones are refused before any work
    source = CaseSource.of(suite, kind, seed)
    if not source.axes:
        raise InputError(f"has no {shown}", where="--suite", value=suite)
    cases = sorted(source.axes)
    opened: AbstractContextManager[Iterator[CaseResult]]
    if source.path is not None and len(cases) >= LEAST_SHARED and (os.cpu_count() or 1) > 1:
        opened = judge_shared(source.path, named, cases)
    else:
        opened = nullcontext(judge(named, map(source.case, cases)))
    sums: defaultdict[str, dict[str, CaseSums]] = defaultdict(dict)
    worst: dict[str, Sequence[WorstColumn]] = {}
    reference_s = []
    with opened as results:
        for done, (case, rows, seconds) in enumerate(results, start=1):
            reference_s.append(seconds)
            for name, (of, columns) in rows.items():
                sums[name] |= {} if of is None else {case: of}
                worst[name] = worst_of((*worst.get(name, ()), *columns))
            if progress is not None:
                progress(done, len(cases))
    found = {name: of for name, of in sums.items() if of}  # not all scans have grooves
    asked = " ".join(f"{ROLES[role].option}{name}" for role, name in named)
    reference = float(np.nanmedian(reference_s))
    return SuiteRun(source.identity, source.axes, found, worst, reference, asked)


@contextmanager
def judge_shared(
    path: Path, named: Sequence[tuple[str, str]], cases: Sequence[str]
) -> Iterator[Iterator[CaseResult]]:
    """As ``judge``, by a process for each core.

    Parameters
    ----------
    path : Path, of the suite
    named : sequence of roles and names, of methods whose modules other processes can import
    cases : sequence of str, their names
    """
    require_guarded_main()
    groups = [cases[first : first + AT_ONCE] for first in range(0, len(cases), AT_ONCE)]
    # None is forked: threads of OpenCV and BLAS may hold locks.  Ctrl-C, which a terminal sends to
    # all of them, is left to the one that ends the others.
    spawned, no_ctrl_c = get_context("spawn"), (signal.SIGINT, signal.SIG_IGN)
    processes = min(os.cpu_count() or 1, 61)  # Windows waits for no more
    with ProcessPoolExecutor(processes, spawned, signal.signal, no_ctrl_c) as pool:
        yield chain.from_iterable(pool.map(partial(_judge_group, path, named), groups))


def _judge_group(
    path: Path, named: Sequence[tuple[str, str]], cases: Sequence[str]
) -> list[CaseResult]:
    return list(judge(named, map(_opened(path).case, cases)))


@dataclass(frozen=True)
class CaseSource:
    """The cases of one kind of a suite.

    identity: of the suite, by which runs are comparable.  axes: by case, its values.  case: reads
    one by its name.  path: of the suite, None of drawn lines.
    """

    identity: str
    axes: Mapping[str, Mapping[str, str]]
    case: Callable[[str], Any]
    path: Path | None = None

    @classmethod
    def of(cls, suite: str, kind: str, seed: int = 1) -> "CaseSource":
        """Those of a suite.

        Parameters
        ----------
        suite : str, DRAWN, the name of a suite that is found, or its path
        kind : str, "cases", "boards" or "scans"; of drawn lines there are "cases" alone
        seed : int, of drawn lines
        """
        if suite == DRAWN:
            drawn = {case.name: case for case in drawn_cases(seed) if kind == "cases"}
            axes = {name: case.axes for name, case in drawn.items()}
            return cls(f"{DRAWN} seed {seed}", axes, drawn.__getitem__)
        opened = open_suite(find_suite(suite))
        content, of = opened.content, "" if kind == "cases" else f"{kind} of "
        identity = f"{of}{content.name} seed {content.seed} {content.made_by}"
        return cls(identity, content.kinds[kind], opened.case, opened.path)


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


# The table of a run.


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
            what = "no such axis"
            raise InputError(what, where="--by", value=missing[0], allowed=", ".join(axes))
        groups.setdefault(tuple(axes[axis] for axis in by), []).append(case)
    return [
        row_of(
            name,
            {case: sums[case] for case in judged},
            dict(zip(by, values, strict=True)),
            sum(sums[case].seconds for case in judged) / len(judged) / run.reference_s,
        )
        for values, members in sorted(groups.items())
        for name, sums in run.sums.items()
        if (judged := [case for case in members if case in sums])
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


# What got better or worse between two runs of one suite: a paired test, case by case.


FALSE_ALARMS = 0.01  # probability that any figure of an extractor differs where nothing changed
EQUAL = 1e-4  # a smaller difference is none: 0.01 % of an rms, less than a column


def _log_rms(sums: CaseSums) -> float:
    return 0.5 * float(np.log(max(sums.square / sums.core, 1e-12))) if sums.core else np.nan


def _log_score(sums: CaseSums) -> float:
    """Of stated sigmas, in rms errors: an accuracy that changes alone is the rms error's to say."""
    return float(np.log(sums.score / sums.core)) - _log_rms(sums) if sums.score else np.nan


FIGURES: Mapping[str, Callable[[CaseSums], float]] = {
    "rms error": _log_rms,
    "error in stated sigmas": lambda sums: sums.log_z / sums.core if sums.core else np.nan,
    "score of stated sigmas": _log_score,
    "missed columns": lambda sums: sums.missed,
    "columns without a line": lambda sums: sums.ghosts,
    "wrong columns": lambda sums: sums.outlying,
    "wrong columns that are sure": lambda sums: sums.sure,
}
"""Of a case; more is worse, but of the error in sigmas: too large and too small are both worse.

The first three are logarithms, whose differences are ratios.
"""
_SIGMA = "error in stated sigmas"
_RATIOS = ("rms error", _SIGMA, "score of stated sigmas")
LOG_Z = -(np.euler_gamma + np.log(2)) / 2  # the mean of ln |z| where z is standard normal


@dataclass(frozen=True)
class Difference:
    """A figure that differs.

    Attributes
    ----------
    extractor : str
    figure : str, a key of FIGURES
    worse : bool
    change : float, of the cases in which it differs: the pseudo-median of the ratio less 1, or of
        the difference in columns
    p : float, probability of so much where nothing changed
    cases : int, in which it differs at all
    interval : tuple of float, of change, 95 %
    """

    extractor: str
    figure: str
    worse: bool
    change: float
    p: float
    cases: int
    interval: tuple[float, float]

    @property
    def in_words(self) -> str:
        """One line."""
        how = "worse" if self.worse else "better"
        low, high = (self._size(end) for end in self.interval)
        return (
            f"{self.extractor}: {self.figure} {how}: {self._size(self.change)} ({low} to {high}), "
            f"in {self.cases} cases, p = {self.p:.1g}"
        )

    def _size(self, change: float) -> str:
        size, more = abs(change), change > 0
        if self.figure not in _RATIOS:
            return f"{size:.2g} columns {'more' if more else 'fewer'}"
        if size >= 1:
            return f"{1 + change:.3g} times as large"
        return f"{100 * size:.{0 if size > 0.1 else 1}f} % {'larger' if more else 'smaller'}"


def differences(
    extractor: str, now: Mapping[str, CaseSums], before: Mapping[str, CaseSums]
) -> list[Difference]:
    """What differs on the cases that both have, the probability of any false alarm being 1 %.

    Parameters
    ----------
    extractor : str, for the records
    now, before : mappings, sums by case

    References
    ----------
    Wilcoxon, Individual comparisons by ranking methods, Biometrics Bulletin 1 (1945), cases without
    a difference left out; Bonferroni's correction for the number of figures.  That 5 % of the cases
    got a little worse and all others stayed as they are is then seen, too.  The pseudo-median
    belongs to that test (Hodges and Lehmann, Estimates of location based on rank tests, Annals of
    Mathematical Statistics 34 (1963)): its sign is that of the rank sum.
    """
    common = sorted(now.keys() & before.keys())
    found = []
    for figure, of in FIGURES.items():
        pairs = np.array([[of(now[case]), of(before[case])] for case in common]).reshape(-1, 2)
        difference = pairs[:, 0] - pairs[:, 1]
        difference = difference[np.abs(difference) > EQUAL]  # NaN, too, is left out
        p = float(wilcoxon(difference).pvalue) if len(difference) else 1.0
        if p < FALSE_ALARMS / len(FIGURES):
            low, typical, high = pseudo_median(difference)
            worse = typical > 0
            if figure == _SIGMA:
                off = np.abs(np.nanmean(pairs, axis=0) - LOG_Z)
                worse = bool(off[0] > off[1])
            if figure in _RATIOS:
                low, typical, high = np.expm1([low, typical, high]).tolist()
            found.append(
                Difference(extractor, figure, worse, typical, p, len(difference), (low, high))
            )
    return found


def between(sums: Mapping[str, Mapping[str, CaseSums]]) -> list[Difference]:
    """What differs between the first of several methods and each other, on the same cases.

    Parameters
    ----------
    sums : mapping, by method and case
    """
    (first, own), *others = sums.items()
    return [one for name, of in others for one in differences(f"{name} beside {first}", of, own)]


def before_and_after(now: Mapping[str, CaseSums], before: Mapping[str, CaseSums]) -> str:
    """Bias and rms error of two runs, of the columns that count, and the cases changed most.

    Parameters
    ----------
    now, before : mappings, sums by case; counted are the clear columns of the cases of both with a
        value within three widths of the line
    """
    common = [case for case in sorted(now) if case in before and now[case].core]
    if not (common := [case for case in common if before[case].core]):
        return "no case of both has a column that counts"

    def rms(of: Mapping[str, CaseSums], cases: Sequence[str]) -> float:
        return float(np.sqrt(sum(of[c].square for c in cases) / sum(of[c].core for c in cases)))

    bias = [
        sum(of[c].error for c in common) / sum(of[c].core for c in common) for of in (before, now)
    ]
    changed = sorted(common, key=lambda case: abs(_log_rms(now[case]) - _log_rms(before[case])))
    most = ", ".join(
        f"{case} ({rms(before, [case]):.3f} to {rms(now, [case]):.3f} px)"
        for case in changed[:-4:-1]
    )
    return (
        f"bias {bias[0]:+.4f} to {bias[1]:+.4f} px, rms error {rms(before, common):.4f} to "
        f"{rms(now, common):.4f} px, of {sum(now[case].core for case in common):.0f} columns in "
        f"{len(common)} cases; changed most: {most}"
    )


def pseudo_median(values: Floats) -> tuple[float, float, float]:
    """The median of the means of all pairs of values, each with itself among them.

    Parameters
    ----------
    values : (N,) array, 1 at least

    Returns
    -------
    tuple of float
        The lower end of its 95 % interval, itself, the upper end: that of the values which the
        signed-rank test does not reject.  Of fewer than six values the ends are the outermost.

    References
    ----------
    Hollander, Wolfe and Chicken, Nonparametric Statistical Methods, 3rd edition, section 3.3.
    """
    one, other = np.triu_indices(len(values))
    means, n = np.sort((values[one] + values[other]) / 2), len(values)
    spread = np.sqrt(n * (n + 1) * (2 * n + 1) / 24)
    left_out = max(int(n * (n + 1) / 4 - ndtri(0.975) * spread), 0)
    return float(means[left_out]), float(np.median(means)), float(means[-1 - left_out])


# Runs on suites kept in files: bench.json, and what differs from one.


VERSION = 1
MOST_SAVED_BYTES = 2**28
_GROUPS = ("lscan.extractors", "lscan.boardreaders", "lscan.planemaps")


@dataclass(frozen=True)
class SavedRun:
    """What a bench.json says.

    Attributes
    ----------
    suite : str, the suite's identity: runs of another are not comparable
    sums : mapping, by method and case
    rows : sequence of mappings, of its table, as SuiteRow
    """

    suite: str
    sums: Mapping[str, Mapping[str, CaseSums]]
    rows: Sequence[Mapping[str, Any]]


def write_suite_run(folder: Path, run: SuiteRun, by: Sequence[str]) -> dict[str, Any]:
    """Write bench.json, and the worst columns of each extractor as a picture.

    Parameters
    ----------
    folder : Path, made where it is missing
    run : SuiteRun
    by : sequence of str, the axes of the table in bench.json

    Returns
    -------
    What bench.json holds.
    """
    make_folder(folder)
    content = saved_run(run, by)
    write_json(folder / "bench.json", content)
    for name, worst in run.worst.items():
        if worst:
            file = folder / f"worst-{name.replace(':', '.')}.png"
            write_atomically(file, draw_worst(name, worst))
    return content


def saved_run(run: SuiteRun, by: Sequence[str] = ()) -> dict[str, Any]:
    """What bench.json holds of a run, of JSON types; ``compare_saved`` takes such a file.

    Parameters
    ----------
    run : SuiteRun
    by : sequence of str, the axes of its table
    """
    return {
        "version": VERSION,
        "suite": run.identity,
        "packages": {
            package: version
            for name in run.sums
            for group in _GROUPS
            for package, version in others_versions(group, name).items()
        },
        "rows": [asdict(row) for row in suite_rows(run, by)],
        "sums": list(SUMS),
        "extractors": {
            name: {case: list(astuple(sums)) for case, sums in of.items()}
            for name, of in run.sums.items()
        },
    }


def read_saved(file: Path) -> SavedRun:
    """The saved run in a file.

    Parameters
    ----------
    file : Path, a bench.json

    Raises
    ------
    InputError
        The file is none.
    """
    content = read_json(file, MOST_SAVED_BYTES)
    try:
        known = [list(SUMS), list(SUMS[:-1])]  # runs of before have no scores
        if content["version"] != VERSION or content["sums"] not in known:
            raise ValueError
        sums = {
            str(name): {case: CaseSums(*map(float, of)) for case, of in cases.items()}
            for name, cases in content["extractors"].items()
        }
        rows = [
            {**row, "cases": int(row["cases"]), "extractor": str(row["extractor"]),
             "time": None if row["time"] is None else float(row["time"])}
            for row in content["rows"]
        ]  # fmt: skip
        return SavedRun(str(content["suite"]), sums, rows)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        allowed = "a bench.json of lscan bench --suite"
        raise InputError("is no saved run", where=file, allowed=allowed) from error


def compare_saved(run: SuiteRun, file: Path) -> list[Difference]:
    """What differs from a saved run of the same suite, for each method that both have.

    Parameters
    ----------
    run : SuiteRun
    file : Path, a bench.json

    Raises
    ------
    InputError
        The file is none, or of another suite, or has none of the methods.
    """
    found = [differences(name, now, before) for name, now, before in _in_both(run, file)]
    return [one for of in found for one in of]


def changes_in_words(run: SuiteRun, file: Path) -> list[str]:
    """A line for each method of a run and of a saved run: its bias and rms error in both.

    Parameters
    ----------
    run : SuiteRun
    file : Path, a bench.json

    Raises
    ------
    InputError
        As ``compare_saved``.
    """
    return [f"{name}: {before_and_after(now, old)}" for name, now, old in _in_both(run, file)]


def _in_both(
    run: SuiteRun, file: Path
) -> list[tuple[str, Mapping[str, CaseSums], Mapping[str, CaseSums]]]:
    """Of the methods that a run and a saved run have, name, sums of the run, and saved sums."""
    saved = read_saved(file)
    if saved.suite != run.identity:
        raise InputError("is of another suite", where=file, value=saved.suite, allowed=run.identity)
    if not (both := [name for name in run.sums if name in saved.sums]):
        allowed = ", ".join(saved.sums)
        raise InputError("has none of these extractors", where=file, allowed=allowed)
    return [(name, run.sums[name], saved.sums[name]) for name in both]
