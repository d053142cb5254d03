"""Stated over observed sigma: what is held against what, and that a model alone fails."""

import numpy as np
import pytest

from lscan.records import Status, Stripe
from tests.validation.surfaces.relief import neighbour_pulls


def test_pulls_of_errors_as_stated_have_a_deviation_of_one() -> None:
    rng = np.random.default_rng(1)
    column = np.arange(4000.0)
    centre = 100 + 5 * np.sin(column / 100)
    centre[2000:] += 50
    sigma = np.where(column < 1000, 0.1, 0.3)
    status = np.where(column % 50 == 0, int(Status.SATURATED), int(Status.OK))
    stripe = Stripe("columns", centre + sigma * rng.normal(size=4000), sigma, centre, status)
    pulls = neighbour_pulls(stripe)
    # All even columns but for two ends, either side of a jump, and the clipped ones.
    assert len(pulls) == pytest.approx(2000 - 80, abs=50)
    assert np.isfinite(pulls).all()
    # 1900 of them: a deviation good to 1.6 %, three of which.
    assert pulls.std() == pytest.approx(1.0, abs=0.05)
