"""The report in headless Chromium at a phone's width: nothing of a table out of reach."""

from collections.abc import Iterator

import pytest
import report_examples as examples
from chromium import Chromium
from playwright.sync_api import Page

pytestmark = [pytest.mark.xdist_group("live_page"), pytest.mark.slow]
PHONE = (390, 844)
TABLES = """[...document.querySelectorAll("table")].map(table => {
  const box = table.parentElement;
  box.scrollLeft = 0;
  const edge = element => element.getBoundingClientRect();
  const rows = [...table.rows].filter(row => row.dataset.row);
  const name = rows[0]?.cells[0], last = [...(rows[0]?.cells ?? [])].at(-1);
  const wide = box.scrollWidth > box.clientWidth;
  box.scrollLeft = box.scrollWidth;
  return {
    box: [edge(box).left, edge(box).right], wide,
    last: last && [edge(last).left, edge(last).right],
    name: name && [edge(name).left, edge(name).right],
    reached: box.tabIndex,
  };
})"""


@pytest.fixture(scope="module")
def page(chromium: Chromium, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    path = tmp_path_factory.mktemp("report") / "report.html"
    path.write_text(examples.rendered(), encoding="utf-8")
    with chromium.phone(*PHONE) as page:
        page.goto(path.as_uri())
        yield page


def test_every_column_of_a_table_is_within_reach_on_a_phone(page: Page) -> None:
    """The page keeps still; a wide table scrolls in its box to its last column, names in view."""
    assert page.evaluate("[document.documentElement.scrollWidth, innerWidth]") == [390, 390]
    tables = page.evaluate(TABLES)
    assert sum(table["wide"] for table in tables) >= 3
    for table in tables:
        left, right = table["box"]
        assert 0 <= left < right <= PHONE[0]
        if not table["wide"]:
            continue
        assert table["reached"] == 0  # by the keyboard
        for edges in (table["last"], table["name"]):
            assert left - 1 <= edges[0] and edges[1] <= right + 1, table
        assert table["name"][1] <= table["last"][0] + 1  # the one does not cover the other


def test_the_surface_is_drawn_whole_on_a_phone(chromium: Chromium, page: Page) -> None:
    """The picture's box has the shape that the start view was computed for."""
    box = page.evaluate(
        """(() => { const box = document.querySelector("#surface").getBoundingClientRect();
        return [box.left, box.right, box.width / box.height]; })()"""
    )
    assert 0 <= box[0] < box[1] <= PHONE[0]
    assert box[2] == pytest.approx(4 / 3, abs=0.02)
    assert chromium.take_errors() == []
