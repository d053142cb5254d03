"""The plugin as a stranger's package uses it: pytest in pytest, on the package in examples/.

Once with pytest as a command of its own, which starts two workers; otherwise within this process,
for each command takes seconds to import what is here already.
"""

import io
import json
import os
import re
import shutil
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from importlib.metadata import entry_points
from pathlib import Path
from types import SimpleNamespace

import pytest
from places import ROOT
from suite_cases import board_suite, drawn_suite, scan_suite

from lscan.stripe import find_extractor
from lscan.testing import UPDATE, pytest_configure

EXAMPLE = ROOT / "examples" / "line-finder"
LEAST_LINES = 15  # of a stranger's own test, at most


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """The example in a folder of its own, and beside it a suite of twelve cases.

    Of fewer than eleven not even a change of all is significant: 2 / 2^10 is above 1 % / 6.
    """
    shutil.copytree(EXAMPLE, tmp_path / "line-finder")
    drawn_suite(tmp_path / "twelve", 12)
    return tmp_path / "line-finder"


def run(package: Path, *arguments: str) -> tuple[int, str]:
    """Exit code and output of pytest in the package, on the twelve cases, within this process.

    What it has imported of the package is forgotten, as by a process that ends: the package may
    change before the next run.
    """
    said = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(said), redirect_stderr(said):
        patch.chdir(package)
        patch.delenv("CI", raising=False)
        patch.syspath_prepend(package / "src")
        # A process has one fault handler, and here it is that of the pytest about this one.  That
        # also looks for errors that nobody could raise, which goes through all of the memory.
        off = ["-p", "no:faulthandler", "-p", "no:unraisableexception"]
        code = pytest.main([*_options(package), *off, *arguments])
    for name, module in [*sys.modules.items()]:
        if str(getattr(module, "__file__", None)).startswith(f"{package}{os.sep}"):
            del sys.modules[name]
    find_extractor.cache_clear()
    return int(code), said.getvalue()


def run_as_command(package: Path, *arguments: str) -> tuple[int, str]:
    """As ``run``, by a command."""
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *_options(package), *arguments],
        cwd=package, capture_output=True, text=True, check=False,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(package / "src"), str(ROOT)])},
    )  # fmt: skip
    return done.returncode, done.stdout + done.stderr


def _options(package: Path) -> list[str]:
    known = {entry.name for entry in entry_points(group="pytest11")}
    plugin = [] if "lscan" in known else ["-p", "lscan.testing"]
    return [*plugin, "--lscan-suite", str(package.parent / "twelve")]


def change(package: Path, before: str, after: str) -> None:
    file = package / "src" / "line_finder" / "__init__.py"
    text = file.read_text(encoding="utf-8")
    assert before in text
    file.write_text(text.replace(before, after), encoding="utf-8")


@pytest.mark.slow
def test_a_baseline_is_written_kept_and_noticed(package: Path) -> None:
    """None: the test fails and says how; written: it passes; half a pixel off: it fails and says
    by what, and what to type.  Under xdist too."""
    code, said = run(package, "-k", "no_worse")
    assert code == 1 and "pytest --lscan-update writes it" in said
    code, said = run(package, "-k", "no_worse", "--lscan-update")
    assert code == 0 and "1 skipped" in said and "passed" not in said
    assert re.search(r"written, nothing tested: \S+baseline.json \(\S+no_worse\S*\)", said)
    baseline = package / "tests" / "baseline.json"
    written = baseline.read_bytes()
    code, said = run_as_command(package, "-n", "2", "-q")
    assert code == 0, said
    assert "13 passed" in said
    change(package, "centre_px=centre + nothing", "centre_px=centre + 0.5 + nothing")
    code, said = run(package, "-k", "no_worse")
    assert code == 1
    assert re.search(r"line_finder:find_line: rms error worse: \d", said)
    assert "lscan bench line_finder:find_line --suite" in said
    pictures = Path(re.search(r"pictures: (\S+)", said)[1])  # type: ignore[index]
    assert (pictures / "worst-line_finder.find_line.png").exists()
    assert baseline.read_bytes() == written


def test_a_case_that_fails_is_shown(package: Path) -> None:
    """With the picture where pytest's cache is; the drawn lines of its README pass."""
    assert run(package, "-k", "its_width", "--lscan-suite", "drawn")[0] == 0
    change(package, "centre_px=centre + nothing", "centre_px=centre + 3 + nothing")
    code, said = run(package, "-k", "its_width")
    assert code == 1 and "12 failed" in said
    picture = Path(re.search(r"picture: (\S+case-000\.png)", said)[1])  # type: ignore[index]
    assert picture.exists() and f"lscan extract {picture}" in said
    assert "water tap" in said
    code, said = run(package, "-k", "its_width", "-p", "no:cacheprovider")
    assert code == 1 and "12 failed" in said and "water tap" in said


def test_the_stranger_s_test_is_short() -> None:
    text = (EXAMPLE / "tests" / "test_line_finder.py").read_text(encoding="utf-8")
    assert sum(bool(line.strip()) for line in text.splitlines()) <= LEAST_LINES


def test_boards_are_cases_too(package: Path) -> None:
    """Four of a suite that has some, with the picture of one that fails; none of drawn lines."""
    (package.parent / "boards").mkdir()
    board_suite(package.parent / "boards")
    (package / "tests" / "test_boards.py").write_text(
        "def test_all_dots_are_in_view(board_case):\n"
        "    assert (board_case.marks.status == 0).all() and board_case.axes['water'] == 'tap'\n"
    )
    suite = ["--lscan-suite", str(package.parent / "boards"), "-k", "all_dots"]
    code, said = run(package, *suite)
    assert code == 1 and "2 failed, 2 passed" in said
    assert re.search(r"picture: \S+board-000\.png", said) and "lscan extract" not in said
    for suite in ("drawn", str(package.parent / "twelve")):
        code, said = run(package, "--lscan-suite", suite, "-k", "all_dots")
        assert code == 1 and "1 error" in said
        assert re.search(r"takes board_case, of which the suite '\S+' holds none", said)


def test_baselines_are_written_by_one_test_in_one_process(package: Path) -> None:
    (package / "tests" / "test_two.py").write_text(
        "def test_one(judge_extractor, assert_no_worse):\n"
        "    assert_no_worse(judge_extractor('max'), 'shared.json')\n"
        "def test_other(judge_extractor, assert_no_worse):\n"
        "    assert_no_worse(judge_extractor('centroid'), 'shared.json')\n"
    )
    code, said = run(package, "-k", "test_one or test_other", "--lscan-update")
    assert code == 1 and "1 failed, 1 skipped" in said
    assert "test_two.py::test_one too: name another" in said
    code, said = run(package, "-n", "2", "--lscan-update")
    assert code == 4 and "leave out -n" in said


def test_baselines_are_not_written_by_ci(monkeypatch: pytest.MonkeyPatch) -> None:
    config = SimpleNamespace(
        addinivalue_line=lambda *_: None,
        stash=pytest.Stash(),
        getoption=lambda name, *_: name == UPDATE,
    )
    monkeypatch.setenv("CI", "true")
    with pytest.raises(pytest.UsageError, match="CI is set"):
        pytest_configure(config)  # type: ignore[arg-type]
    monkeypatch.setenv("CI", "false")
    pytest_configure(config)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("mark", "code"),
    [
        ('name="{suite}"', 0),
        ('"{suite}"', 0),
        ('"{suite}", "quick"', 2),
    ],
)
def test_the_mark_names_one_suite(package: Path, mark: str, code: int) -> None:
    boards = package.parent / "boards"
    boards.mkdir()
    board_suite(boards)
    (package / "tests" / "test_marked.py").write_text(
        "import pytest\n"
        f"@pytest.mark.lscan_suite({mark.format(suite=boards)})\n"
        "def test_dots(board_case):\n"
        "    assert len(board_case.marks.status)\n"
    )
    done, said = run(package, "-k", "test_dots", "--lscan-suite", "")
    assert done == code, said
    assert ("4 passed" in said) if code == 0 else ("takes the name of one suite" in said)


@pytest.mark.parametrize(
    ("judge", "method"),
    [("map", "polynomial-3"), pytest.param("reader", "read_board", marks=pytest.mark.slow)],
)
def test_readers_and_maps_are_held_against_a_baseline(
    package: Path, judge: str, method: str
) -> None:
    """Pictures without a board: a reader finds nothing; a baseline in which it found all is not
    reached, and the command to look closer is that of boards."""
    (package.parent / "boards").mkdir()
    board_suite(package.parent / "boards", 12)
    (package / "tests" / "test_boards.py").write_text(
        f"def test_one(judge_{judge}, assert_no_worse):\n"
        f"    assert_no_worse(judge_{judge}('{method}'), 'one.json')\n"
    )
    suite = ["--lscan-suite", str(package.parent / "boards"), "-k", "test_one"]
    assert run(package, *suite, "--lscan-update")[0] == 0
    file = package / "tests" / "one.json"
    content = json.loads(file.read_text())
    missed = content["sums"].index("missed")
    for of in content["extractors"].values():
        for sums in of.values():
            sums[missed] = 0.0
    file.write_text(json.dumps(content))
    code, said = run(package, *suite)
    assert code == 1 and "missed columns worse" in said
    assert f"lscan bench --boards --{judge} {method} --suite" in said


@pytest.mark.slow  # boards, readers and maps go the same way above
def test_a_test_may_take_scans_and_judge_chains(package: Path) -> None:
    """Scans of a rig that nothing can be calibrated with: each is a case, and all of a chain is
    missed; a baseline that says otherwise is noticed."""
    scan_suite(package.parent / "scans", 12)
    (package / "tests" / "test_scans.py").write_text(
        "def test_scan(scan_case):\n"
        "    assert len(scan_case.frames) == scan_case.rig.plan.frames\n"
        "    assert scan_case.axes['target'] == 'sandwave', 'no sandwave'\n"
        "def test_chain(judge_chain, assert_no_worse):\n"
        "    assert_no_worse(judge_chain('paper/rig'), 'chain.json')\n"
    )
    suite = ["--lscan-suite", str(package.parent / "scans"), "-k", "test_scan or test_chain"]
    code, said = run(package, *suite, "--lscan-update")
    assert code == 1 and "6 failed, 6 passed, 1 skipped" in said
    assert "target grooved-block" in said
    file = package / "tests" / "chain.json"
    content = json.loads(file.read_text())
    parts = ("board", "points", "grooves", "slices")
    assert set(content["extractors"]) == {f"paper/rig: {part}" for part in parts}
    missed = content["sums"].index("missed")
    for sums in content["extractors"]["paper/rig: points"].values():
        assert sums[missed] == sums[content["sums"].index("clear")] > 0
        sums[missed] = 0.0
    file.write_text(json.dumps(content))
    code, said = run(package, *suite, "-k", "test_chain")
    assert code == 1 and "paper/rig: points: missed columns worse" in said
    assert "lscan bench --chain paper/rig --suite" in said
