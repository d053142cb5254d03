"""Hard pictures of the board: turned, unevenly lit, glaring, dirty; and the other contrast."""

import cv2
import numpy as np
import pytest
from boards import Light, View, render
from places import PAPER_BOARD

from lscan.board import read_board
from lscan.config.board import load_board
from lscan.errors import BoardNotFound
from lscan.records import BoardReading, Bytes, Floats, Status

PAPER = load_board(PAPER_BOARD)
VIEW = View(distance_mm=950.0)
FAIR = Light(noise=0.01)


@pytest.fixture(scope="module")
def picture() -> Bytes:
    return render(PAPER, VIEW, FAIR, seed=1)


def worst_px(reading: BoardReading, view: View) -> float:
    return float(np.nanmax(np.abs(reading.grid.image_px - view.image_px(reading.grid.board_mm))))


@pytest.mark.parametrize("roll_deg", [45.0, pytest.param(180.0, marks=pytest.mark.slow), 270.0])
def test_the_other_marks_determine_which_way_up_the_board_is(roll_deg: float) -> None:
    view = View(distance_mm=1200.0, roll_rad=np.deg2rad(roll_deg))
    reading = read_board(render(PAPER, view, FAIR, seed=1), PAPER)
    assert reading.grid.found.all()
    assert worst_px(reading, view) <= 0.1  # six sigmas of 0.013 px and the drawing's 0.015
    assert all(mark.status == Status.OK for mark in reading.dots.values())


def test_light_three_to_one() -> None:
    light = Light(noise=0.01, ratio=3.0, toward_rad=0.7)
    reading = read_board(render(PAPER, VIEW, light, seed=1), PAPER)
    assert reading.grid.found.all()
    miss = reading.grid.image_px - VIEW.image_px(reading.grid.board_mm)
    # Three times less light is three times the sigma of 0.012 px; the mean stays.
    assert np.sqrt(np.mean(miss**2)) <= 0.036
    assert np.abs(miss.mean(axis=0)).max() <= 0.01


def test_glare_hides_some_dots_and_moves_none(picture: Bytes) -> None:
    u, v = np.meshgrid(np.arange(640), np.arange(480))
    glare = 380 * np.exp(-((u - 300) ** 2 + (v - 200) ** 2) / (2 * 45**2))
    reading = read_board(np.clip(picture + glare, 0, 255).astype(np.uint8), PAPER)
    assert 80 <= reading.grid.found.sum() < 100
    assert (reading.grid.status[~reading.grid.found] == Status.NOT_FOUND).all()
    assert worst_px(reading, VIEW) <= 0.15


def test_a_smear_that_joins_two_dots_loses_them_and_no_others(picture: Bytes) -> None:
    smeared = picture.copy()
    places: Floats = VIEW.image_px(PAPER.grid.points_mm()).round().astype(int)
    for first, last in ((44, 45), (12, 22)):
        cv2.line(smeared, places[first].tolist(), places[last].tolist(), 40, 5)
    reading = read_board(smeared, PAPER)
    lost = np.flatnonzero(~reading.grid.found)
    assert set(lost) <= {12, 22, 44, 45}
    assert worst_px(reading, VIEW) <= 0.1


def test_dirt_is_not_taken_for_dots(picture: Bytes) -> None:
    dirty, rng = picture.copy(), np.random.default_rng(3)
    for _ in range(60):
        place = (int(rng.integers(640)), int(rng.integers(480)))
        cv2.circle(dirty, place, int(rng.integers(1, 5)), 30, -1)
    reading = read_board(dirty, PAPER)
    assert reading.grid.found.sum() >= 85
    # A speck on the rim of a dot may pass for part of it; one beside it, a pixel off, may not.
    assert worst_px(reading, VIEW) <= 1.0


def test_the_other_contrast_is_named(picture: Bytes) -> None:
    with pytest.raises(BoardNotFound, match='marks = "bright"'):
        read_board(255 - picture, PAPER)
