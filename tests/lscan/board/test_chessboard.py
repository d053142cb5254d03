"""Corners of chessboards and ChArUco boards: truth, scatter, photographs, refusals."""

from functools import cache

import cv2
import numpy as np
import pytest

from lscan.board.chessboard import read_charuco, read_chessboard
from lscan.errors import BoardNotFound, InputError
from lscan.records import Bytes, Floats

TURN = np.deg2rad(7.0)
SIDE = 40.0  # px


def chessboard(noise_dn: float = 0.0, seed: int = 0) -> tuple[Floats, Floats]:
    """A picture of 8 by 6 squares, a little turned and blurred, and its (35, 2) true corners."""
    grey, truth = drawn_chessboard()
    return grey + np.random.default_rng(seed).normal(0, noise_dn, grey.shape), truth


@cache
def drawn_chessboard() -> tuple[Floats, Floats]:
    """The same without noise; not to be written to."""
    fine, blur = 4, 0.8
    v, u = (np.mgrid[: 480 * fine, : 640 * fine] + 0.5) / fine - 0.5
    cos, sin = np.cos(TURN), np.sin(TURN)
    x = (cos * (u - 150) + sin * (v - 90)) / SIDE
    y = (-sin * (u - 150) + cos * (v - 90)) / SIDE
    inside = (x >= 0) & (x < 8) & (y >= 0) & (y < 6)
    dark = inside & ((np.floor(x) + np.floor(y)) % 2 == 0)
    sharp = np.where(dark, 30.0, 210.0)
    grey = cv2.GaussianBlur(sharp, (0, 0), fine * blur)
    grey = grey.reshape(480, fine, 640, fine).mean(axis=(1, 3))
    row, column = np.divmod(np.arange(35), 7)
    right, down = SIDE * (column + 1), SIDE * (row + 1)
    truth = np.column_stack([150 + cos * right - sin * down, 90 + sin * right + cos * down])
    return grey, truth


DRAWN_PX = 1 / 8 / np.sqrt(3) / np.sqrt(30)
"""Standard deviation of a corner as drawn: edges lie on quarter pixels, so each row of them errs by
up to 1/8 px either way, and some 30 rows average out."""

MARKER_PX = 0.01 * 4.0
"""What a marker may shift a corner by: it weighs 1 % in a window of a sigma of 4 px."""


def test_corners_are_where_they_are() -> None:
    grey, truth = chessboard()
    marks = read_chessboard(grey, 7, 5, 10.0)
    assert marks.found.all()
    np.testing.assert_allclose(marks.image_px, truth, atol=3 * DRAWN_PX)
    np.testing.assert_array_equal(marks.board_mm[[0, 1, 7]], [[0, 0], [10, 0], [0, -10]])


def test_sigma_of_a_corner_is_its_scatter() -> None:
    found = [read_chessboard(chessboard(4.0, seed)[0], 7, 5, 10.0) for seed in range(10)]
    points = np.stack([marks.image_px for marks in found])
    score = points.std(axis=0, ddof=1) ** 2 / (found[0].sigma_px ** 2)[:, None]
    # 70 coordinates of 9 degrees of freedom: good to 6 %; three of that.
    assert score.mean() == pytest.approx(1.0, abs=0.18)


def test_an_ideal_corner_has_no_other_error_than_noise() -> None:
    grey, _ = chessboard()
    assert read_chessboard(grey, 7, 5, 10.0).sigma_px.max() <= 3 * DRAWN_PX


def test_sigma_of_a_corner_grows_in_slanting_light() -> None:
    """Light that falls to one side moves all saddles, by the square of the window's size.

    A window 1.6 times narrower moves them by 0.39 of that, so 0.61 of the shift s is seen, whose
    square the median turns into a variance of (0.61 s)² / (2 ln 2): a sigma of 0.52 s.  The error
    of a coordinate, s in one direction and 0 in the other, is 0.71 s: sigma is 0.73 of it.
    """
    grey, truth = chessboard()
    lit = grey * np.exp(-np.arange(640) / 200.0)
    marks = read_chessboard(lit, 7, 5, 10.0)
    error = float(np.sqrt(np.mean((marks.image_px - truth) ** 2)))
    assert error > 0.05  # above what the drawing does
    # The shift grows a little faster than that by the squares' blur: a tenth to either side.
    assert 0.65 <= float(np.mean(marks.sigma_px)) / error <= 0.81


def charuco(squares_down: int = 5, legacy: bool = False) -> Bytes:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    board = cv2.aruco.CharucoBoard((7, squares_down), 20.0, 14.0, dictionary)
    board.setLegacyPattern(legacy)
    height = 80 * squares_down
    picture = np.full((height + 80, 640), 255, np.uint8)
    picture[40:-40, 40:600] = board.generateImage((560, height))
    return picture


def test_charuco_corners_and_those_that_are_hidden() -> None:
    picture = charuco()
    marks = read_charuco(picture, 6, 4, 20.0, 14.0, "DICT_4X4_50")
    assert marks.found.all()
    row, column = np.divmod(np.arange(24), 6)
    # Squares of 80 px from (40, 40): corners lie between pixels, half a pixel before.
    truth = np.column_stack([119.5 + 80 * column, 119.5 + 80 * row])
    np.testing.assert_allclose(marks.image_px, truth, atol=MARKER_PX)
    picture[:, :200] = 255
    hidden = read_charuco(picture, 6, 4, 20.0, 14.0, "DICT_4X4_50")
    assert 6 <= hidden.found.sum() < 24
    seen = hidden.found
    np.testing.assert_allclose(hidden.image_px[seen], marks.image_px[seen], atol=MARKER_PX)


@pytest.mark.parametrize("legacy", [False, True])
def test_charuco_boards_of_an_even_number_of_rows_have_two_layouts(legacy: bool) -> None:
    marks = read_charuco(charuco(6, legacy), 6, 5, 20.0, 14.0, "DICT_4X4_50")
    row, column = np.divmod(np.arange(30), 6)
    truth = np.column_stack([119.5 + 80 * column, 119.5 + 80 * row])
    np.testing.assert_allclose(marks.image_px, truth, atol=MARKER_PX)


def test_no_board_and_bad_boards() -> None:
    blank = np.full((480, 640), 128, np.uint8)
    with pytest.raises(BoardNotFound, match="7 by 5"):
        read_chessboard(blank, 7, 5, 10.0)
    with pytest.raises(BoardNotFound, match="0 corners"):
        read_charuco(blank, 6, 4, 20.0, 14.0, "DICT_4X4_50")
    with pytest.raises(InputError, match="marker_mm"):
        read_charuco(blank, 6, 4, 20.0, 24.0, "DICT_4X4_50")
    with pytest.raises(InputError, match="dictionary"):
        read_charuco(blank, 6, 4, 20.0, 14.0, "DICT_NONE")


@pytest.mark.parametrize(
    ("change", "stated", "said"),
    [
        ({}, (6, 4, "DICT_5X5_100"), "17 markers of DICT_4X4_1000 .* none of DICT_5X5_100$"),
        ({}, (4, 6, "DICT_4X4_50"), "columns = 6, rows = 4 or more$"),
        ({}, (8, 6, "DICT_4X4_50"), "columns = 6, rows = 4 or more$"),
        ({"mirror": True}, (6, 4, "DICT_4X4_50"), "in the mirror image, so the picture is mirr"),
        ({"negative": True}, (6, 4, "DICT_4X4_50"), "printed white on black$"),
        ({"blur_px": 30.0}, (6, 4, "DICT_4X4_50"), "no markers of any dictionary"),
    ],
)
def test_what_keeps_a_charuco_board_from_being_found(
    change: dict[str, float], stated: tuple[int, int, str], said: str
) -> None:
    picture = charuco()
    if change.get("mirror"):
        picture = picture[:, ::-1].copy()
    if change.get("negative"):
        picture = 255 - picture
    if blur_px := change.get("blur_px"):
        picture = cv2.GaussianBlur(picture, (0, 0), blur_px)
    columns, rows, dictionary = stated
    with pytest.raises(BoardNotFound, match=said):
        read_charuco(picture, columns, rows, 20.0, 14.0, dictionary)


@pytest.mark.parametrize(("along", "off_px"), [("row", -2.0), ("row", 0.0), ("column", 1.5)])
def test_corners_beside_a_lasers_line_are_right_or_left_out(along: str, off_px: float) -> None:
    grey, truth = chessboard(1.0)
    corners = truth.reshape(5, 7, 2)
    ends = corners[2, [0, -1]] if along == "row" else corners[[0, -1], 3]
    direction = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    v, u = np.mgrid[:480, :640]
    across = (u - ends[0, 0]) * direction[1] - (v - ends[0, 1]) * direction[0] - off_px
    lit = np.clip(grey + 150.0 * np.exp(-(across**2) / (2 * 1.3**2)), 0, 255)
    marks = read_chessboard(lit, 7, 5, 10.0)
    # The line's own row or column may go, the rest stays.
    others = np.ones((5, 7), dtype=bool)
    others[(2, slice(None)) if along == "row" else (slice(None), 3)] = False
    assert marks.found[others.ravel()].all()
    # Two tests of six standard deviations let no corner pass that is farther off than this.
    miss = np.abs(marks.image_px - truth)[marks.found].max(axis=1)
    assert (miss < 6 * np.sqrt(70) / 6 * marks.sigma_px[marks.found] + 3 * DRAWN_PX).all()
