"""Stated over observed sigma: what is held against what, and that a model alone fails."""

from pathlib import Path

import numpy as np
import pytest

import lscan.stripe.extract
from lscan.records import Status, Stripe
from tests.validation.rows import Row
from tests.validation.surfaces.drawn import QUICK
from tests.validation.surfaces.relief import neighbour_pulls, sigma_rows


def least(rows: list[Row]) -> Row:
    (row,) = (row for row in rows if row.at_least)
    return row


@pytest.mark.slow
def test_the_model_alone_is_not_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = sigma_rows(Path(), QUICK)
    assert len(rows) == 10  # nine extractors, and the least of them
    assert all(row.passed for row in rows)
    monkeypatch.setattr(
        lscan.stripe.extract, "at_least_seen", lambda seen: [one[0] for one in seen]
    )
    assert least(sigma_rows(Path(), QUICK)).passed is False


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
