"""Tensor-product splines and penalised least squares against closed forms."""

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st

from lscan.calibration.maps.spline import FLAT, Smooth, TensorBasis, even_basis, smooth, surface_at
from lscan.records import Floats

LOW, HIGH = np.array([-1.0, -0.7]), np.array([1.0, 0.8])
BASIS = even_basis(LOW, HIGH, 5)


def _places(count: int, seed: int) -> Floats:
    return np.asarray(np.random.default_rng(seed).uniform(LOW, HIGH, (count, 2)), dtype=float)


def _coefficients(values: Floats, places: Floats, basis: TensorBasis = BASIS) -> Floats:
    return np.asarray(np.linalg.lstsq(basis.rows(places), values, rcond=None)[0], dtype=float)


@examples(20)
@given(cubic=st.lists(st.floats(-5, 5), min_size=4, max_size=4), seed=st.integers(0, 99))
def test_roughness_of_a_cubic(cubic: list[float], seed: int) -> None:
    """f = a u³ + b u²v + c uv² + d v³ and any quadratic: its third derivatives are 6a, 2b, 2c
    and 6d everywhere, so the integral is the area times 36a² + 3·4b² + 3·4c² + 36d²."""
    a, b, c, d = cubic
    places = _places(400, seed)
    u, v = places.T
    quadratic = np.random.default_rng(seed).normal(size=6) @ np.array(
        [np.ones_like(u), u, v, u * u, u * v, v * v]
    )
    found = _coefficients(a * u**3 + b * u * u * v + c * u * v * v + d * v**3 + quadratic, places)
    area = float(np.prod(HIGH - LOW))
    expected = area * (36 * a**2 + 12 * b**2 + 12 * c**2 + 36 * d**2)
    # Both are sums of numbers up to the greatest curvature squared times a few thousand terms.
    rough = BASIS.roughness()
    rounding = float(1e-12 * np.abs(found) @ np.abs(rough) @ np.abs(found))
    assert found @ rough @ found == pytest.approx(expected, abs=rounding + 1e-9)


def test_a_surface_is_that_of_all_its_functions() -> None:
    """Its values, their derivatives, and the errors by few columns of its roots and by the rest."""
    places, step = _places(50, 1) * 1.1, 1e-6  # some lie beyond the ends
    generator = np.random.default_rng(2)
    coefficients, of_x, of_z = (
        generator.normal(size=shape) for shape in ((2, BASIS.count), *2 * ((BASIS.count, 9),))
    )
    rows, few, axes = BASIS.rows(places), 4, (BASIS.knots_u, BASIS.knots_v)
    values, slopes, first, second, rest = surface_at(*axes, places, coefficients, of_x, of_z, few)
    np.testing.assert_allclose(values, rows @ coefficients.T, atol=1e-9)
    for axis, shift in enumerate(np.eye(2) * step):
        ahead, behind = (BASIS.rows(places + sign * shift) @ coefficients.T for sign in (1, -1))
        np.testing.assert_allclose(slopes[:, :, axis], (ahead - behind) / (2 * step), atol=1e-5)
    for value, (root, found) in enumerate(((of_x, first), (of_z, second))):
        every = rows @ root
        np.testing.assert_allclose(found, every[:, :few], atol=1e-9)
        np.testing.assert_allclose(rest[:, value], (every[:, few:] ** 2).sum(axis=1), rtol=1e-9)


@pytest.mark.parametrize(
    "knots", [np.zeros(8), np.arange(7.0), np.arange(9.0)[::-1]], ids=["flat", "few", "falling"]
)
def test_refuses_knots_that_make_no_spline(knots: Floats) -> None:
    with pytest.raises(ValueError, match="knots"):
        TensorBasis(np.arange(9.0), knots)


def _fit(values: Floats, places: Floats, sigma: Floats) -> Smooth:
    return smooth(BASIS.rows(places), values, sigma, BASIS.roughness(), FLAT)


@examples(15)
@given(seed=st.integers(0, 999))
def test_quadratics_come_back_exactly(seed: int) -> None:
    """They have no roughness, so no weight of the penalty changes them."""
    rng = np.random.default_rng(seed)
    places = _places(60, seed)
    u, v = places.T
    values = rng.normal(size=6) @ np.array([np.ones_like(u), u, v, u * u, u * v, v * v])
    found = _fit(values, places, rng.uniform(0.5, 2.0, 60))
    np.testing.assert_allclose(BASIS.rows(places) @ found.coefficients, values, atol=1e-8)


@examples(10)
@given(seed=st.integers(0, 999))
def test_the_fit_solves_the_normal_equations(seed: int) -> None:
    """The inverse covariance less the data's part is a multiple of the roughness, and the
    coefficients are the covariance times the data's right side: both, whatever the weight,
    say that the penalised sum of squares has its least value there.  The sigma stated is
    too large for the covariance to be inflated."""
    rng = np.random.default_rng(seed)
    places = _places(200, seed)
    values = np.sin(3 * places[:, 0]) * places[:, 1] + rng.normal(0.0, 0.02, 200)
    sigma = rng.uniform(0.04, 0.08, 200)
    found = _fit(values, places, sigma)
    rows = BASIS.rows(places) / sigma[:, None]
    covariance = found.root @ found.root.T
    np.testing.assert_allclose(found.coefficients, covariance @ rows.T @ (values / sigma),
                               atol=1e-6 * np.abs(found.coefficients).max())  # fmt: skip
    rough, rest = BASIS.roughness(), np.linalg.inv(covariance) - rows.T @ rows
    weight = float((rest * rough).sum() / (rough * rough).sum())
    assert weight > 0
    assert np.abs(rest - weight * rough).max() < 1e-4 * np.abs(rest).max()


def test_covariance_follows_the_scatter_where_that_is_larger() -> None:
    """Birge: a sigma stated too small, by whatever factor, gives the same covariance."""
    rng, places = np.random.default_rng(3), _places(200, 3)
    values = np.sin(3 * places[:, 0]) + rng.normal(0.0, 0.05, 200)
    fits = [_fit(values, places, np.full(200, sigma)) for sigma in (0.02, 0.002, 0.2)]
    for fit in fits[:2]:
        rows = BASIS.rows(places)
        np.testing.assert_allclose(rows @ fit.coefficients, rows @ fits[0].coefficients, atol=1e-8)
    one, other, cautious = (np.linalg.norm(BASIS.rows(places) @ fit.root) for fit in fits)
    assert one == pytest.approx(other, rel=1e-6)
    # Stated four times too large, it is kept: 0.2 against a scatter of 0.05, known to 5 %.
    assert cautious == pytest.approx(4 * one, rel=0.2)


def test_freedom_lies_between_flat_and_the_values() -> None:
    """A smooth surface in noise spends few; the same without noise spends many more."""
    rng, places = np.random.default_rng(4), _places(150, 4)
    truth = np.sin(4 * places[:, 0] + places[:, 1])
    sigma = np.full(150, 0.1)
    noisy = _fit(truth + rng.normal(0.0, 0.1, 150), places, sigma).freedom
    exact = _fit(truth, places, sigma).freedom
    assert FLAT <= noisy < exact < 150
