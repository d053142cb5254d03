"""``make validate``: its rows, its page and its exit code, whatever the chapters do."""

import json
import os
import pickle
import time
from collections.abc import Callable
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from multiprocessing import active_children
from pathlib import Path
from typing import Any

import pytest
from click.testing import Result
from places import SCENES
from served import LONG_S
from typer.testing import CliRunner

from lscan.cli.console import run_command_line
from lscan.figures.page import ReportFigure
from sim.render.backend import THREADS
from tests.validation import run
from tests.validation.__main__ import app
from tests.validation.instrument import chapters as instrument
from tests.validation.instrument.photographs import photograph_rows
from tests.validation.light import chapters as light
from tests.validation.rows import Chapters, Request, Row, ScenePicture, Topic, rows_of
from tests.validation.run import THEMES, page_of, processes, run_theme


def row(figure: float, bar: float = 1.0, **changes: Any) -> Row:
    """A row of a length, which passes up to its bar."""
    return Row("a length", "a ruler", figure, bar, "mm", "its marks", **changes)


def topic(*rows: Row) -> Topic:
    return Topic("lengths", "Lengths", "Two <rods> & a ruler.", rows)


def invoked(
    folder: Path, monkeypatch: pytest.MonkeyPatch, chapters: Chapters, *options: str
) -> Result:
    """``make validate NAME=light`` with chapters in the place of its own."""
    monkeypatch.setattr(light, "chapters", lambda request: chapters)
    return CliRunner().invoke(app, ["light", "-o", str(folder / "out"), *options])


@pytest.mark.parametrize(("figure", "code"), [(0.5, 0), (2.0, 1)])
def test_the_exit_code_reports_a_row_beyond_its_bar(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, figure: float, code: int
) -> None:
    done = invoked(tmp_path, monkeypatch, {"lengths": lambda: topic(row(figure))})
    assert done.exit_code == code, done.output
    assert "a length" in done.output and ("NO" in done.output) == bool(code)
    (written,) = json.loads((tmp_path / "out" / "light.json").read_text())
    assert written["passed"] is (code == 0)
    assert "a ruler" in (tmp_path / "out" / "report.html").read_text()


def test_an_error_in_a_chapter_is_a_failed_row_and_not_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was measured before it is on disk by then, what comes behind it is measured too."""
    path = tmp_path / "out" / "light.json"

    def broken() -> Topic:
        assert [entry["figure"] for entry in json.loads(path.read_text())] == [0.5]
        raise ValueError("not a square number")

    chapters: Chapters = {
        "one": lambda: topic(row(0.5)), "two": broken, "three": lambda: [row(0.7)],
    }  # fmt: skip
    done = invoked(tmp_path, monkeypatch, chapters)
    assert done.exit_code == 1
    rows = json.loads(path.read_text())
    assert [entry["passed"] for entry in rows] == [True, False, True]
    assert rows[1]["what"] == "two" and rows[1]["figure"] is None
    assert "not a square number" in rows[1]["error"] and "not a square number" in done.output
    assert "not a square number" in (tmp_path / "out" / "report.html").read_text()


def test_a_quick_run_says_so_and_judges_only_what_noise_cannot_spoil(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = [row(0.5), row(2.0, noisy=True)]
    done = invoked(tmp_path, monkeypatch, {"lengths": lambda: rows}, "--quick")
    assert done.exit_code == 0, done.output
    written = json.loads((tmp_path / "out" / "light.json").read_text())
    assert [entry["quick"] for entry in written] == [True] * 2
    assert [entry["passed"] for entry in written] == [True, None]
    assert "not judged" in (tmp_path / "out" / "report.html").read_text()


def test_ctrl_c_leaves_what_was_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stopped() -> Topic:
        raise KeyboardInterrupt

    chapters: Chapters = {"one": lambda: [row(0.5)], "two": stopped}
    monkeypatch.setattr(light, "chapters", lambda request: chapters)
    monkeypatch.setattr("sys.argv", ["validation", "light", "-o", str(tmp_path / "out")])
    with pytest.raises(SystemExit) as left:
        run_command_line(app, "validation")
    assert left.value.code == 130
    assert capsys.readouterr().err == "validation: stopped\n"
    written = json.loads((tmp_path / "out" / "light.json").read_text())
    assert [entry["figure"] for entry in written] == [0.5]


@pytest.mark.slow
def test_chapters_side_by_side_keep_their_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In processes of their own: those of the instrument, and one that ends with an error."""
    photographs = {name: partial(photograph_rows, tmp_path) for name in ("first", "second")}
    given = {"bad": partial(int, "no number"), **photographs}
    monkeypatch.setattr(
        instrument, "CHAPTERS", {name: WithoutArguments(call) for name, call in given.items()}
    )
    output = tmp_path / "out"
    topics = run_theme("instrument", Request(SCENES, output), output)
    assert [one.title for one in topics] == ["Bad", "First", "Second"]
    rows = rows_of(topics)
    assert [one.passed for one in rows[:1]] == [False] and "no number" in rows[0].error
    written = json.loads((output / "instrument.json").read_text())
    assert [entry["what"] for entry in written] == [one.what for one in rows]


def test_chapters_in_processes_end_where_the_run_is_stopped() -> None:
    """Those that wait, too: each would take minutes."""
    with pytest.raises(KeyboardInterrupt), processes(1) as pool:
        waiting = [pool.submit(time.sleep, LONG_S) for _ in range(3)]
        while not waiting[0].running():
            time.sleep(0.01)
        raise KeyboardInterrupt
    assert all(isinstance(one.exception(), BrokenProcessPool) for one in waiting)
    assert not active_children()


class WithoutArguments:
    """A chapter of no scenes and effort, which can be pickled as a closure cannot."""

    def __init__(self, call: Callable[[], Any]) -> None:
        self.call = call

    def __call__(self, *_: object) -> Any:
        return self.call()


@pytest.mark.parametrize("theme", sorted(THEMES))
def test_a_theme_names_its_chapters(theme: str, tmp_path: Path) -> None:
    """The quick ones are among those of a whole run."""
    module = run.import_module(f"tests.validation.{THEMES[theme].module}")
    whole = module.chapters(Request(SCENES, tmp_path))
    quick = module.chapters(Request(SCENES, tmp_path, quick=True))
    assert whole and set(quick) <= set(whole)
    assert all(map(callable, whole.values()))
    if THEMES[theme].side_by_side:
        pickle.dumps(whole)  # for the processes that measure them


def test_a_theme_that_there_is_not_is_refused(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["lite", "-o", str(tmp_path / "out")])
    assert done.exit_code == 2 and "lite" in done.output and "light" in done.output
    assert not (tmp_path / "out").exists()


def test_the_page_shows_every_check_and_loads_nothing() -> None:
    figure = ReportFigure("plot", "A plot", "", "alt", "What is seen.", "<svg id='x'></svg>")
    plates = (ScenePicture("harbour water", "waters/harbor.toml", "data:image/jpeg;base64,AAAA"),)
    shown = Topic("more", "More lengths", "Why.", (row(3.0, seed=7),), (figure,), plates)
    page = page_of({"light": [topic(row(0.5)), shown], "speed": []}, 12.0)
    for text in (
        "Two &lt;rods&gt; &amp; a ruler.",
        "<svg id='x'></svg>",
        "seed 7",
        "What is seen.",
        "harbour water",
        "data:image/jpeg;base64,AAAA",
        "1 of 2 figures are beyond their bars",
        THEMES["speed"].question,
    ):
        assert text in page
    assert "http://" not in page.replace("http://www.w3.org", "") and "https://" not in page
    assert "All 1 figures are within" in page_of({"light": [topic(row(0.5))]})


@pytest.mark.parametrize(
    "cores, workers, said, expected",
    [(2, 2, None, "1"), (8, 3, None, "2"), (2, 3, None, "1"), (2, 2, "2", "2")],
)
def test_threads_are_shared_unless_the_user_says_otherwise(
    cores: int, workers: int, said: str | None, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run, "cores", lambda: cores)
    monkeypatch.setenv(THREADS, said or "")  # and taken back at the end, whatever is set meanwhile
    if said is None:
        monkeypatch.delenv(THREADS)
    run.share_threads(workers)
    assert os.environ[THREADS] == expected
