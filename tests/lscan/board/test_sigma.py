"""Centres without bias, and an uncertainty for each that is its scatter."""

import boards
import numpy as np
import pytest
from boards import Light, View, expected_dn, expose
from places import PAPER_BOARD
from scipy.ndimage import gaussian_filter

from lscan.board import read_board
from lscan.config.board import Board, Grid, load_board
from lscan.records import BoardReading, Floats

PAPER = load_board(PAPER_BOARD)
PLAIN = PAPER.model_copy(update={"ruler": (), "dot": (), "ring": (), "distances": ()})
SHARP = pytest.mark.xfail(
    strict=True, reason="in sharp, quiet pictures a dot's own edge counts as noise: sigma too large"
)
VIEW = View(distance_mm=880.0, roll_rad=0.03)
PARTS = 12  # four would draw a rim pixel in steps of 180 / 64 DN, themselves a noise of 0.8 DN


def big_dots(diameter_mm: float) -> boards.Board:
    grid = PLAIN.grid.model_copy(update={"dot_diameter_mm": diameter_mm})
    return PLAIN.model_copy(update={"grid": grid})


@pytest.mark.parametrize("diameter_mm", [10.0, pytest.param(20.0, marks=pytest.mark.slow)])
def test_big_dots_in_strong_perspective_have_no_bias(diameter_mm: float) -> None:
    # The bar is 0.005 px; rounding to 1/255 is left out, the drawn edges are good to 1/8 px
    # in each of some 30 and more pixels of the rim.
    view = View(distance_mm=950.0, tilt_rad=np.deg2rad(40.0), barrel=0.3, roll_rad=0.1)
    board = big_dots(diameter_mm)
    reading = read_board(expected_dn(board, view, Light()), board)
    inner = reading.grid.found.reshape(10, 10)
    inner[[0, -1]] = inner[:, [0, -1]] = False  # their second derivatives are extrapolated
    miss = (reading.grid.image_px - view.image_px(reading.grid.board_mm))[inner.ravel()]
    assert len(miss) == 64
    assert np.sqrt(np.mean(miss**2)) <= 0.005


def across_the_ring(view: View, reading: BoardReading, name: str) -> Floats:
    """(K,) signed distance px of the points from the true line, outwards."""
    ring = next(ring for ring in PAPER.ring if ring.name == name)
    points = reading.rings[name].image_px
    away = view.board_mm(points) - [ring.x_mm, ring.z_mm]
    length = np.linalg.norm(away, axis=1)
    outward = away / length[:, None]
    # The gradient of the distance from the middle, mm per px, is the transposed Jacobian on it.
    steepness = np.linalg.norm(np.einsum("nij,ni->nj", view.jacobian(points), outward), axis=1)
    return (length - ring.diameter_mm / 2) / steepness


@pytest.mark.parametrize("blur_px", [0.5, pytest.param(1.0, marks=pytest.mark.slow)])
def test_rings_are_not_drawn_inwards_by_blur(blur_px: float) -> None:
    reading = read_board(expected_dn(PAPER, VIEW, Light(blur_px=blur_px), PARTS), PAPER)
    for ring in PAPER.ring:
        shift = blur_px**2 / 2 / (0.5 * ring.diameter_mm)  # uncorrected, at 1 px a mm
        # A tenth of the largest shift of the smallest ring, 0.035 px.
        assert abs(across_the_ring(VIEW, reading, ring.name).mean()) <= max(0.0035, shift / 10)


@pytest.mark.parametrize(
    ("noise_dn", "shot", "blur_px"),
    [
        pytest.param(1.0, 0.0, 0.5, marks=[SHARP, pytest.mark.slow]),
        pytest.param(0.5, 0.04, 0.7, marks=[SHARP, pytest.mark.slow]),
        pytest.param(4.0, 0.0, 0.7, marks=pytest.mark.slow),
        (1.0, 0.04, 1.0),
        pytest.param(4.0, 0.0, 1.5, marks=pytest.mark.slow),
    ],
)
def test_sigma_is_the_scatter(noise_dn: float, shot: float, blur_px: float) -> None:
    """About its mean over pictures, so that the truth's drawing plays no part."""
    light = Light(blur_px=blur_px, ratio=1.3, noise=noise_dn / 255, shot=shot)
    expected = expected_dn(PAPER, VIEW, light, PARTS)
    readings = [read_board(expose(expected, light, seed), PAPER) for seed in range(5)]
    marks = {"grid": [reading.grid for reading in readings]}
    for k in range(5):
        marks[f"ruler {k}"] = [reading.rulers[k].marks for reading in readings]
    grid_score = squares(
        [m.image_px for m in marks.pop("grid")], [r.grid.sigma_px for r in readings]
    )
    ruler_score = np.concatenate(
        [squares([m.image_px for m in many], [m.sigma_px for m in many]) for many in marks.values()]
    )
    # 100 marks, two coordinates, 4 degrees of freedom: a variance good to 5 %, three of which.
    assert 0.8 <= grid_score.mean() <= 1.2
    assert 0.8 <= ruler_score.mean() <= 1.2
    ring_score = [
        across_the_ring(VIEW, reading, ring.name) / reading.rings[ring.name].sigma_px
        for reading in readings
        for ring in PAPER.ring
    ]
    assert 0.8 <= np.mean(np.concatenate(ring_score) ** 2) <= 1.25


def squares(image_px: list[Floats], sigma_px: list[Floats]) -> Floats:
    """Squared scores about the mean over the pictures, for the degrees of freedom left."""
    points, sigma = np.stack(image_px), np.stack(sigma_px)
    seen = np.isfinite(points).all(axis=(0, 2))
    away = points[:, seen] - points[:, seen].mean(axis=0)
    return (away**2 / sigma[:, seen, None] ** 2).ravel() * len(points) / (len(points) - 1)


@pytest.mark.slow  # sigma is the scatter, above
def test_more_noise_is_more_sigma() -> None:
    expected = expected_dn(PLAIN, VIEW, Light(), PARTS)
    sigma = [
        np.nanmean(read_board(expose(expected, Light(noise=n / 255), 1), PLAIN).grid.sigma_px)
        for n in (1.0, 2.0, 4.0)
    ]
    # In proportion, but for rounding's 0.29 DN (4 % at 1 DN) and an estimate good to 10 %.
    np.testing.assert_allclose(np.divide(sigma[1:], sigma[:-1]), 2.0, rtol=0.15)


def test_noise_that_neighbouring_pixels_share_counts_as_large_as_it_is() -> None:
    """Noise smoothed by 1.5 px, as denoising leaves it: sigma is its scatter, not white noise's.

    White noise of what the pixels differ by would be 30 times less in variance.  The grain about a
    dot is known from some twenty differences, to a sixth; together with the window's share of the
    noise, which is taken for that of the ground, half as much again is left open.
    """
    grid = Grid(columns=19, rows=19, pitch_mm=20.0, dot_diameter_mm=8.0)
    board = Board(grid=grid)
    view = View(distance_mm=750.0, target_mm=(180.0, -180.0))
    expected = boards.expected_dn(board, view)
    squares = []
    for seed in range(2):
        noise = gaussian_filter(np.random.default_rng(seed).standard_normal(expected.shape), 1.5)
        picture = np.clip(np.rint(expected + 2.0 * noise / noise.std()), 0, 255).astype(np.uint8)
        grid_marks = read_board(picture, board).grid
        miss = grid_marks.image_px - view.image_px(grid_marks.board_mm)
        squares.append((miss / grid_marks.sigma_px[:, None]) ** 2)
    assert 0.5 <= np.nanmean(squares) <= 1.5
