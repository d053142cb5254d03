"""Plugin of pytest: the cases of a suite as fixtures, and results held against a baseline.

Loaded by every run of pytest where lscan is installed, so that it imports what it needs only
where a fixture is used.
"""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from collections.abc import Callable, Generator

    from lscan.benchmark.suiterun import CaseSource, SuiteRun
    from lscan.suites import BoardCase, ScanCase, SuiteCase

CASES = {"stripe_case": "cases", "board_case": "boards", "scan_case": "scans"}
"""The fixtures of a case, and what a suite's manifest calls such cases."""
SUITE, UPDATE = "--lscan-suite", "--lscan-update"
USUAL = "drawn"
MARK = "lscan_suite"
NONE = "none"
"""The case of a suite without any: an error of the test alone, which -k may leave out."""
WRITTEN = pytest.StashKey[dict[Path, str]]()
"""Of a run with --lscan-update: the baselines written, each by the test that wrote it."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add --lscan-suite and --lscan-update."""
    group = parser.getgroup("lscan")
    group.addoption(
        SUITE, default=None, help="suite of the lscan fixtures: a name, a path, or drawn"
    )
    group.addoption(UPDATE, action="store_true", help="write baselines anew instead of testing")
    parser.addini("lscan_suite", "suite of the lscan fixtures", default=USUAL)


def pytest_configure(config: pytest.Config) -> None:
    """Name the mark; refuse plug-ins of others with our name, and baselines of two processes."""
    refuse_namesakes()
    config.addinivalue_line("markers", f"{MARK}(name): suite of the lscan fixtures of a test")
    config.stash[WRITTEN] = {}
    if not config.getoption(UPDATE):
        return
    if hasattr(config, "workerinput") or config.getoption("numprocesses", None):
        raise pytest.UsageError(f"{UPDATE} writes baselines in one process: leave out -n")
    if os.environ.get("CI", "").lower() not in ("", "0", "false"):
        raise pytest.UsageError(
            f"{UPDATE} would test nothing, and CI is set: write baselines by hand and commit them"
        )


def refuse_namesakes() -> None:
    """Refuse to test where two packages have a plug-in of one name: pytest would load but one."""
    from lscan.config.plugins import find_entry, installed
    from lscan.errors import InputError

    for name in {"lscan", "lscan-tank"}.intersection(installed("pytest11")):
        try:
            find_entry("pytest11", name, where="pytest")
        except InputError as error:
            raise pytest.UsageError(str(error)) from error


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """One test for each case of the suite where a test takes a fixture of one."""
    for fixture, kind in CASES.items():
        if fixture in metafunc.fixturenames:
            names = sorted(_case_source(_suite(metafunc.definition), kind).axes) or [NONE]
            metafunc.parametrize(fixture, names, indirect=True)


@pytest.fixture
def lscan_suite(request: pytest.FixtureRequest) -> str:
    """The suite's name: of the option, of the test's mark, of the ini file, or "drawn"."""
    return _suite(request.node)


@pytest.fixture
def stripe_case(request: pytest.FixtureRequest) -> SuiteCase:
    """One case of the suite: picture, truth, settings, values on the suite's axes."""
    return _case_of(request)


@pytest.fixture
def board_case(request: pytest.FixtureRequest) -> BoardCase:
    """One picture of the board of the suite: its marks and the map on the sheet, known."""
    return _case_of(request)


@pytest.fixture
def scan_case(request: pytest.FixtureRequest) -> ScanCase:
    """One whole scan of the suite, with its board: the rig, the pictures, every point known."""
    return _case_of(request)


@pytest.fixture
def judge_extractor(lscan_suite: str) -> Callable[[str], SuiteRun]:
    """A function that judges an extractor, by name or package.module:function, on the suite."""
    return _judge_of("extractor", lscan_suite)


@pytest.fixture
def judge_reader(lscan_suite: str) -> Callable[[str], SuiteRun]:
    """A function that judges a reader of control points, by name, on the suite's boards."""
    return _judge_of("reader", lscan_suite)


@pytest.fixture
def judge_map(lscan_suite: str) -> Callable[[str], SuiteRun]:
    """A function that judges a plane map, by name, on the suite's boards."""
    return _judge_of("map", lscan_suite)


@pytest.fixture
def judge_chain(lscan_suite: str) -> Callable[[str | Path], SuiteRun]:
    """A function that judges a chain, by rig file or name of a scene, on the suite's scans."""
    return _judge_of("chain", lscan_suite)


def _judge_of(role: str, suite: str) -> Callable[[str | Path], SuiteRun]:
    from lscan.benchmark.suiterun import run_suite

    return lambda name: run_suite(suite, {role: [str(name)]})


@pytest.fixture
def assert_no_worse(
    request: pytest.FixtureRequest, tmp_path: Path, lscan_suite: str
) -> Callable[[SuiteRun, str | Path], None]:
    """A function that fails the test where a result is worse than a baseline file says.

    The file lies beside the test; --lscan-update writes it.  By a paired test on the suite's cases,
    whose probability of failing where nothing changed is 1 %.
    """

    def compare(result: SuiteRun, baseline: str | Path) -> None:
        from lscan.benchmark.suiterun import (
            changes_in_words,
            compare_saved,
            saved_run,
            write_suite_run,
        )
        from lscan.files.disk import write_json

        file = request.path.parent / baseline
        if request.config.getoption(UPDATE):
            written = request.config.stash[WRITTEN]
            other = written.setdefault(file, request.node.nodeid)
            if other != request.node.nodeid:
                pytest.fail(f"{file} is the baseline of {other} too: name another", pytrace=False)
            write_json(file, saved_run(result))
            return
        if not file.exists():
            pytest.fail(f"no baseline {file}: pytest {UPDATE} writes it", pytrace=False)
        if worse := [one for one in compare_saved(result, file) if one.worse]:
            write_suite_run(tmp_path, result, ())
            pytest.fail("\n".join([
                *(one.in_words for one in worse),
                *changes_in_words(result, file),
                f"pictures: {tmp_path}",
                f"lscan bench {result.asked} --suite {lscan_suite} --only --against {file}",
            ]), pytrace=False)  # fmt: skip

    return compare


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item,
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Beside the failure of a test of a case: its picture and the command to look closer.

    A test that wrote a baseline has tested nothing: it is skipped, not passed.
    """
    report = yield
    files = [file for file, by in item.config.stash[WRITTEN].items() if by == item.nodeid]
    if report.when == "call" and report.passed and files:
        where, line, _ = item.location
        report.outcome = "skipped"
        report.longrepr = (where, line or 0, f"baseline written: {', '.join(map(str, files))}")
    given = getattr(item, "funcargs", {})
    case = next((given[fixture] for fixture in CASES if fixture in given), None)
    if report.when == "call" and report.failed and case is not None:
        report.sections.append((f"lscan case {case.name}", _case_in_words(item, case)))
    return report


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    """Name the baselines that were written."""
    if written := config.stash[WRITTEN]:
        terminalreporter.section("lscan baselines")
        for file, test in written.items():
            terminalreporter.write_line(f"written, nothing tested: {file} ({test})")


def _case_of(request: pytest.FixtureRequest) -> Any:
    """The case that a fixture of one is to give; the test fails where the suite has none such."""
    suite = _suite(request.node)
    source = _case_source(suite, CASES[str(request.fixturename)])
    if not source.axes:
        pytest.fail(
            f"takes {request.fixturename}, of which the suite {suite!r} holds none: name one that "
            f"does by {SUITE}, such as quick, or chains for scans",
            pytrace=False,
        )
    return source.case(request.param)


@cache
def _case_source(suite: str, kind: str) -> CaseSource:
    from lscan.benchmark.suiterun import CaseSource

    return CaseSource.of(suite, kind)


def _suite(node: pytest.Item | pytest.Function | Any) -> str:
    option = node.config.getoption(SUITE)
    mark = node.get_closest_marker(MARK)
    named = [] if mark is None else [*mark.args, *mark.kwargs.values()]
    if mark is not None and (len(named) != 1 or set(mark.kwargs) - {"name"}):
        pytest.fail(
            f'{node.nodeid}: the mark {MARK} takes the name of one suite, as in {MARK}("quick")',
            pytrace=False,
        )
    return str(option or (named[0] if named else node.config.getini("lscan_suite")))


def _case_in_words(item: pytest.Item, case: SuiteCase | BoardCase | ScanCase) -> str:
    """Its values on the axes, where its picture is now, and what to type to look at a line."""
    from lscan.files.pictures import write_picture

    cache = getattr(item.config, "cache", None)  # none with -p no:cacheprovider
    axes = ", ".join(f"{axis} {value}" for axis, value in case.axes.items())
    if cache is None:
        return axes
    picture = cache.mkdir("lscan-cases") / f"{case.name}.png"
    write_picture(picture, case.picture)
    look = "" if hasattr(case, "marks") else f"\nlscan extract {picture}"
    return f"{axes}\npicture: {picture}{look}"
