"""Normal numbers from words of 16 bits: their distribution, its far ends and their independence."""

import numpy as np
import pytest
from scipy.stats import kstest, norm

from sim.sensor.webcam import standard_normal

SHAPE = (1000, 2000)


@pytest.fixture(scope="module", params=[np.random.PCG64, np.random.SFC64])
def drawn(request: pytest.FixtureRequest) -> np.ndarray:
    return standard_normal(np.random.Generator(request.param(7)), SHAPE).astype(float)


def test_moments_are_those_of_a_normal_distribution(drawn: np.ndarray) -> None:
    """Within 4 standard errors: of the first four powers' means, sqrt(Var z^k / N)."""
    for power, mean, variance in ((1, 0, 1), (2, 1, 2), (3, 0, 15), (4, 3, 96)):
        error = np.sqrt(variance / drawn.size)
        assert abs(np.mean(drawn**power) - mean) < 4 * error, power


def test_the_distribution_is_normal(drawn: np.ndarray) -> None:
    """Kolmogorov's and Smirnov's test: it resolves a hundred times the parts' probability."""
    assert kstest(drawn.ravel(), "norm").pvalue > 1e-4


@pytest.mark.parametrize("limit", [3.0, 3.5, 4.0, 4.5])
def test_the_far_ends_hold_as_many_as_they_should(drawn: np.ndarray, limit: float) -> None:
    """Either end within 4 standard deviations of a binomial's count, and no two numbers alike."""
    expected = drawn.size * norm.sf(limit)
    for end in (drawn, -drawn):
        beyond = end[end > limit]
        assert abs(len(beyond) - expected) < 4 * np.sqrt(expected)
        if limit > 3.1:
            assert len(np.unique(beyond)) > 0.99 * len(beyond)


def test_neighbours_know_nothing_of_each_other(drawn: np.ndarray) -> None:
    """Correlations at short lags, four words of which are drawn at once, within 4 / sqrt(N)."""
    for lag in range(1, 9):
        for values in (drawn, drawn**2 - 1):
            product = values.ravel()[lag:] * values.ravel()[:-lag]
            error = np.std(values) ** 2 / np.sqrt(drawn.size)
            assert abs(product.mean()) < 4 * error, lag


def test_any_shape_is_filled_and_repeats_with_its_seed() -> None:
    for shape in ((), (1,), (3,), (5, 7), (0, 4)):
        one, other = (standard_normal(np.random.default_rng(3), shape) for _ in range(2))
        assert one.shape == shape and one.dtype == np.float32
        assert np.array_equal(one, other) and np.isfinite(one).all()
