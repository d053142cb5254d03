"""The paper's numbers: copied rightly, and consistent but for the misprints that are listed."""

import math
import re

import pytest
from places import ROOT

from lscan.config.board import load_board
from lscan.config.targets import GroovedBlock
from lscan.paper import published as paper

_TEXT = ROOT / ".." / "shared" / "paper.txt"
_ALL = [
    (f"{place}, {feature}, {method[0].lower() + method[1:]}", row)
    for place, table in (("Table I", paper.TABLE_1), ("Table II", paper.TABLE_2))
    for feature, rows in table.items()
    for method, row in rows.items()
] + [(f"Table III, {feature}", row) for feature, row in paper.TABLE_3.items()]

# Every number is printed to two decimals, so it is off by at most half a hundredth.
_HALF = 0.005 + 1e-9


def _places(of: str) -> set[str]:
    return {misprint.place for misprint in paper.MISPRINTS if of in misprint.place}


def test_error_is_measured_minus_nominal_but_for_the_misprint_listed():
    wrong = {
        place
        for place, row in _ALL
        if abs(row.measured_mm - row.nominal_mm - row.error_mm) > 3 * _HALF
    }
    assert wrong == _places("A1A2") == {"Table I, A1A2, cubic B-spline"}


@pytest.mark.parametrize(("place", "row"), _ALL)
def test_percentage_is_error_over_nominal(place, row):
    assert abs(100 * row.error_mm / row.nominal_mm - row.percent) <= _HALF + 100 * _HALF / (
        row.nominal_mm
    )


def test_the_misprinted_length_follows_from_its_error():
    row = paper.TABLE_1["A1A2"]["Cubic B-spline"]
    (misprint,) = (m for m in paper.MISPRINTS if "A1A2" in m.place)
    assert f"{row.nominal_mm + row.error_mm:.2f} mm" in misprint.follows
    assert f"{row.measured_mm:.2f} mm" in misprint.printed


def test_table_3_contradicts_the_text_where_listed():
    beyond = {
        name: row.error_mm
        for name, row in paper.TABLE_3.items()
        if abs(row.error_mm) >= paper.Bars().groove_mm
    }
    assert beyond == {"H2": -0.66}
    assert _places("Table III") == {"Sec. IV.B on Table III"}


def _centre(pixels: tuple[tuple[int, int], ...], floor: int) -> float:
    return sum(v * (i - floor) for v, i in pixels) / sum(i - floor for _, i in pixels)


def test_centres_follow_from_the_pixels_but_for_frame_3():
    half = 0.00005 + 1e-9  # printed to four decimals
    for kind, printed in (
        ("intensities as they are", paper.CENTRES_RAW_PX),
        ("relative intensities", paper.CENTRES_RELATIVE_PX),
    ):
        floors = [0 if "are" in kind else min(i for _, i in f) for f in paper.COLUMN_PIXELS]
        ours = [_centre(f, floor) for f, floor in zip(paper.COLUMN_PIXELS, floors, strict=True)]
        assert abs(ours[0] - printed[0]) <= half
        assert abs(ours[1] - printed[1]) <= half
        (misprint,) = (m for m in paper.MISPRINTS if m.place.endswith(kind))
        assert abs(ours[2] - printed[2]) > half
        assert f"{printed[2]:.4f} px" == misprint.printed
        assert f"{ours[2]:.4f} px" in misprint.follows


def test_the_spreads_the_text_quotes_follow_from_the_centres():
    raw, relative = paper.CENTRES_RAW_PX, paper.CENTRES_RELATIVE_PX
    assert math.isclose(max(raw) - min(raw), 0.6774, abs_tol=1e-9)
    assert max(relative) - min(relative) < 0.1


def test_nominals_are_those_of_the_board_and_the_block():
    board = load_board(ROOT / "scenes" / "paper" / "calibration-board.toml")
    for first, second in board.distances:
        rows = paper.TABLE_1[first + second]
        for row in rows.values():
            assert abs(board.distance_mm(first, second) - row.nominal_mm) <= _HALF
    assert len(board.distances) == len(paper.TABLE_1)
    rings = {ring.name: ring.diameter_mm for ring in board.ring}
    assert rings == {name: rows["First rms"].nominal_mm for name, rows in paper.TABLE_2.items()}
    block = GroovedBlock().dimensions_mm()
    assert block.keys() == paper.TABLE_3.keys()
    for name, row in paper.TABLE_3.items():
        assert math.isclose(block[name], row.nominal_mm, abs_tol=1e-9)


@pytest.mark.skipif(not _TEXT.exists(), reason="the paper's text is not here")
def test_tables_are_copied_as_printed():
    lines = _TEXT.read_text(encoding="utf-8").splitlines()
    names = {"First rms": "First rms", "Second rms": "Second rms", "Cubic B-spline": "Cubic"}
    for method, start in names.items():
        rows = [line for line in lines if line.startswith(start) and "\t" in line]
        printed = [float(n) for line in rows for n in re.findall(r"-?\d+\.\d+", line)]
        tables = [rows[method] for t in (paper.TABLE_1, paper.TABLE_2) for rows in t.values()]
        if method == "Second rms":
            tables += paper.TABLE_3.values()
        ours = [n for row in tables for n in (row.measured_mm, row.error_mm, row.percent)]
        assert printed == ours


def test_text_claims_stand_where_the_bars_say():
    bars = paper.Bars()
    second = [rows["Second rms"] for t in (paper.TABLE_1, paper.TABLE_2) for rows in t.values()]
    assert max(abs(row.percent) for row in second) < bars.board_percent
    assert max(paper.SLICE_ERRORS_MM) == bars.sandwave_mm
