"""The drawing of a board: every mark where the board file says, and readable by the reader."""

import xml.etree.ElementTree as ET
from pathlib import Path

import cv2
import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from places import PAPER_BOARD
from typer.testing import CliRunner

from lscan.board import read_board
from lscan.board.drawing import board_svg
from lscan.cli.app import app
from lscan.config.board import Board, Grid, Plate, load_board
from lscan.errors import InputError

PAPER_BOARD = PAPER_BOARD
SVG = "{http://www.w3.org/2000/svg}"


def discs(svg: str) -> np.ndarray:
    """(N, 3) of x, z, diameter of the filled marks, mm."""
    group = ET.fromstring(svg).find(f"{SVG}g[@id='marks']")
    assert group is not None
    rows = [[float(c.attrib[key]) for key in ("cx", "cy", "r")] for c in group]
    return np.array(rows) * [1, -1, 2]


@examples(40)
@given(
    columns=st.integers(3, 12),
    rows=st.integers(3, 12),
    pitch_mm=st.floats(1.0, 100.0),
    share=st.floats(0.05, 0.9),
)
def test_every_mark_is_drawn_in_its_place(
    columns: int, rows: int, pitch_mm: float, share: float
) -> None:
    """To rounding: numbers have four decimals, and a diameter is twice what is written."""
    grid = Grid(columns=columns, rows=rows, pitch_mm=pitch_mm, dot_diameter_mm=share * pitch_mm)
    board = Board(grid=grid)
    np.testing.assert_allclose(discs(board_svg(board)), board.discs_mm(), atol=1.01e-4)


def test_page_plate_and_units_agree() -> None:
    """A unit of the drawing is a millimetre of paper, and the bar is 100 of them."""
    root = ET.fromstring(board_svg(load_board(PAPER_BOARD)))
    x, y, width, height = map(float, root.attrib["viewBox"].split())
    assert root.attrib["width"] == f"{width:g}mm"
    assert root.attrib["height"] == f"{height:g}mm"
    plate, check = root.find(f"{SVG}rect"), root.find(f"{SVG}path[@id='check']")
    assert plate is not None and check is not None
    assert (x, y, width) == (-30.0, -30.0, 510.0)
    assert float(plate.attrib["height"]) == 510.0
    start, end = check.attrib["d"].split("M")[1].split("H")
    assert float(end) - float(start.split()[0]) == 100.0


def test_rings_have_their_width() -> None:
    board = load_board(PAPER_BOARD)
    group = ET.fromstring(board_svg(board)).find(f"{SVG}g[@id='rings']")
    assert group is not None
    drawn = {ring.attrib["id"]: ring.attrib for ring in group}
    for ring in board.ring:
        attributes = drawn[ring.name]
        assert 2 * float(attributes["r"]) == pytest.approx(ring.diameter_mm)
        assert float(attributes["stroke-width"]) == pytest.approx(ring.width_mm)
        assert float(attributes["cy"]) == pytest.approx(-ring.z_mm)


@pytest.mark.parametrize("marks", ["dark", "bright"])
def test_the_reader_finds_the_printed_board(marks: str) -> None:
    """Printed at 4 px a mm and looked at straight on: every control point, to 0.05 px.

    The bar is that of the reader's own tests; the drawing is rastered here by its numbers.
    """
    grid = Grid(columns=7, rows=6, pitch_mm=15.0, dot_diameter_mm=4.0)
    board = Board(marks=marks, grid=grid, plate=Plate(margin_mm=12.0))  # type: ignore[arg-type]
    svg = board_svg(board)
    scale, fine, shift = 4, 8, 4
    width, height = 114 * scale, 99 * scale
    paper, ink = (235, 25) if marks == "dark" else (25, 235)
    canvas = np.full((height * fine, width * fine), paper, np.uint8)
    for x, z, diameter in discs(svg):
        centre = (np.array([x + 12, 12 - z]) * scale * fine - 0.5) * 2**shift
        radius = diameter / 2 * scale * fine * 2**shift
        cv2.circle(
            canvas, np.rint(centre).astype(int).tolist(), round(radius), ink, -1, shift=shift
        )
    small = cv2.resize(canvas, (width, height), interpolation=cv2.INTER_AREA)
    reading = read_board(cv2.GaussianBlur(small, (0, 0), 0.8), board)
    assert reading.grid.found.all()
    expected = (grid.points_mm() * [1, -1] + 12) * scale - 0.5
    assert np.abs(reading.grid.image_px - expected).max() < 0.05


def test_the_command_takes_a_board_or_a_rig(tmp_path: Path) -> None:
    written = [tmp_path / "board.svg", tmp_path / "rig.svg"]
    sources = [PAPER_BOARD, PAPER_BOARD.with_name("board.toml")]
    for source, file in zip(sources, written, strict=True):
        result = CliRunner().invoke(app, ["draw-board", str(source), "-o", str(file)])
        assert result.exit_code == 0
        assert "510 by 510 mm" in result.output
    assert written[0].read_bytes() == written[1].read_bytes()


def test_what_is_no_board_is_refused(tmp_path: Path) -> None:
    other = tmp_path / "other.toml"
    other.write_text("[camera]\ndriver = 'sim'\n")
    result = CliRunner().invoke(app, ["draw-board", str(other), "-o", str(tmp_path / "b.svg")])
    assert isinstance(result.exception, InputError)
    assert "other.toml" in str(result.exception)
    assert not (tmp_path / "b.svg").exists()
