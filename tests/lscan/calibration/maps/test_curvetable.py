"""Curves looked up in one table are the curves themselves."""

import numpy as np
from drawn_examples import examples
from hypothesis import given, strategies as st

from lscan.calibration.maps.graticulelines import (
    Curve,
    CurvePoints,
    CurveTable,
    Fit,
    fit_curves,
    fit_polynomials,
)

FITS: tuple[Fit, ...] = ("1", "2", "bspline")


def curve(generator: np.random.Generator, fit: Fit | None) -> Curve:
    """Through marks like a board's; of order 4, as a ruler's conversion is, for None."""
    points = marks(generator)
    return (fit_polynomials([points], [4]) if fit is None else fit_curves([points], fit))[0]


def marks(generator: np.random.Generator) -> CurvePoints:
    """Along a line of a board."""
    x = np.sort(generator.uniform(20, 600, generator.integers(6, 12)))
    y = 200 + 0.1 * x + 3e-4 * x**2 + generator.normal(0, 0.5, len(x))
    sigma = np.full(len(x), 0.05)
    return CurvePoints(x, y, sigma, sigma)


@examples(30)
@given(seed=st.integers(0, 2**31), orders=st.lists(st.integers(1, 4), min_size=1, max_size=12))
def test_polynomials_fitted_together_are_those_of_least_squares(
    seed: int, orders: list[int]
) -> None:
    """As numpy.polyfit has them, which solves in powers of x over its length, to rounding."""
    generator = np.random.default_rng(seed)
    several = [marks(generator) for _ in orders]
    for found, points, order in zip(fit_polynomials(several, orders), several, orders, strict=True):
        x = np.linspace(points.x[0], points.x[-1], 20)
        expected = np.polynomial.Polynomial.fit(points.x, points.y, order)
        np.testing.assert_allclose(found(x), expected(x), rtol=0, atol=1e-9)
        np.testing.assert_allclose(found.slope(x), expected.deriv()(x), rtol=0, atol=1e-10)


@examples(30)
@given(
    seed=st.integers(0, 2**31),
    fits=st.lists(st.sampled_from([*FITS, None]), min_size=1, max_size=6),
)
def test_a_table_gives_what_each_curve_gives(seed: int, fits: list[Fit | None]) -> None:
    """To rounding, within the marks and as far beyond them as maps continue a line.

    In powers of x less a piece's begin, up to the fourth of 600 px, terms of 1000 px cancel.
    """
    generator = np.random.default_rng(seed)
    curves = [curve(generator, fit) for fit in fits]
    table = CurveTable(tuple(curves))
    which, x = generator.integers(0, len(curves), 200), generator.uniform(-30, 650, 200)
    values, slopes = table.look_up(which, x)
    variances = (table.modes(which, x) ** 2).sum(axis=0)
    for k, one in enumerate(curves):
        here = which == k
        rows = one.basis(x[here])
        np.testing.assert_allclose(values[here], one(x[here]), rtol=0, atol=1e-8)
        np.testing.assert_allclose(slopes[here], one.slope(x[here]), rtol=0, atol=1e-9)
        expected = ((rows @ one.covariance) * rows).sum(axis=1)
        np.testing.assert_allclose(variances[here], expected, rtol=1e-6)


def test_one_place_is_looked_up_on_all_curves() -> None:
    generator = np.random.default_rng(2)
    curves = [curve(generator, "bspline") for _ in range(4)]
    x = np.linspace(0, 640, 50)
    values, _ = CurveTable(tuple(curves)).look_up(np.arange(4)[:, None], x)
    np.testing.assert_allclose(values, [one(x) for one in curves], rtol=0, atol=1e-8)
