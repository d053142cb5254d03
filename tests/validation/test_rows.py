"""The evidence's machinery: rows, files, the page and the command's exit code."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st

from tests.validation.rows import (
    Row,
    RowFile,
    Topic,
    measured_rows,
    power_of,
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


@examples(50)
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
    keys = [
        "what",
        "reference",
        "figure",
        "bar",
        "unit",
        "tolerance_from",
        "seed",
        "quick",
        "passed",
    ]
    assert all(set(entry) == set(keys) for entry in read)
    assert [entry["figure"] for entry in read] == [0.5, 2.0, None]


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

    (failed,) = measured_rows("a length", wrong)
    assert failed.error.startswith("IndexError: list index out of range (test_rows.py:")
    (refused,) = measured_rows("a length", lambda: write_rows(Path("/proc/none"), []))  # type: ignore[func-returns-value]
    assert "/proc" in refused.error and "Error:" not in refused.error


@pytest.mark.parametrize("stop", [KeyboardInterrupt, SystemExit])
def test_a_stop_is_no_failed_row(stop: type[BaseException]) -> None:
    def stopped() -> list[Row]:
        raise stop

    with pytest.raises(stop):
        measured_rows("a length", stopped)


@pytest.mark.parametrize("figure, passed", [(14.9, False), (15.0, True), (float("nan"), False)])
def test_a_figure_may_have_to_reach_its_bar(figure: float, passed: bool) -> None:
    rate = row(figure, bar=15.0, at_least=True)
    assert rate.passed is passed
    assert rate.as_json()["at_least"] is True


def test_a_row_that_would_not_see_its_fault_is_not_judged() -> None:
    """Of a normal figure about twice the bar, 84 % are beyond it where its noise is the bar, and
    98 % where it is half of that."""
    weak, strong = power_of(2.0, 1.0, 1.0), power_of(2.0, 1.0, 0.5)
    assert (weak, strong) == pytest.approx((0.841, 0.977), abs=1e-3)
    good = Row("light", "the judge", 0.1, 1.0, "%", "required", power=strong)
    assert good.passed is True and good.as_json()["power"] == strong
    poor = replace(good, power=weak)
    assert poor.passed is None and "84%" in table_cells([poor])[0][0]
    assert replace(poor, figure=1.1).passed is False
    assert "power" not in replace(good, power=None).as_json()
