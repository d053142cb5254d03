"""The page: every number in its place, only the parts there are, and nothing from outside."""

import os
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from html.parser import HTMLParser
from typing import Any

import numpy as np
import pytest
import report_examples as examples
from places import SUPPORT

from lscan.errors import InputError
from lscan.paper import published as paper
from lscan.paper.experiment import ControlPoints, Experiment
from lscan.paper.report import write_report
from lscan.paper.tables import LABELS, checks, paper_tables
from lscan.records import Length, Status
from lscan.version import __version__

pytestmark = pytest.mark.xdist_group("report")  # one worker: they share a fixture


CHOSEN = paper.CHOSEN_MAP
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
        self.loads += [given[name] for name in LOADING if name in given]
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
def whole() -> Experiment:
    return examples.both_chains()


@pytest.fixture(scope="module")
def page() -> Page:
    """The page, its figures without drawings."""
    return Page(examples.undrawn(examples.both_chains()))


@pytest.fixture(scope="module")
def drawn() -> Page:
    return Page(examples.rendered())


def _signed(value: float, digits: int) -> str:
    return format(value, f"+.{digits}f").replace("-", "−")


def _our_cells(length: Length, beyond: bool) -> list[tuple[str, bool]]:
    percent = 100 * length.error_mm / length.nominal_mm
    return [
        (f"{length.measured_mm:.3f}", False),
        (f"{length.sigma_mm:.3f}", False),
        (_signed(length.error_mm, 3), beyond),
        (_signed(percent, 2), beyond),
    ]


def _paper_cells(row: paper.PrintedLength | None, beyond: bool) -> list[tuple[str, bool]]:
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
    for name, measures in whole.board.measures.items():
        for feature, length in getattr(measures, section).items():
            row = printed[feature][THEIRS[name]] if name in THEIRS else None
            heading = f"{_subscript(feature)} ({length.nominal_mm:.2f} mm)"
            expected = _paper_cells(row, row is not None and abs(row.percent) > 1.0)
            beyond = abs(100 * length.error_mm / length.nominal_mm) > 1.0
            assert page.cells[key, heading, name] == expected + _our_cells(length, beyond)


def test_table_3_holds_the_papers_numbers_and_ours(page, whole):
    for feature, length in whole.groove.dimensions.items():
        row = paper.TABLE_3[feature]
        expected = _paper_cells(row, abs(row.error_mm) > 0.6)
        ours = _our_cells(length, abs(length.error_mm) > 0.6)
        assert page.cells["table-3", "", feature][:7] == expected + ours
    assert page.cells["table-3", "", "H2"][1] == ("−0.66", True)


def test_summaries_hold_rms_and_largest_of_both(page, whole):
    for name, measures in whole.board.measures.items():
        errors = np.array([length.error_mm for length in measures.distances.values()])
        percent = 100 * errors / [length.nominal_mm for length in measures.distances.values()]
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


@pytest.mark.slow
def test_page_loads_nothing_from_outside(drawn):
    page = drawn
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


def test_every_table_is_in_a_box_that_scrolls(page):
    """What that gives on a phone, tests/system/test_report_page.py sees in a browser."""
    boxes = re.findall(
        r'<div class="scroll" tabindex="0" role="region" [^>]*><table>|"><table class="checks">',
        page.text,
    )
    assert len(boxes) == page.text.count("<table") > 3
    assert re.search(r"\.scroll \{[^}]*overflow-x: auto;", page.text)
    assert re.search(r"#surface \{[^}]*aspect-ratio: 4 / 3;", page.text)


@pytest.mark.slow  # of a figure, test_figures.py says it
def test_ids_are_unique_and_links_lead_somewhere(drawn):
    page = drawn
    assert len(set(page.ids)) == len(page.ids)
    assert {load[1:] for load in page.loads if load.startswith("#")} <= set(page.ids)


@pytest.mark.slow
def test_page_is_small_enough_to_send(drawn):
    assert len(drawn.text.encode()) < 12e6


def test_head_names_scene_versions_seconds_and_what_passed(page, whole):
    head = page.text[page.text.index("<header>") :]
    for expected in ("paper: the whole experiment", f"lscan {__version__}", "sandwave 301.2 s"):
        assert expected in head
    assert "✓ within" in head and "▲ beyond" in head


def _check(experiment: Experiment, what: str, bars: paper.Bars | None = None) -> Any:
    (found,) = (line for line in checks(experiment, bars or paper.Bars()) if what in line.what)
    return found


def _with_distances(experiment: Experiment, **changes: Any) -> Experiment:
    """The experiment with other measures of the board by the paper's choice of map."""
    measures = dict(experiment.board.measures)
    measures[CHOSEN] = replace(measures[CHOSEN], **changes)
    return replace(experiment, board=replace(experiment.board, measures=measures))


def test_checks_compare_with_the_bars(whole):
    measures = whole.board.measures[CHOSEN]
    worst = max(abs(length.error_mm) for length in measures.distances.values())
    distances = _check(whole, "Distances")
    assert distances.figure.startswith(f"{worst:.2f} mm")
    assert distances.paper == "0.28 mm, 0.57 %"
    assert _check(whole, "Grooved").paper == "0.66 mm"
    assert _check(whole, "Control points found").passed
    assert _check(whole, "Slice S3").passed
    for what in ("Distances", "Diameters", "Grooved", "Slice S3"):
        assert _check(whole, what, paper.Bars(0.01, 0.001, 0.1)).passed is False
    lenient = checks(whole, paper.Bars(50, 50, 50))
    assert not [line for line in lenient if line.passed is False]
    truth = replace(whole.truth, control_points=ControlPoints(100, 99, 0.03, 0.1))
    assert _check(replace(whole, truth=truth), "points found").passed is False


_SMALL = """
import report_examples as examples
from lscan.paper.report import render_report

text = render_report(examples.board_alone())
"""


@pytest.mark.slow  # test_figures.py draws one twice in a process
def test_same_experiments_give_the_same_bytes_in_any_process():
    here: dict[str, Any] = {}
    exec(_SMALL, here)
    path = os.pathsep.join(filter(None, [str(SUPPORT), os.environ.get("PYTHONPATH", "")]))
    elsewhere = subprocess.run(
        [sys.executable, "-c", f"{_SMALL}\nprint(text, end='')"],
        env={**os.environ, "PYTHONHASHSEED": "7", "PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=True,
    )
    assert elsewhere.stdout == here["text"]


BOARD_FIGURES = {
    "board", "control-points", "line-fits", "ruler",
    "sensitivity-graticule-bspline", "sensitivity-graticule-2",
}  # fmt: skip
SURFACE_FIGURES = {"raw", "levelled", "contours-before", "contours-after", "interactive"}
PARTS = {
    "board": ((), set(), {"table-1", "table-2"}),
    "groove": (("groove",), {"groove"}, {"table-1", "table-2", "table-3"}),
    "sandwave": (
        ("sandwave",),
        {"sandwave", "intensities", *SURFACE_FIGURES, *(f"slice-S{k}" for k in "123D")},
        {"table-1", "table-2", "slices"},
    ),
}


@pytest.fixture(scope="module")
def about_a_shaft(whole: Experiment) -> Experiment:
    """The experiment as if the head had been turned about a shaft."""
    alignment = replace(whole.sandwave.alignment, yaw_rad=0.0, sheared=False)
    return replace(whole, sandwave=replace(whole.sandwave, alignment=alignment))


@pytest.fixture(scope="module")
def pages(about_a_shaft: Experiment) -> Callable[[str], Page]:
    """The page of a part scanned besides the board, rendered once."""

    @cache
    def rendered(part: str) -> Page:
        scanned, _, _ = PARTS[part]
        missing = dict.fromkeys({"groove", "sandwave"} - set(scanned))
        shown = {name: about_a_shaft.shown[name] for name in scanned}
        return Page(examples.undrawn(replace(about_a_shaft, shown=shown, **missing)))

    return rendered


@pytest.mark.parametrize("part", PARTS)
def test_page_shows_the_parts_there_are(pages, part):
    """The board's are always there; Plotly weighs megabytes and is, where there is a surface."""
    _, figures, tables = PARTS[part]
    page = pages(part)
    assert {name.removesuffix("-figure") for name in page.figures} == BOARD_FIGURES | figures
    assert {table for table, _, _ in page.cells} == tables
    assert ("Plotly" in page.text) == (part == "sandwave")


def test_results_without_truth_say_nothing_of_it(whole):
    real = replace(whole, truth=None)
    assert _check(whole, "Yaw").figure == "2.200° (true 2.200°)"
    assert _check(real, "Yaw").figure == "2.200°"
    found = int(whole.board.reading.grid.found.sum())
    assert _check(real, "Control points").figure == f"{found} of 100"
    assert "truth" not in " ".join(line.what for line in checks(real, paper.Bars()))


def test_a_scan_about_a_shaft_has_no_yaw(about_a_shaft, page, pages):
    assert "Yaw" not in " ".join(line.what for line in checks(about_a_shaft, paper.Bars()))
    assert "yaw found" in page.text
    assert "yaw found" not in pages("sandwave").text


def test_what_was_not_measured_is_said_and_does_not_pass(whole):
    distances = {
        name: replace(length, measured_mm=length.nominal_mm)
        for name, length in whole.board.measures[CHOSEN].distances.items()
    }
    assert _check(_with_distances(whole, distances=distances), "Distances").passed
    del distances["A1A2"]
    missing = {"A1A2": Status.NOT_FOUND}
    check = _check(_with_distances(whole, distances=distances, unmeasured=missing), "Distances")
    assert check.passed is False
    assert check.figure == "0.00 mm, 0.00 %, 1 of 14 not measured"


def test_another_boards_length_is_not_compared_with_the_papers(whole):
    other = _with_distances(whole, distances={"A1A2": Length(50.0, 50.1, 0.1)})
    table = paper_tables(other, paper.Bars())[0]
    row = next(row for row in table.blocks[0].rows if row.code == CHOSEN)
    assert [cell.text for cell in row.paper] == ["—"] * 3


def test_maps_keep_the_papers_order_and_strangers_come_last(whole):
    some = whole.board.measures[CHOSEN]
    measures = dict.fromkeys(["my-map", *reversed(LABELS)], some)
    other = replace(whole, board=replace(whole.board, measures=measures))
    rows = paper_tables(other, paper.Bars())[0].blocks[0].rows
    assert [row.code for row in rows] == [*LABELS, "my-map"]
    assert [row.label for row in rows][:3] == list(paper.OUR_MAPS)
    assert rows[-1].label == "my-map"


def test_names_are_escaped():
    odd = replace(examples.board_alone(), scene="<script>alert(1)</script> & co")
    page = Page(examples.undrawn(odd))
    assert "script" not in page.tags
    assert "&lt;script&gt;" in page.text


def test_refused_pictures_and_folders_leave_the_old_file(tmp_path):
    path = tmp_path / "report.html"
    path.write_text("old")
    alone = examples.board_alone()
    no_picture = replace(alone.board, image=np.zeros((4, 4), dtype=float))
    with examples.without_drawing(), pytest.raises(InputError, match="not a picture"):
        write_report(path, replace(alone, board=no_picture))
    assert path.read_text() == "old"
    with examples.without_drawing(), pytest.raises(InputError, match="missing"):
        write_report(tmp_path / "missing" / "report.html", alone)
    assert [entry.name for entry in tmp_path.iterdir()] == ["report.html"]
