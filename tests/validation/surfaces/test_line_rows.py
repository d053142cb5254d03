"""The field table's line: what counts as found and as wrong."""

import numpy as np
import pytest

from lscan.records import Status, Stripe
from tests.validation.surfaces.line import SIGMAS, SLACK_PX, counted

WIDTH = 100
TRUTH = np.full(WIDTH, 50.0)


def stripe(centre, sigma_px=0.1, status=None):
    centre = np.asarray(centre, dtype=float)
    valued = np.where(np.isfinite(centre), int(Status.OK), int(Status.NO_PEAK))
    sigma = np.full(WIDTH, sigma_px)
    return Stripe("columns", centre, sigma, np.full(WIDTH, 90.0), valued)


def test_the_true_line_is_found_and_not_wrong() -> None:
    count = counted([stripe(TRUTH)], TRUTH)
    assert (count.found, count.wrong) == (100.0, 0.0)


@pytest.mark.parametrize(("off_px", "wrong"), [(0.85, 0.0), (0.95, 10.0)])
def test_wrong_is_beyond_four_sigmas_and_half_a_pixel(off_px, wrong) -> None:
    assert pytest.approx(0.9) == SIGMAS * 0.1 + SLACK_PX
    centre = TRUTH + np.where(np.arange(WIDTH) // 10 == 5, off_px, 0.0)
    assert counted([stripe(centre)], TRUTH).wrong == pytest.approx(wrong)


def test_a_column_that_says_so_is_missed_and_not_wrong() -> None:
    centre = np.where(np.arange(WIDTH) // 10 == 5, np.nan, TRUTH)
    count = counted([stripe(centre)], TRUTH)
    assert count.wrong == 0.0
    assert count.found == pytest.approx(100 * (1 - 10 / 94))  # the ends are not counted


def test_blur_beyond_the_end_of_the_line_is_right_and_a_value_far_from_it_wrong() -> None:
    truth = np.where(np.arange(WIDTH) < 60, TRUTH, np.nan)
    carried = np.where(np.arange(WIDTH) < 63, TRUTH, np.nan)
    assert counted([stripe(carried)], truth).wrong == 0.0
    invented = np.where(np.arange(WIDTH) < 70, TRUTH, np.nan)
    assert counted([stripe(invented)], truth).wrong == pytest.approx(7.0)
