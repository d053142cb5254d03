"""The centre of a mark: the weighted second-order polynomial against closed forms."""

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st

from lscan.board.picture import disc_height, fit_centres, window_sigma

HALF = 20


def grid() -> tuple[np.ndarray, np.ndarray]:
    v, u = np.mgrid[: 2 * HALF + 1, : 2 * HALF + 1].astype(float)
    return u - HALF, v - HALF


@given(u0=st.floats(-0.5, 0.5), v0=st.floats(-0.5, 0.5), width=st.floats(1.2, 3.0))
@examples(50)
def test_the_middle_of_a_round_gaussian_is_exact(u0: float, v0: float, width: float) -> None:
    # A symmetric mark has its maximum in its middle whatever the weights; what remains is that
    # the window is cut at four sigmas, at weights of 3.4e-4: a shift below that times 3 px.
    u, v = grid()
    picture = np.exp(-((u - u0) ** 2 + (v - v0) ** 2) / (2 * width**2))
    found = fit_centres(
        picture, np.array([[HALF, HALF]]), np.array([width]), noise=np.full(picture.shape, 0.01)
    )
    assert found.round.all()
    np.testing.assert_allclose(found.points[0] - HALF, [u0, v0], atol=1e-3)


def test_a_parabola_is_fitted_exactly() -> None:
    # A second-order polynomial fitted to a second-order polynomial is that polynomial.
    u, v = grid()
    picture = 7 - 0.02 * (u - 0.3) ** 2 - 0.03 * (v + 0.2) ** 2 + 0.01 * (u - 0.3) * (v + 0.2)
    found = fit_centres(
        picture, np.array([[HALF, HALF]]), np.array([2.0]), noise=np.full(picture.shape, 0.01)
    )
    np.testing.assert_allclose(found.points[0] - HALF, [0.3, -0.2], atol=1e-9)
    np.testing.assert_allclose(found.height, 7.0, atol=1e-9)


def test_the_scatter_is_the_one_promised() -> None:
    # 2000 discs with white noise: the standard deviation of a deviation is itself known to
    # 1 / sqrt(2 * 4000) = 1.1 %; the promise is first order in noise, hence 5 %.
    rng = np.random.default_rng(1)
    u, v = grid()
    radius, noise, side = 2.75, 0.03, 2 * HALF + 1
    tiles = np.tile(np.clip(radius + 0.5 - np.hypot(u, v), 0, 1), (40, 50))
    row, column = np.mgrid[:40, :50] * side + HALF
    start = np.column_stack([column.ravel(), row.ravel()]).astype(float)
    sigma = window_sigma(np.full(len(start), radius))
    found = fit_centres(
        tiles + rng.normal(0, noise, tiles.shape), start, sigma, np.full(tiles.shape, noise)
    )
    assert found.round.all()
    promised = found.sigma_px
    assert np.std(found.points - start) == pytest.approx(np.mean(promised), rel=0.05)
    # The closed form of the module's head for a sharp disc, q = 1.
    closed = noise * np.e / (np.sqrt(2 * np.pi) * 2)
    assert np.mean(promised) == pytest.approx(closed, rel=0.05)


def test_the_height_of_a_disc() -> None:
    u, v = grid()
    radius = 5.0
    disc = np.clip(radius + 0.5 - np.hypot(u, v), 0, 1)
    sigma = window_sigma(np.array([radius]))
    weight = np.exp(-(u**2 + v**2) / (2 * sigma**2))
    smoothed = (weight * disc).sum() / weight.sum()
    # A pixelled edge of width 1 px on a radius of 5: second order, (1/5)^2 / 12 = 0.3 %.
    assert disc_height(np.array([radius]))[0] == pytest.approx(smoothed, rel=0.005)


def test_a_ridge_a_slope_and_a_flat_are_not_round() -> None:
    u, v = grid()
    start, sigma = np.array([[HALF, HALF]]), np.array([2.0])
    for picture in (np.exp(-(u**2) / 4) + 0 * v, u + 0.0, np.zeros_like(u), (u**2 + v**2) / 99):
        assert not fit_centres(
            picture, start, sigma, noise=np.full(picture.shape, 0.01)
        ).round.any()


def test_no_marks_no_centres() -> None:
    found = fit_centres(np.zeros((9, 9)), np.empty((0, 2)), np.empty(0), np.ones((9, 9)))
    assert found.points.shape == (0, 2)
