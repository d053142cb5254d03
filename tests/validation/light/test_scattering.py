"""The comparison with volpath: the bound that it rests on."""

import pytest
from scipy.stats import norm

from tests.validation.light.scattering import sidak_bound


def test_the_bound_is_sidaks() -> None:
    """With many degrees of freedom it is the normal quantile of 1 - (1 - level)^(1/tests)."""
    assert sidak_bound(1, 1e9) == pytest.approx(norm.isf(0.5e-3), rel=1e-6)
    each = 1 - (1 - 1e-3) ** (1 / 12)
    assert sidak_bound(12, 1e9) == pytest.approx(norm.isf(each / 2), rel=1e-6)
    assert sidak_bound(12, 15) > sidak_bound(12, 1e9) > sidak_bound(1, 1e9)
