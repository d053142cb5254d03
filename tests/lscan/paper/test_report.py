"""The page: every number in its place, only the parts there are, and nothing from outside."""

from __future__ import annotations

import copy
import dataclasses
import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from typing import Any

import numpy as np
import pytest
import report_examples as examples
from places import SUPPORT

from lscan.errors import InputError
from lscan.paper import published as paper
from lscan.paper.checks import checks
from lscan.paper.report import ReportInputs, render_report, write_report
from lscan.paper.tables import LABELS, paper_tables

pytestmark = pytest.mark.xdist_group("report")  # one worker: they share a fixture


LOADING = ("src", "href", "xlink:href", "data", "action")


class Page(HTMLParser):
    """A page taken apart: ids, attributes that may load something, and all table cells."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.ids: list[str] = []
        self.loads: list[str] = []
        self.tags: list[str] = []
        self.cells: dict[tuple[str, str, str], list[tuple[str, bool]]] = {}
        self.figures: dict[str, str] = {}
        self.table = self.block = self.row = self.figure = ""
        self.open: list[str] = []
        self.text = text
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        self.tags.append(tag)
        self.open.append(tag)
        if "id" in given:
            self.ids.append(given["id"])
        self.loads += [
            given[k] for k in ("src", "href", "xlink:href", "data", "action") if k in given
        ]
        if tag == "section":
            self.table = given.get("aria-labelledby", "")
        if tag == "caption" or tag == "table":
            self.block = ""
        if tag == "tr":
            self.row = given.get("data-row", "")
        if tag == "td" and self.row:
            key = (self.table, self.block, self.row)
            beyond = "beyond" in given.get("class", "").split()
            self.cells.setdefault(key, []).append(("", beyond))
        if tag == "figure":
            self.figure = given["id"]
            self.figures[self.figure] = ""

    def handle_endtag(self, tag: str) -> None:
        if tag == "figure":
            self.figure = ""
        while self.open and self.open.pop() != tag:
            pass

    def handle_data(self, data: str) -> None:
        inside = self.open[-1] if self.open else ""
        if inside == "caption":
            self.block += data
        if inside == "td" and self.row:
            cells = self.cells[self.table, self.block, self.row]
            cells[-1] = (cells[-1][0] + data, cells[-1][1])
        if self.figure:
            self.figures[self.figure] += data


@pytest.fixture(scope="module")
def whole() -> ReportInputs:
    return examples.whole_experiment()


@pytest.fixture(scope="module")
def page(whole: ReportInputs) -> Page:
    return Page(render_report(whole))


def _signed(value: float, digits: int) -> str:
    return format(value, f"+.{digits}f").replace("-", "−")


def _our_cells(entry: dict[str, float], beyond: bool) -> list[tuple[str, bool]]:
    percent = 100 * entry["error_mm"] / entry["nominal_mm"]
    return [
        (f"{entry['measured_mm']:.3f}", False),
        (f"{entry['sigma_mm']:.3f}", False),
        (_signed(entry["error_mm"], 3), beyond),
        (_signed(percent, 2), beyond),
    ]


def _paper_cells(row: paper.Printed | None, beyond: bool) -> list[tuple[str, bool]]:
    if row is None:
        return [("—", False)] * 3
    return [
        (f"{row.measured_mm:.2f}", False),
        (_signed(row.error_mm, 2), beyond),
        (_signed(row.percent, 2), beyond),
    ]


def _subscript(name: str) -> str:
    return "".join("₀₁₂₃₄₅₆₇₈₉"[int(c)] if c.isdigit() else c for c in name)


THEIRS = {ours: theirs for theirs, ours in paper.OUR_MAPS.items()}


@pytest.mark.parametrize(
    ("key", "section", "printed"),
    [("table-1", "distances", paper.TABLE_1), ("table-2", "diameters", paper.TABLE_2)],
)
def test_tables_1_and_2_hold_the_papers_numbers_and_ours(page, whole, key, section, printed):
    for name, entries in whole.results[section].items():
        for feature, entry in entries.items():
            row = printed[feature][THEIRS[name]] if name in THEIRS else None
            heading = f"{_subscript(feature)} ({entry['nominal_mm']:.2f} mm)"
            expected = _paper_cells(row, row is not None and abs(row.percent) > 1.0)
            beyond = abs(100 * entry["error_mm"] / entry["nominal_mm"]) > 1.0
            assert page.cells[key, heading, name] == expected + _our_cells(entry, beyond)


def test_table_3_holds_the_papers_numbers_and_ours(page, whole):
    for feature, entry in whole.results["groove"].items():
        row = paper.TABLE_3[feature]
        expected = _paper_cells(row, abs(row.error_mm) > 0.6)
        ours = _our_cells(entry, abs(entry["error_mm"]) > 0.6)
        assert page.cells["table-3", "", feature] == expected + ours
    assert page.cells["table-3", "", "H2"][1] == ("−0.66", True)


def test_summaries_hold_rms_and_largest_of_both(page, whole):
    for name, entries in whole.results["distances"].items():
        errors = np.array([entry["error_mm"] for entry in entries.values()])
        percent = 100 * errors / [entry["nominal_mm"] for entry in entries.values()]
        cells = page.cells["table-1", "All features together", name]
        ours = [np.sqrt(np.mean(errors**2)), np.abs(errors).max(), np.abs(percent).max()]
        assert [text for text, _ in cells[3:]] == [f"{value:.2f}" for value in ours]
        assert cells[5][1] == (np.abs(percent).max() > 1)
        if name not in THEIRS:
            assert [text for text, _ in cells[:3]] == ["—"] * 3
    # By hand from Table I: the cubic B-spline's worst is A1A2.
    spline = page.cells["table-1", "All features together", "graticule-bspline"]
    assert spline[1:3] == [("5.82", False), ("7.28", True)]


def test_page_has_the_counterpart_of_every_figure(page):
    text = " ".join(page.figures.values())
    for number in (9, 12, 13, 16, 21, *range(24, 36)):
        assert re.search(rf"\bFigs?\. (\d+, )?{number}\b", text), number
    for name, inside in page.figures.items():
        assert len(inside.strip()) > 60, name
    assert page.text.count('role="img"') == len(page.figures)
    assert page.text.count("<figcaption>") == len(page.figures)


def test_page_loads_nothing_from_outside(page):
    assert page.loads
    assert all(load.startswith(("#", "data:image/")) for load in page.loads)
    assert not {"link", "iframe", "object", "embed", "base", "form"} & set(page.tags)
    styles = re.findall(r"<style>(.*?)</style>", page.text, re.DOTALL)
    assert not [style for style in styles if "@import" in style or "url(" in style]
    assert not re.search(r"""url\((?!#|["']?data:)[^)]*\)""", _without_scripts(page.text))
    # Should a script try, the browser refuses.
    assert "Content-Security-Policy\" content=\"default-src 'none'" in page.text


def _without_scripts(text: str) -> str:
    return re.sub(r"<script>.*?</script>", "", text, flags=re.DOTALL)


def test_ids_are_unique_and_links_lead_somewhere(page):
    assert len(set(page.ids)) == len(page.ids)
    assert {load[1:] for load in page.loads if load.startswith("#")} <= set(page.ids)


def test_page_is_small_enough_to_send(page):
    assert len(page.text.encode()) < 12e6


def test_head_names_scene_versions_seconds_and_what_passed(page, whole):
    head = page.text[page.text.index("<header>") :]
    for expected in ("paper: the whole experiment", "lscan 0.1.0", "sandwave 301.2 s"):
        assert expected in head
    assert "✓ within" in head and "▲ beyond" in head


def _check(inputs: ReportInputs, what: str) -> Any:
    (found,) = (check for check in checks(inputs.results, inputs.bars) if what in check.what)
    return found


def test_checks_compare_with_the_bars(whole):
    worst = max(
        whole.results["distances"]["graticule-2"].values(), key=lambda e: abs(e["error_mm"])
    )
    distances = _check(whole, "Distances")
    assert distances.figure.startswith(f"{abs(worst['error_mm']):.2f} mm")
    assert distances.paper == "0.28 mm, 0.57 %"
    assert _check(whole, "Grooved").paper == "0.66 mm"
    assert _check(whole, "Control points found").passed
    assert _check(whole, "Slice S3").passed
    strict = dataclasses.replace(whole, bars=paper.Bars(0.01, 0.001, 0.1))
    for what in ("Distances", "Diameters", "Grooved", "Slice S3"):
        assert _check(strict, what).passed is False
    lenient = dataclasses.replace(whole, bars=paper.Bars(50, 50, 50))
    assert not [check for check in checks(lenient.results, lenient.bars) if check.passed is False]
    results = {**whole.results, "control_points": {"expected": 100, "found": 99}}
    assert _check(dataclasses.replace(whole, results=results), "points found").passed is False


_SMALL = """
import numpy as np, report_examples as examples
from lscan.paper.report import ReportInputs, render_report

rng = np.random.default_rng(3)
points = examples.to_image(np.array([[50.0 * k, 0.0] for k in range(10)]))
inputs = ReportInputs(
    results=examples.results(rng),
    board_image=examples.board_image(rng),
    row=examples.row_fits(points),
    turned=examples.workpiece_mm(60, 60),
    slices={"SD": examples.slice_data("SD", rng)},
)
text = render_report(inputs)
"""


def test_same_inputs_give_the_same_bytes_in_any_process():
    here: dict[str, Any] = {}
    exec(_SMALL, here)
    folder = str(SUPPORT)
    there = _run(f"{_SMALL}\nprint(text, end='')", PYTHONHASHSEED="7", PYTHONPATH=folder)
    assert there == here["text"]


def _run(script: str, **environment: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", script],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout


def test_importing_the_report_loads_no_plotting_library():
    script = "import sys, lscan.paper.report; print(*sys.modules, sep='\\n')"
    assert not {"matplotlib", "plotly", "jinja2"} & set(_run(script).split())


PARTS = {
    "nothing": ((), set()),
    "board": (
        ("board_image", "reading", "row", "ruler"),
        {"board", "control-points", "line-fits", "ruler"},
    ),
    "groove": (("groove_image",), {"groove"}),
    "sandwave": (("sandwave_images",), {"sandwave", "intensities"}),
    "unknown surface": (("raw",), {"raw", "interactive"}),
    "levelled only": (("levelled",), {"levelled"}),
}


@pytest.mark.parametrize("part", PARTS)
def test_page_shows_the_parts_there_are(whole, part):
    fields, figures = PARTS[part]
    inputs = ReportInputs(**{name: getattr(whole, name) for name in fields})
    page = Page(render_report(inputs))
    shown = {name.removesuffix("-figure") for name in page.figures}
    assert figures <= shown
    assert shown - figures <= {"sensitivity-graticule-bspline", "sensitivity-graticule-2"}
    assert not [tag for tag in page.tags if tag == "table"]
    # Plotly weighs megabytes: it is there only where there is a surface to turn.
    assert ("Plotly" in page.text) == ("interactive" in figures)


def test_surface_without_points_is_left_out(whole):
    empty = examples.surface(np.full((5, 6, 3), np.nan), "head")
    assert Page(render_report(ReportInputs(raw=empty))).figures == {}


def test_overlay_takes_the_place_of_drawn_crosses(whole):
    inputs = ReportInputs(board_image=whole.board_image, board_overlay=whole.board_image)
    assert set(Page(render_report(inputs)).figures) == {"board-figure", "control-points-figure"}


def test_results_without_truth_show_dashes(whole):
    results = copy.deepcopy(dict(whole.results))
    del results["render_check"]
    results["control_points"] = {"expected": 100, "found": 98, "rms_px": None, "max_px": None}
    results["sandwave"]["yaw_deg"] = {"estimated": 2.1}
    for entry in results["groove"].values():
        del entry["nominal_mm"], entry["error_mm"]
    del results["sandwave"]["slices"]
    inputs = ReportInputs(results=results)
    page = Page(render_report(inputs))
    cells = [text for text, _ in page.cells["table-3", "", "W1"]]
    measured = f"{results['groove']['W1']['measured_mm']:.3f}"
    assert cells == ["—", "—", "—", measured, "0.120", "—", "—"]
    assert _check(inputs, "Yaw").figure == "2.100°"
    whats = " ".join(check.what for check in checks(inputs.results, inputs.bars))
    assert "Grooved" not in whats and "Slice" not in whats and "truth" not in whats


def test_what_was_not_measured_is_said_and_does_not_pass(whole):
    results = copy.deepcopy(dict(whole.results))
    nothing = {"nominal_mm": 80.0, "measured_mm": np.nan, "error_mm": np.nan, "sigma_mm": np.nan}
    results["distances"]["graticule-2"] = {
        name: {**entry, "error_mm": 0.0}
        for name, entry in results["distances"]["graticule-2"].items()
    }
    assert _check(ReportInputs(results=results), "Distances").passed
    results["distances"]["graticule-2"]["A1A2"] = nothing
    results["sandwave"]["slices"]["S1"] |= {"min_mm": None, "max_mm": None, "rmse_mm": None}
    inputs = ReportInputs(results=results)
    assert _check(inputs, "Distances").passed is False
    assert "1 of 14 not measured" in _check(inputs, "Distances").figure
    assert _check(inputs, "Slice S1").figure == "no point compared"
    assert _check(inputs, "Slice S1").passed is False
    cells = Page(render_report(inputs)).cells["table-1", "A₁A₂ (80.00 mm)", "graticule-2"]
    assert [text for text, _ in cells[3:]] == ["—"] * 4


def test_another_boards_length_is_not_compared_with_the_papers():
    entry = {"nominal_mm": 50.0, "measured_mm": 50.1, "error_mm": 0.1, "sigma_mm": 0.1}
    (table,) = paper_tables({"distances": {"graticule-2": {"A1A2": entry}}}, paper.Bars())
    (row,) = table.blocks[0].rows
    assert [cell.text for cell in row.paper] == ["—"] * 3


def test_maps_keep_the_papers_order_and_strangers_come_last():
    entry = {"nominal_mm": 80.0, "measured_mm": 80.1, "error_mm": 0.1, "sigma_mm": 0.1}
    names = ["my-map", *reversed(LABELS)]
    (table,) = paper_tables({"distances": {n: {"A1A2": entry} for n in names}}, paper.Bars())
    rows = table.blocks[0].rows
    assert [row.code for row in rows] == [*LABELS, "my-map"]
    assert [row.label for row in rows][:3] == list(paper.OUR_MAPS)
    assert rows[-1].label == "my-map"


def test_names_are_escaped():
    page = Page(render_report(ReportInputs(results={"scene": "<script>alert(1)</script> & co"})))
    assert "script" not in page.tags
    assert "&lt;script&gt;" in page.text


def test_refused_pictures_and_folders_leave_the_old_file(tmp_path):
    path = tmp_path / "report.html"
    write_report(path, ReportInputs())
    old = path.read_bytes()
    with pytest.raises(InputError, match="not a picture"):
        write_report(path, ReportInputs(board_image=np.zeros((4, 4), dtype=float)))
    assert path.read_bytes() == old
    with pytest.raises(InputError, match="missing"):
        write_report(tmp_path / "missing" / "report.html", ReportInputs())
    assert [entry.name for entry in tmp_path.iterdir()] == ["report.html"]
