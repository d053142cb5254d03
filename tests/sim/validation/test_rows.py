"""The evidence's machinery: rows, files, the page and the command's exit code."""

import json
from pathlib import Path

import pytest
from click.testing import Result
from hypothesis import given, settings, strategies as st
from places import SCENES
from typer.testing import CliRunner

from lscan.cli.console import run_command_line
from lscan.errors import InputError
from lscan.figures.style import ReportFigure
from sim.cli.app import app
from sim.validation.physics import run
from sim.validation.physics.gallery import ScenePicture, gallery, scene_files
from sim.validation.physics.report import render_page, share_of_bar
from sim.validation.rows import (
    Row,
    RowFile,
    Topic,
    all_passed,
    measured,
    number,
    rows_of,
    table_cells,
    write_rows,
)


def row(figure: float, bar: float = 1.0, **changes: object) -> Row:
    fields: dict[str, object] = {
        "what": "a length", "reference": "a ruler", "unit": "mm", "tolerance_from": "its marks",
    }  # fmt: skip
    return Row(figure=figure, bar=bar, **(fields | changes))  # type: ignore[arg-type]


def check(*figures: float, key: str = "lengths") -> Topic:
    return Topic(key, "Lengths", "Two <rods> & a ruler.", tuple(row(value) for value in figures))


@settings(max_examples=50)
@given(figure=st.floats(-1e9, 1e9), bar=st.floats(0, 1e9))
def test_a_row_passes_where_its_figure_is_no_larger_than_its_bar(figure: float, bar: float) -> None:
    assert row(figure, bar).passed == (figure <= bar)


@pytest.mark.parametrize("figure", [float("nan"), float("inf"), float("-inf")])
def test_what_is_no_number_never_passes(figure: float) -> None:
    assert not row(figure, bar=1e300).passed
    assert row(figure).as_json()["figure"] is None


def test_the_json_file_holds_every_row(tmp_path: Path) -> None:
    rows = rows_of([check(0.5, 2.0), check(float("nan"))])
    write_rows(tmp_path / "deep" / "verify.json", rows)
    read = json.loads((tmp_path / "deep" / "verify.json").read_text())
    assert [entry["passed"] for entry in read] == [True, False, False]
    keys = {
        "what",
        "reference",
        "figure",
        "bar",
        "unit",
        "tolerance_from",
        "seed",
        "quick",
        "passed",
    }
    assert all(set(entry) == keys for entry in read)
    assert [entry["figure"] for entry in read] == [0.5, 2.0, None]


def test_a_disk_that_refuses_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(InputError, match="file"):
        write_rows(tmp_path / "file" / "verify.json", [row(0.0)])


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0, "0"), (0.005, "0.005"), (1e-10, "1.0e-10"), (22.06, "22"), (99.5, "99.5"), (100, "100")],
)
def test_numbers_are_short(value: float, text: str) -> None:
    assert number(value) == text


def test_the_gauge_is_full_where_the_bar_is_broken() -> None:
    assert share_of_bar(0.25, 1.0) == 25
    assert share_of_bar(2.0, 1.0) == 100
    assert share_of_bar(float("nan"), 1.0) == 100


def test_the_page_shows_every_check_and_loads_nothing() -> None:
    figure = ReportFigure("plot", "A plot", "", "alt", "What is seen.", "<svg id='x'></svg>")
    shown = Topic("more", "More lengths", "Why.", (row(3.0, seed=7),), (figure,))
    plates = (ScenePicture("harbour water", "waters/harbor.toml", "data:image/jpeg;base64,AAAA"),)
    page = render_page([check(0.5), shown], plates, 12.0)
    for text in (
        "Two &lt;rods&gt; &amp; a ruler.",
        "<svg id='x'></svg>",
        "seed 7",
        "What is seen.",
    ):
        assert text in page
    assert "1 of 2 figures are beyond their bars" in page
    assert "harbour water" in page and "data:image/jpeg;base64,AAAA" in page
    assert "http://" not in page.replace("http://www.w3.org", "") and "https://" not in page
    assert "All 1 figures are within" in render_page([check(0.5)])


def invoked(
    folder: Path, monkeypatch: pytest.MonkeyPatch, chapters: dict[str, object], *options: str
) -> Result:
    """``lscan-sim verify`` with chapters in the place of its own, on a folder of no scenes."""
    scenes = folder / "scenes"
    scenes.mkdir()
    monkeypatch.setattr(run, "chapters", lambda effort: chapters)
    output = ["-o", str(folder / "out"), "--scenes", str(scenes)]
    return CliRunner().invoke(app, ["verify", *output, *options])


@pytest.mark.parametrize(("figure", "code"), [(0.5, 0), (2.0, 1)])
def test_the_exit_code_reports_a_row_beyond_its_bar(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, figure: float, code: int
) -> None:
    copy, folder = tmp_path / "copy.json", tmp_path / "out"
    chapters = {"lengths": lambda: check(figure)}
    done = invoked(tmp_path, monkeypatch, chapters, "--json-file", str(copy))
    assert done.exit_code == code, done.output
    assert "a length" in done.output
    assert copy.read_bytes() == (folder / "verify.json").read_bytes()
    assert json.loads(copy.read_text())[0]["passed"] is (code == 0)
    assert "a ruler" in (folder / "report.html").read_text()


def test_the_command_prints_its_rows_as_json(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done = invoked(tmp_path, monkeypatch, {"lengths": lambda: check(0.5)}, "--json")
    assert json.loads(done.stdout)[0]["what"] == "a length"


def test_an_error_in_a_chapter_is_a_failed_row_and_not_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was measured before it is on disk by then, what comes behind it is measured too."""
    path = tmp_path / "out" / "verify.json"

    def broken() -> Topic:
        assert [entry["figure"] for entry in json.loads(path.read_text())] == [0.5]
        raise ValueError("not a square number")

    chapters = {"one": lambda: check(0.5), "two": broken, "three": lambda: check(0.7)}
    done = invoked(tmp_path, monkeypatch, chapters)
    assert done.exit_code == 1
    rows = json.loads(path.read_text())
    assert [entry["passed"] for entry in rows] == [True, False, True, True]
    assert rows[1]["what"] == "two" and rows[1]["figure"] is None
    assert "not a square number" in rows[1]["error"] and "not a square number" in done.output
    assert "not a square number" in (tmp_path / "out" / "report.html").read_text()


def test_a_quick_run_says_so_and_judges_only_what_noise_cannot_spoil(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = (row(0.5), row(2.0, noisy=True), row(float("nan"), noisy=True))
    chapters = {"lengths": lambda: Topic("lengths", "Lengths", "Some.", rows[:2])}
    done = invoked(tmp_path, monkeypatch, chapters, "--quick")
    assert done.exit_code == 0, done.output
    written = json.loads((tmp_path / "out" / "verify.json").read_text())
    assert [entry["quick"] for entry in written] == [True] * 3
    assert [entry["passed"] for entry in written] == [True, None, True]
    assert "not judged" in (tmp_path / "out" / "report.html").read_text()
    # Noise never makes a figure that is no number.
    file = RowFile(tmp_path / "rows.json", quick=True)
    assert [marked.passed for marked in file.add(rows)] == [True, None, False]
    assert not all_passed(file.rows)
    assert [cells[-1] for cells in table_cells(file.rows)] == ["yes", "-", "NO"]


def test_rows_keep_their_places_whenever_they_come(tmp_path: Path) -> None:
    file = RowFile(tmp_path / "deep" / "rows.json", quick=False)
    assert json.loads(file.path.read_text()) == []
    for place in (2, 0, 1):
        file.add([row(float(place))], place)
        held = [entry["figure"] for entry in json.loads(file.path.read_text())]
        assert held == sorted(held) and place in held
    file.add([row(9.0)])
    assert [kept.figure for kept in file.rows] == [0.0, 1.0, 2.0, 9.0]


def test_an_error_of_the_program_says_where_it_arose() -> None:
    def wrong() -> list[Row]:
        return [row([1.0][5])]

    (failed,) = measured("a length", wrong)
    assert failed.error.startswith("IndexError: list index out of range (test_rows.py:")
    (refused,) = measured("a length", lambda: write_rows(Path("/proc/none"), []))  # type: ignore[func-returns-value]
    assert "/proc" in refused.error and "Error:" not in refused.error


def test_ctrl_c_in_verify_speaks_of_no_scan(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """What was measured before it stays on disk."""

    def stopped() -> Topic:
        raise KeyboardInterrupt

    chapters = {"one": lambda: check(0.5), "two": stopped}
    monkeypatch.setattr(run, "chapters", lambda effort: chapters)
    command = ["lscan-sim", "verify", "-o", str(tmp_path / "out"), "--scenes", str(tmp_path)]
    monkeypatch.setattr("sys.argv", command)
    with pytest.raises(SystemExit) as left:
        run_command_line(app, "lscan-sim")
    assert left.value.code == 130
    assert capsys.readouterr().err == "lscan-sim: stopped\n"
    written = json.loads((tmp_path / "out" / "verify.json").read_text())
    assert [entry["figure"] for entry in written] == [0.5]


@pytest.mark.parametrize("stop", [KeyboardInterrupt, SystemExit])
def test_a_stop_is_no_failed_row(stop: type[BaseException]) -> None:
    def stopped() -> list[Row]:
        raise stop

    with pytest.raises(stop):
        measured("a length", stopped)


def test_the_gallery_shows_whole_scenes_only() -> None:
    scenes = SCENES
    names = [path.name for path in scene_files(scenes)]
    assert {"groove.toml", "harbor.toml", "mirror.toml", "dome.toml"} <= set(names)
    assert "rig.toml" not in names and "calibration-board.toml" not in names


def test_a_gallery_of_nothing_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nowhere"):
        gallery(tmp_path / "nowhere")


@pytest.mark.parametrize("figure, passed", [(14.9, False), (15.0, True), (float("nan"), False)])
def test_a_figure_may_have_to_reach_its_bar(figure: float, passed: bool) -> None:
    rate = row(figure, bar=15.0, at_least=True)
    assert rate.passed is passed
    assert rate.as_json()["at_least"] is True
