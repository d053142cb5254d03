"""The evidence's machinery: rows, files, the page and the command's exit code."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from lscan.errors import InputError
from lscan.figures.exhibit import Exhibit
from sim.cli import app
from sim.verify import run
from sim.verify.gallery import Plate, gallery, scene_files
from sim.verify.report import render_page, share_of_bar
from sim.verify.rows import Check, Row, number, rows_of, write_rows


def row(figure: float, bar: float = 1.0, **changes: object) -> Row:
    fields: dict[str, object] = {
        "what": "a length", "reference": "a ruler", "unit": "mm", "tolerance_from": "its marks",
    }  # fmt: skip
    return Row(figure=figure, bar=bar, **(fields | changes))  # type: ignore[arg-type]


def check(*figures: float, key: str = "lengths") -> Check:
    return Check(key, "Lengths", "Two <rods> & a ruler.", tuple(row(value) for value in figures))


@settings(max_examples=50, deadline=None, derandomize=True)
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
    keys = {"what", "reference", "figure", "bar", "unit", "tolerance_from", "seed", "passed"}
    assert all(set(entry) == keys for entry in read)
    assert [entry["figure"] for entry in read] == [0.5, 2.0, None]


def test_a_disk_that_refuses_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(InputError, match="file"):
        write_rows(tmp_path / "file" / "verify.json", [row(0.0)])


@pytest.mark.parametrize(
    ("value", "text"), [(0.0, "0"), (0.005, "0.005"), (1e-10, "1.0e-10"), (22.06, "22")]
)
def test_numbers_are_short(value: float, text: str) -> None:
    assert number(value) == text


def test_the_gauge_is_full_where_the_bar_is_broken() -> None:
    assert share_of_bar(0.25, 1.0) == 25
    assert share_of_bar(2.0, 1.0) == 100
    assert share_of_bar(float("nan"), 1.0) == 100


def test_the_page_shows_every_check_and_loads_nothing() -> None:
    exhibit = Exhibit("plot", "A plot", "", "alt", "What is seen.", "<svg id='x'></svg>")
    shown = Check("more", "More lengths", "Why.", (row(3.0, seed=7),), (exhibit,))
    plates = (Plate("harbour water", "waters/harbor.toml", "data:image/jpeg;base64,AAAA"),)
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


@pytest.mark.parametrize(("figure", "code"), [(0.5, 0), (2.0, 1)])
def test_the_exit_code_tells_of_a_row_beyond_its_bar(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, figure: float, code: int
) -> None:
    monkeypatch.setattr(run, "chapters", lambda full: {"lengths": lambda: check(figure)})
    copy = tmp_path / "copy.json"
    folder = tmp_path / "out"
    done = CliRunner().invoke(app, ["verify", "-o", str(folder), "--json-file", str(copy)])
    assert done.exit_code == code, done.output
    assert "a length" in done.output
    assert copy.read_bytes() == (folder / "verify.json").read_bytes()
    assert json.loads(copy.read_text())[0]["passed"] is (code == 0)
    assert "a ruler" in (folder / "report.html").read_text()


def test_the_command_prints_its_rows_as_json(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run, "chapters", lambda full: {"lengths": lambda: check(0.5)})
    done = CliRunner().invoke(app, ["verify", "-o", str(tmp_path), "--json"])
    assert json.loads(done.stdout)[0]["what"] == "a length"


def test_the_gallery_shows_whole_scenes_only() -> None:
    scenes = Path(__file__).resolve().parents[2] / "scenes"
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
