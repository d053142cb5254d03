"""Places at the rim: of the picture, of the board, and of what a window sees."""

import numpy as np
import pytest
from boards import Light, View, render
from places import PAPER_BOARD

from lscan.board import read_board
from lscan.board.lattice import drop_islands, drop_outliers, grid_points_mm, local_map
from lscan.board.picture import fit_centres
from lscan.board.search import Nodes
from lscan.config.board import load_board
from lscan.records import Floats

PAPER = load_board(PAPER_BOARD)
PLAIN = PAPER.model_copy(update={"ruler": (), "dot": (), "ring": (), "distances": ()})
SHAPE, PITCH_MM, PITCH_PX = (12, 14), 10.0, 15.0


def lattice(noise_px: float, seed: int) -> Floats:
    """(R, C, 2) px of a square lattice, each node displaced at random."""
    ideal = grid_points_mm(SHAPE, PITCH_MM) * [1.0, -1.0] * PITCH_PX / PITCH_MM + 40.0
    return ideal + noise_px * np.random.default_rng(seed).standard_normal(ideal.shape)


def nodes_at(points: Floats) -> Nodes:
    return Nodes(np.dstack([points, np.ones(SHAPE), np.full(SHAPE, 0.01)]))


def test_misfit_is_even_from_the_rim_to_the_middle() -> None:
    """Divided by its standard deviation, the miss at a corner is like that in the middle."""
    squares = []
    for seed in range(200):
        points = lattice(0.01, seed)
        squares.append(local_map(points, PITCH_MM).misfit().reshape(SHAPE) ** 2)
    variance = np.mean(squares, axis=0) / 2  # of u and of v: both were drawn with 0.01 px
    # 400 squares of a normal variable: a variance good to 7 %, four of which.
    np.testing.assert_allclose(variance / 0.01**2, 1.0, atol=0.28)


@pytest.mark.parametrize("outlier", [(0, 0), (0, 6), (5, 5), (11, 13)])
def test_an_outlier_is_dropped_and_nothing_beside_it(outlier: tuple[int, int]) -> None:
    points = lattice(0.005, 1)
    points[outlier] += [0.8, -0.5]
    nodes = nodes_at(points)
    drop_outliers(nodes, PITCH_MM)
    expected = np.ones(SHAPE, bool)
    expected[outlier] = False
    np.testing.assert_array_equal(nodes.found, expected)


def test_outliers_are_sought_again_without_those_dropped() -> None:
    """Two neighbouring outliers: one's residual is hidden until the other is left out."""
    points = lattice(0.005, 2)
    points[6, 6] += [3.0, 0.0]
    points[6, 7] += [0.4, 0.0]
    nodes = nodes_at(points)
    drop_outliers(nodes, PITCH_MM)
    assert np.argwhere(~nodes.found).tolist() == [[6, 6], [6, 7]]


@pytest.mark.parametrize("place", [(-40.0, 10.0), (10.0, 95.0), (0.0, 0.0), (59.0, 49.0)])
def test_beyond_the_picture_there_is_nothing(place: tuple[float, float]) -> None:
    """A start outside finds no mark, wherever it lies; one on the edge is no error either."""
    flat = np.zeros((50, 60))
    centres = fit_centres(flat, np.array([place]), np.array([2.0]), np.ones_like(flat))
    assert not centres.round.any()


def test_a_mark_at_the_edge_is_the_mark_completed_with_zeros() -> None:
    """The same numbers as in a larger picture that is zero all around."""
    v, u = np.mgrid[0:50, 0:60].astype(float)
    flat = np.exp(-((u - 1.3) ** 2 + (v - 20.6) ** 2) / 8)
    wide = np.pad(flat, 30)
    start, sigma = np.array([[1.0, 21.0]]), np.array([2.0])
    near = fit_centres(flat, start, sigma, np.ones_like(flat))
    inner = fit_centres(wide, start + 30, sigma, np.pad(np.ones_like(flat), 30))
    np.testing.assert_allclose(near.points + 30, inner.points, atol=1e-12)
    np.testing.assert_allclose(near.sigma_px, inner.sigma_px, rtol=1e-12)


def test_no_dot_is_read_that_the_edge_cuts() -> None:
    """The board shifted past the picture's edge: what is found lies where the truth says."""
    view = View(distance_mm=900.0, target_mm=(225.0, -262.0))
    reading = read_board(render(PLAIN, view, Light(noise=0.004), 3), PLAIN)
    found = reading.grid.found
    miss = reading.grid.image_px[found] - view.image_px(reading.grid.board_mm[found])
    # Six sigmas of noise, and the drawn edges good to 1/8 px in 16 pixels of the rim and more.
    limit = 6 * reading.grid.sigma_px[found, None] + 0.125 / np.sqrt(12 * 16)
    assert (np.abs(miss) <= limit).all()


def test_what_no_dot_connects_is_dropped() -> None:
    """A row that was reached through dots since dropped fits itself, and is none of the board."""
    points = lattice(0.005, 3)
    points[9:11] = np.nan
    points[10, 4] = lattice(0.005, 3)[10, 4]  # a bridge that is gone on one side
    nodes = nodes_at(points)
    nodes.values[9:11][np.isnan(points[9:11, :, 0])] = np.nan
    drop_islands(nodes)
    expected = np.zeros(SHAPE, bool)
    expected[:9] = True
    np.testing.assert_array_equal(nodes.found, expected)
