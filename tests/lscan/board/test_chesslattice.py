"""Which corners are the board's: slivers at the rim, rows skipped, chance, order of pictures."""

from functools import cache

import cv2
import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st

from lscan.board import chessboard as chesslattice
from lscan.board.chessboard import find_lattice, read_chessboard
from lscan.errors import BoardNotFound
from lscan.records import Bytes, Floats
from tests.validation.surfaces.drawn import DrawnView, chessboard_grey, photographed

ROWS, COLUMNS, SQUARE_MM = 6, 9, 20.0
NO_SLIVERS = (0.0, 0.0, 0.0, 0.0)
VIEW = DrawnView((480, 360), 520.0, 280.0, (80.0, -50.0), (15.0, -10.0, 4.0), 0.1)
CORNER_PX = 0.5  # of a corner that is another one; squares are 35 px wide
CORNERS_MM = SQUARE_MM * np.stack(
    [np.tile(np.arange(COLUMNS), ROWS), -np.repeat(np.arange(ROWS), COLUMNS)], axis=1
)


@cache
def drawn(view: DrawnView = VIEW, slivers: tuple[float, ...] = NO_SLIVERS, seed: int = 1) -> Bytes:
    left, right, top, bottom = slivers
    edges = (left, right, top, bottom)
    grey = chessboard_grey(view, (ROWS, COLUMNS), SQUARE_MM, edges, 0.9)
    return photographed(0.1 + 0.8 * grey, 2.0, np.random.default_rng(seed))


def answering(monkeypatch: pytest.MonkeyPatch, *answers: Floats) -> None:
    """The detectors give these answers, one each, OpenCV's two first; those left none."""
    found = [corners.reshape(ROWS, COLUMNS, 2) for corners in answers]
    monkeypatch.setattr(chesslattice, "_corners_by_opencv", lambda *_: found[:2])
    monkeypatch.setattr(chesslattice, "_corners_by_saddles", lambda *_: found[2:])


def lattice(rows: Floats, columns: Floats) -> Floats:
    """The corners as seen of a board with these rows and columns, counted from the first."""
    places = SQUARE_MM * np.stack(np.meshgrid(columns, -rows), axis=-1).reshape(-1, 2)
    return VIEW.image_px(places)


def test_a_plain_board_is_read_right() -> None:
    found = find_lattice(drawn(), COLUMNS, ROWS).reshape(-1, 2)
    truth = VIEW.image_px(CORNERS_MM)
    assert min(np.abs(found - t).max() for t in (truth, truth[::-1])) < 1.0


@pytest.mark.slow
@examples(6)
@given(
    slivers=st.tuples(*[st.sampled_from([0.0, 0.15, 0.3, 0.5])] * 4),
    turn=st.tuples(st.floats(-25, 25), st.floats(-25, 25), st.floats(-10, 10)),
    seed=st.integers(0, 99),
)
def test_beside_slivers_the_corners_are_the_right_ones_or_none(
    slivers: tuple[float, ...], turn: tuple[float, float, float], seed: int
) -> None:
    view = DrawnView(VIEW.size, VIEW.focal_px, 300.0, VIEW.middle_mm, turn, 0.1)
    try:
        marks = read_chessboard(drawn(view, slivers, seed), COLUMNS, ROWS, SQUARE_MM)
    except BoardNotFound:
        return
    truth = view.image_px(CORNERS_MM)
    misses = [np.nanmax(np.abs(marks.image_px - t)) for t in (truth, truth[::-1])]
    assert min(misses) < CORNER_PX


def test_a_lattice_that_skips_a_row_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    skips = lattice(np.array([0.0, 1.0, 2.0, 4.0, 5.0, 6.0]), np.arange(9.0))
    answering(monkeypatch, skips)
    with pytest.raises(BoardNotFound, match="no even lattice of 9 by 6"):
        find_lattice(drawn(), COLUMNS, ROWS)


def test_a_lattice_of_every_other_row_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is even, but its squares are not dark and bright in turn."""
    answering(monkeypatch, lattice(np.arange(-2.0, 10.0, 2.0), np.arange(9.0)))
    with pytest.raises(BoardNotFound, match="dark and bright in turn"):
        find_lattice(drawn(), COLUMNS, ROWS)


def test_the_answer_that_the_picture_bears_out_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    right = lattice(np.arange(6.0), np.arange(9.0))
    answering(monkeypatch, lattice(np.array([0.0, 1, 2, 4, 5, 6]), np.arange(9.0)), right)
    np.testing.assert_allclose(find_lattice(drawn(), COLUMNS, ROWS).reshape(-1, 2), right)


@pytest.mark.parametrize("shift", [(1, 0), (0, -1), (-1, 1)])
def test_a_lattice_a_row_off_is_put_right(
    monkeypatch: pytest.MonkeyPatch, shift: tuple[int, int]
) -> None:
    """Where slivers show, the whole squares about the rim say which corners are meant."""
    off = lattice(np.arange(6.0) + shift[0], np.arange(9.0) + shift[1])
    answering(monkeypatch, off)
    found = find_lattice(drawn(slivers=(0.3, 0.3, 0.3, 0.3)), COLUMNS, ROWS)
    # The row beyond the answer's rim is where equal steps lead: to a tenth of a square.
    np.testing.assert_allclose(found.reshape(-1, 2), VIEW.image_px(CORNERS_MM), atol=3.5)


@pytest.mark.slow
def test_the_answer_does_not_depend_on_what_was_asked_before() -> None:
    one, other = drawn(slivers=(0.3, 0.0, 0.4, 0.2)), drawn(seed=2)

    def read(picture: Bytes) -> Floats | None:
        try:
            return find_lattice(picture, COLUMNS, ROWS)
        except BoardNotFound:
            return None

    first = [read(one), read(other)]
    cv2.setRNGSeed(12345)
    second = [read(other), read(one)][::-1]
    np.testing.assert_equal(first, second)


def test_opencv_keeps_its_threads() -> None:
    threads = cv2.getNumThreads()
    find_lattice(drawn(), COLUMNS, ROWS)
    assert cv2.getNumThreads() == threads


@pytest.mark.parametrize(
    "slivers", [(0.3, 0.3, 0.3, 0.3), pytest.param((0.0, 0.5, 0.1, 0.0), marks=pytest.mark.slow)]
)
def test_a_board_with_slivers_is_found(slivers: tuple[float, ...]) -> None:
    """Both of OpenCV's detectors may give up on it; from corner to corner it is found."""
    found = find_lattice(drawn(slivers=slivers), COLUMNS, ROWS).reshape(-1, 2)
    truth = VIEW.image_px(CORNERS_MM)
    assert min(np.abs(found - t).max() for t in (truth, truth[::-1])) < 1.0


def test_fewer_corners_than_the_board_has_are_refused() -> None:
    """Which of its corners are meant nobody could say."""
    with pytest.raises(BoardNotFound, match="count the inner corners again"):
        find_lattice(drawn(), COLUMNS - 2, ROWS - 1)
