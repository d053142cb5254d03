"""Smoothing along the line: what it must leave alone, what it gains, and its sigma."""

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st

from lscan.records import Status, Stripe
from lscan.stripe.corrections import smooth
from lscan.stripe.peaks import pieces

N = 200
COLUMN = np.arange(N, dtype=float)
FEW = examples(15)


def stripe_of(centre, sigma=0.1, status=None):
    status = np.zeros(N, dtype=np.int64) if status is None else status
    centre = np.where(status == Status.OK, centre, np.nan)
    spread = np.where(status == Status.OK, sigma, np.nan)
    return Stripe("columns", centre, spread, np.full(N, 100.0), status)


@FEW
@given(
    bend=st.floats(-2e-3, 2e-3), slope=st.floats(-2, 2), level=st.floats(-50, 50),
    smooth_px=st.floats(1, 30),
)  # fmt: skip
def test_a_parabola_is_left_as_it_is(bend, slope, level, smooth_px):
    centre = level + slope * COLUMN + bend * (COLUMN - 100) ** 2
    smoothed = smooth(stripe_of(centre), smooth_px)
    np.testing.assert_allclose(smoothed.centre_px, centre, atol=1e-6)  # rounding of the solver


def test_off_is_off():
    stripe = stripe_of(COLUMN)
    assert smooth(stripe, 0.0) is stripe


@FEW
@given(seed=st.integers(0, 2**31), smooth_px=st.floats(3, 12))
def test_sigma_is_the_scatter_of_what_is_left(seed, smooth_px):
    rng = np.random.default_rng(seed)
    sigma = rng.uniform(0.05, 0.2, N)
    smoothed = smooth(stripe_of(40 + 0.1 * COLUMN + rng.normal(0, sigma), sigma), smooth_px)
    pull = (smoothed.centre_px - 40 - 0.1 * COLUMN) / smoothed.sigma_px
    # Neighbours share their errors over some 3.5 smooth_px: so many independent values, and
    # 99.9 % of chi-square/N.  10 % more for the biweight, that picks its neighbours by chance.
    chance = 3.3 * np.sqrt(2 * 3.5 * smooth_px / N)
    assert np.mean(pull**2) <= 1.1 * (1 + chance)
    assert (smoothed.sigma_px[20:-20] < sigma.mean()).all()


@pytest.mark.parametrize("shared", [1, 4, 10])
def test_sigma_is_the_scatter_where_columns_share_their_errors(shared):
    """By moving means of white noise, whose autocorrelation falls linearly to 0."""
    rng, pulls = np.random.default_rng(7), []
    for _ in range(80):
        noise = rng.normal(0, 0.1, N + shared - 1)
        error = np.convolve(noise, np.ones(shared) / np.sqrt(shared), "valid")
        smoothed = smooth(stripe_of(40 + error, 0.1), 5.0, shared)
        pulls.append((smoothed.centre_px - 40) / smoothed.sigma_px)
    # 80 lines of some 11 independent values each: a mean square known to 5 %, twice that allowed.
    # Below, twice as much: chance makes the scatter of some 18 neighbours larger, never smaller.
    assert 0.8 < np.mean(np.square(pulls)) < 1.1


def test_columns_that_scatter_more_than_they_state_are_believed_no_more():
    """A third of the scatter stated: the smoothed sigma is that of columns that state all of it."""
    rng = np.random.default_rng(5)
    centre = 40 + rng.normal(0, 0.3, N)
    modest, honest = (smooth(stripe_of(centre, sigma), 6.0).sigma_px for sigma in (0.1, 0.3))
    # Of some 20 neighbours each: their median absolute deviation is known to 18 %, all in common 4.
    assert np.median(modest / honest) == pytest.approx(1.0, abs=0.12)


def test_more_smoothing_leaves_less_scatter():
    rng = np.random.default_rng(3)
    stripe = stripe_of(40 + rng.normal(0, 0.1, N))
    scatter = [np.std(smooth(stripe, px).centre_px) for px in (0.0, 2.0, 5.0, 12.0)]
    assert (np.diff(scatter) < 0).all()


def test_an_outlier_does_not_draw_its_neighbours():
    rng = np.random.default_rng(4)
    quiet = 40 + rng.normal(0, 0.05, N)
    spoilt = quiet.copy()
    spoilt[60] += 2.0
    clean, robust = (smooth(stripe_of(c, 0.05), 5.0).centre_px for c in (quiet, spoilt))
    # A column of weight 0 instead of 1 among the 3.5 · 5 neighbours moves the others by about
    # sigma / 17; the outlier itself is put back on the line.
    assert np.abs(robust - clean).max() <= 0.05


@pytest.mark.parametrize("jump", [-8.0, 3.5, 20.0])
def test_nothing_crosses_a_jump(jump):
    step = np.where(COLUMN < 90, 40.0, 40.0 + jump)
    np.testing.assert_allclose(smooth(stripe_of(step), 8.0).centre_px, step, atol=1e-9)


def test_nothing_crosses_a_gap_and_columns_without_value_stay_so():
    status = np.zeros(N, dtype=np.int64)
    status[90:95] = Status.NO_PEAK
    level = np.where(COLUMN < 92, 40.0, 42.0)
    smoothed = smooth(stripe_of(level, status=status), 8.0)
    good = status == Status.OK
    np.testing.assert_allclose(smoothed.centre_px[good], level[good], atol=1e-9)
    assert np.isnan(smoothed.centre_px[~good]).all()
    assert np.isnan(smoothed.sigma_px[~good]).all()
    np.testing.assert_array_equal(smoothed.status, status)


def test_a_short_piece_stays_as_it_is():
    status = np.full(N, int(Status.NO_PEAK))
    status[50:55] = Status.OK
    stripe = stripe_of(40 + np.sin(COLUMN), status=status)
    smoothed = smooth(stripe, 5.0)
    np.testing.assert_array_equal(smoothed.centre_px, stripe.centre_px)
    np.testing.assert_array_equal(smoothed.sigma_px, stripe.sigma_px)


def test_an_empty_stripe_stays_empty():
    nothing = stripe_of(COLUMN, status=np.full(N, int(Status.NO_PEAK)))
    assert smooth(nothing, 5.0) is nothing


@FEW
@given(shift=st.floats(-100, 100), seed=st.integers(0, 2**31))
def test_a_shifted_or_mirrored_stripe_is_smoothed_alike(shift, seed):
    centre = 40 + np.random.default_rng(seed).normal(0, 0.3, N)
    here = smooth(stripe_of(centre), 4.0).centre_px
    np.testing.assert_allclose(smooth(stripe_of(centre + shift), 4.0).centre_px, here + shift,
                               atol=1e-6)  # fmt: skip
    np.testing.assert_allclose(
        smooth(stripe_of(centre[::-1]), 4.0).centre_px[::-1], here, atol=1e-6
    )


def test_pieces_are_numbered_between_gaps_and_jumps():
    centre = np.array([1.0, 2.0, np.nan, 3.0, 3.5, 9.0, 9.0, np.nan])
    status = np.where(np.isnan(centre), int(Status.NO_PEAK), int(Status.OK))
    status[4] = Status.SATURATED
    stripe = Stripe("columns", centre, centre, centre, status)
    assert pieces(stripe).tolist() == [0, 0, -1, 1, 1, 2, 2, -1]
