"""Curves looked up in one table are the curves themselves."""

import numpy as np
from hypothesis import given, settings, strategies as st

from lscan.calibration.maps.curvetable import CurveTable
from lscan.calibration.maps.lines import Curve, Fit, fit_curve, fit_polynomial

FITS: tuple[Fit, ...] = ("1", "2", "bspline")


def curve(generator: np.random.Generator, fit: Fit | None) -> Curve:
    """Through marks like a board's; of order 4, as a ruler's conversion is, for None."""
    x = np.sort(generator.uniform(20, 600, generator.integers(6, 12)))
    y = 200 + 0.1 * x + 3e-4 * x**2 + generator.normal(0, 0.5, len(x))
    sigma = np.full(len(x), 0.05)
    return fit_polynomial(x, y, sigma, sigma, 4) if fit is None else fit_curve(x, y, sigma, fit)


@settings(max_examples=30, deadline=None)
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
    table = CurveTable.of(curves)
    which, x = generator.integers(0, len(curves), 200), generator.uniform(-30, 650, 200)
    values, slopes = table.look_up(which, x)
    variances = table.variance(which, table.basis(which, x))
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
    values, _ = CurveTable.of(curves).look_up(np.arange(4)[:, None], x)
    np.testing.assert_allclose(values, [one(x) for one in curves], rtol=0, atol=1e-8)
