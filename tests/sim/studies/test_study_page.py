"""The page of a study: its words and tables parsed, its plots drawn in Chromium."""

import re
from collections.abc import Iterator
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import pytest
from chromium import Chromium
from playwright.sync_api import Page
from study_examples import GROUPS, REASONS, strange_results, study_results

from sim.studies.budget import CauseBudget, OutputBudget, StudyResults
from sim.studies.page import (
    comparison_text,
    comparison_words,
    figure,
    front_plot,
    headline,
    render_page,
    share,
    tolerance_sentence,
)
from sim.studies.problem import Bounded
from tests.validation.browser import wait_for

WITHOUT_END = {"meta", "link", "br", "img", "input"}


class ParsedPage(HTMLParser):
    """The text outside of scripts and styles, the elements, and those that stayed open."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.text, self.cells, self.headings, self.links = "", [""], [""], list[str]()
        self.scripts = 0
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note the element."""
        if tag not in WITHOUT_END:
            self.open.append(tag)
        self.scripts += tag == "script"
        self.cells += [""] * (tag in ("td", "th"))
        self.headings += [""] * (tag in ("h1", "h2"))
        self.links += [str(value) for name, value in attrs if name in ("src", "href")]

    def handle_endtag(self, tag: str) -> None:
        """The innermost open element ends."""
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        """Note the text."""
        if not {"script", "style"} & set(self.open):
            self.text += data
            self.cells[-1] += data if {"td", "th"} & set(self.open) else ""
            self.headings[-1] += data if {"h1", "h2"} & set(self.open) else ""


def test_the_page_holds_every_cause_and_figure() -> None:
    results, _ = study_results()
    page = ParsedPage(render_page(results))
    assert page.open == []
    assert all(link.startswith("#") for link in page.links)  # nothing is loaded
    for group in GROUPS:
        assert page.text.count(group) >= 2
    for reason in REASONS:
        assert reason in page.cells
    assert results.tolerances
    assert "weighted by cost, it is 0.099\u00a0mm: of 500 rigs" in tolerance_sentence(
        results.tolerances
    )
    assert tolerance_sentence(results.tolerances) in page.text
    for tolerance in results.tolerances.causes:
        for cell in (tolerance.allowed or "as it is", figure(tolerance.factor)):
            assert cell in page.cells
    for budget in results.outputs:
        assert headline(budget) in page.text
        for state in filter(None, (budget, budget.after)):
            assert state.rms and state.range_95
            assert f"{figure(state.rms.value)}{_interval(state.rms)}" in page.cells
            assert f"{figure(state.range_95[0])} to {figure(state.range_95[1])}" in page.cells
            for cause in state.causes:
                assert cause.alone_rms and cause.total
                assert f"{figure(cause.alone_rms.value)}{_interval(cause.alone_rms)}" in page.cells
                assert any(cell.startswith(share(cause.total.value)) for cell in page.cells)
    assert "5 % of the runs failed." in page.text


def test_the_page_and_the_text_say_which_of_two_rigs_is_better() -> None:
    results, _ = study_results()
    assert results.against
    page, text = ParsedPage(render_page(results)), comparison_text(results.against)
    for words in comparison_words(results.against):
        assert words in page.text and words in text
    assert "optics.gap_mm = 16, 3" in text and "3 of this one and 0 of the other" in text
    for one in results.against.outputs:
        assert one.verdict in page.cells and f"{one.name}: {one.verdict}." in text
    assert "−0.5−0.6 to −0.4" in page.cells and "4.2" in page.cells
    rows = [line.split("   ") for line in text.splitlines()]
    (tilt,) = ([cell for cell in row if cell] for row in rows if row[0].startswith("tilt"))
    assert [cell.strip() for cell in tilt] == ["tilt", "1.1 ± 0.1", "0.6 ± 0.1", "−0.5 ± 0.1"]


def test_names_are_shown_as_they_are_and_do_nothing() -> None:
    strange = strange_results()
    html = render_page(strange)
    page = ParsedPage(html)
    assert page.open == [] and page.scripts == 0  # no plot, no script
    assert page.headings[-3].startswith(strange.name)
    assert "<i>uniform</i>" in page.cells and "</script>" in page.cells
    assert f"No cause’s share of the variance of {strange.name}" in page.text


def test_names_do_nothing_in_plots_either() -> None:
    """Neither the element with the plots' data nor Plotly, which knows some HTML, reads them."""
    results, _ = study_results()
    ill = "</script><b>x"
    budget = results.outputs[0]
    causes = (replace(budget.causes[0], cause=ill), *budget.causes[1:])
    changed = replace(results, outputs=(replace(budget, causes=causes),), maps=(), scatters=())
    html = render_page(changed)
    page = ParsedPage(html)
    assert page.open == [] and page.scripts == 3
    data = re.search(r'<script type="application/json" id="plots">(.*?)</script>', html, re.DOTALL)
    assert data is not None
    assert "<" not in data[1] and "&lt;/script>&lt;b>x".replace(">", "&gt;") in data[1]


@pytest.mark.parametrize(
    ("total", "words"),
    [
        (Bounded(0.62, 0.58, 0.66), "Most of the variance of h comes from a: 62\u00a0%"),
        (
            Bounded(0.31, 0.28, 0.34),
            "The largest part of the variance of h comes from a: 31\u00a0%",
        ),
        (Bounded(0.31, -0.01, 0.64), "No cause’s share of the variance of h is told apart"),
        (None, "No cause’s share of the variance of h is told apart"),
    ],
)
def test_the_headline_says_what_is_told_apart(total: Bounded | None, words: str) -> None:
    budget = OutputBudget("h", "mm", 1, (CauseBudget("a", total=total),))
    assert headline(budget).startswith(words)
    assert "ecalibrating" not in headline(budget)


def test_the_headline_says_what_recalibrating_takes_away() -> None:
    after = OutputBudget("h.after", "mm", 1, (), rms=Bounded(0.12, 0.11, 0.13))
    before = OutputBudget("h", "mm", 1, (), rms=Bounded(0.65, 0.6, 0.7), after=after)
    assert "Recalibrating takes the rms error from 0.65\u00a0mm to 0.12\u00a0mm." in headline(
        before
    )
    same = replace(before, rms=Bounded(0.14, 0.12, 0.16))
    assert "does not change the rms error measurably" in headline(same)


def test_a_laser_class_has_its_name_on_the_page() -> None:
    """A number in its place, such as 2 for 3R, would say that the laser is safer than it is."""
    results = study_results()[0]
    classes = ["3B", "1", "3R", "2", "4"]
    trials = tuple(
        replace(trial, objectives={"cost / €": 1.0, "laser class": name}, parts={})
        for trial, name in zip(results.trials[:5], classes, strict=True)
    )
    plot = front_plot(trials)
    assert plot is not None and plot.data["values"][1] == classes
    assert plot.data["orders"] == [[], ["1", "2", "3R", "3B", "4"]]
    front = tuple(replace(trial, on_front=True) for trial in trials)
    page = render_page(_bare(results, trials=front))
    assert all(f"<td>{name}</td>" in page for name in classes)


def test_a_study_of_nothing_has_a_page() -> None:
    assert ParsedPage(render_page(_bare(study_results()[0]))).open == []


@pytest.fixture(scope="module")
def page(chromium: Chromium, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    path = tmp_path_factory.mktemp("study") / "report.html"
    path.write_text(render_page(study_results()[0]), encoding="utf-8")
    chromium.page.goto(path.as_uri())
    yield chromium.page


@pytest.mark.slow
@pytest.mark.xdist_group("live_page")
def test_every_plot_is_drawn_and_its_menus_work(chromium: Chromium, page: Page) -> None:
    boxes = page.locator(".plot")
    assert boxes.count() == 6 + 3 + 1  # height's, yaw's, the front
    for k in range(boxes.count()):
        boxes.nth(k).scroll_into_view_if_needed()
        wait_for(page, f"document.querySelectorAll('.plot')[{k}].querySelector('.main-svg')")
    colours = "document.querySelector('.plot[data-plot=\"5\"]').data[0].marker.color"
    before, menus = page.evaluate(colours), page.locator("select")
    menus.nth(0).select_option("speckle")
    assert page.evaluate(colours) != before
    menus.nth(1).select_option("mean error, after recalibration")
    menus.nth(4).select_option("laser class")
    depth = page.evaluate("document.querySelector('.wide .plot').data[0].z")
    assert set(depth) == {"2", "3R"}
    axis = page.evaluate("document.querySelector('.wide .plot')._fullLayout.scene.zaxis")
    assert (axis["type"], axis["categoryarray"]) == ("category", ["2", "3R"])
    page.evaluate(
        "document.querySelector('.wide .plot').emit('plotly_click', {points: [{customdata: 5}]})"
    )
    assert page.locator("tr.picked").get_attribute("id") == "design-5"
    assert chromium.take_errors() == []


@pytest.mark.slow
@pytest.mark.xdist_group("live_page")
def test_the_page_keeps_still_on_a_phone(chromium: Chromium, tmp_path: Path) -> None:
    """Wide tables scroll in boxes of their own, also where names are long."""
    for name, results in {"whole": study_results()[0], "strange": strange_results()}.items():
        (tmp_path / f"{name}.html").write_text(render_page(results), encoding="utf-8")
        with chromium.phone() as page:
            page.goto((tmp_path / f"{name}.html").as_uri())
            assert page.evaluate("[document.documentElement.scrollWidth, innerWidth]") == [390, 390]
            boxes = page.evaluate("[...document.querySelectorAll('.scroll')].map(b => b.tabIndex)")
            assert set(boxes) == {0}  # by the keyboard
    assert chromium.take_errors() == []


def _interval(bounded: Bounded) -> str:
    return f"{figure(bounded.low)} to {figure(bounded.high)}"


def _bare(results: StudyResults, **changes: object) -> StudyResults:
    """Results with no output and no cause."""
    nothing = {"causes": (), "outputs": (), "maps": (), "scatters": (), "tiers": (), "trials": ()}
    return replace(results, **(nothing | changes))
