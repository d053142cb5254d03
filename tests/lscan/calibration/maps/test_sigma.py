"""The stated uncertainties of plane maps against resampled control points."""

import numpy as np
import pytest
from planeviews import BARREL, View, board_points, paper_board, read_board, with_noise

from lscan.calibration.maps.projective import solver as projective
from lscan.calibration.planemap import PlaneMap, SolvedMap, find_solver
from lscan.records import Floats

BOARD = paper_board()
NOISE_PX = 0.05
TRIALS = 60


def noise_only(plane_map: PlaneMap) -> PlaneMap:
    """The map without its lack of fit, which is no noise."""
    assert isinstance(plane_map, SolvedMap)
    return plane_map.model_copy(update={"lack_of_fit_mm": np.zeros(2)})


@pytest.mark.parametrize(
    "name",
    [
        "graticule-2",
        "graticule-1-norulers",
        pytest.param("graticule-bspline-norulers", marks=pytest.mark.slow),
        "projective",
        "polynomial-5",
    ],
)
def test_noise_of_the_marks(name: str) -> None:
    """Scatter of 30 points over resampled marks, over what the map states.

    A standard deviation from n trials has itself a relative one of 1/sqrt(2(n - 1)), so the
    root mean square ratio of one point must lie within 5 of those.  The mean over all
    points and both coordinates is held to 2 of those: it is at least as sure as one point.
    """
    view, solver = View(), find_solver(name)
    image = view.project(board_points(30, seed=1))
    exact = read_board(BOARD, view.project, sigma_px=NOISE_PX)
    sigma = noise_only(solver.solve(exact)).to_plane(image).sigma_mm
    rng = np.random.default_rng(2)
    trials = np.stack(
        [
            solver.solve(with_noise(exact, NOISE_PX, rng)).to_plane(image).xz_mm
            for _ in range(TRIALS)
        ]
    )
    ratio = trials.std(axis=0, ddof=1) / sigma
    unsure = 1 / np.sqrt(2 * (TRIALS - 1))
    assert np.sqrt(np.mean(ratio**2)) == pytest.approx(1.0, abs=2 * unsure)
    assert np.abs(ratio - 1).max() < 5 * unsure


@pytest.mark.parametrize("name", ["graticule-2", "projective", "polynomial-3"])
def test_noise_of_the_pixel(name: str) -> None:
    """Exact marks, scattered pixels: the Jacobian alone.  Points near the middle of cells and
    far from where the closest ruler changes, so that the map is smooth around them."""
    view, sigma_px, trials = View(), 0.1, 4000
    solved = noise_only(find_solver(name).solve(read_board(BOARD, view.project)))
    rng = np.random.default_rng(3)
    for point in ((80.0, -75.0), (230.0, -225.0), (370.0, -330.0)):
        centre = view.project(np.array([point]))
        scattered = centre + rng.normal(0.0, sigma_px, (trials, 2))
        scatter = solved.to_plane(scattered).xz_mm.std(axis=0, ddof=1)
        stated = solved.to_plane(centre, np.array([sigma_px])).sigma_mm[0]
        np.testing.assert_allclose(scatter, stated, rtol=5 / np.sqrt(2 * (trials - 1)))


@pytest.mark.parametrize("name", ["graticule-2-norulers", "graticule-1", "projective"])
def test_lack_of_fit_covers_the_bias(name: str) -> None:
    """With exact marks all error is lack of fit.  It is estimated where the marks are, half
    of them on control points and half between, and so must agree with the error over the
    board within a factor of two either way."""
    points = board_points(2000, seed=4)
    solved = find_solver(name).solve(read_board(BOARD, BARREL.project))
    answer = solved.to_plane(BARREL.project(points))
    error: Floats = np.sqrt(np.nanmean((answer.xz_mm - points) ** 2, axis=0))
    stated = np.sqrt(np.nanmean(answer.sigma_mm**2, axis=0))
    assert (stated > error / 2).all()
    assert (stated < error * 2).all()


def test_no_lack_of_fit_where_the_form_is_right() -> None:
    """Perspective and a homography: the estimate is noise about 0, cut off below 0.

    The mean square of n residuals of one sigma has a standard deviation of
    sqrt(2/n) sigma^2, and n is at least the 100 control points; 4 of those as a bound, with
    the greatest noise of a mark for sigma.
    """
    view = View(k1=0.0, k2=0.0, water=False)
    exact = read_board(BOARD, view.project, sigma_px=NOISE_PX)
    grid = exact.grid
    rng = np.random.default_rng(5)
    for _ in range(5):
        solved = projective.solve(with_noise(exact, NOISE_PX, rng), "")
        sigma = noise_only(solved).to_plane(grid.image_px, grid.sigma_px).sigma_mm
        bound = np.nanmax(sigma, axis=0) * np.sqrt(4 * np.sqrt(2 / 100))
        assert (solved.lack_of_fit_mm < bound).all()
