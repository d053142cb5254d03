"""The scatter that a line shows from column to column, against what was made to scatter."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from stripe_pictures import centres_of, light_of, noisy

from lscan.config.rig import NoiseSection, StripeSection
from lscan.records import Status, Stripe
from lscan.stripe import extract_stripe
from lscan.stripe.noise.along import excess, shared_columns
from lscan.stripe.pieces import pieces
from sim.validation.field.sigma import camera_picture

COLUMNS = 640


def stripe_of(centre, sigma=0.1):
    """A stripe of these centres, px, all found, each of the same standard uncertainty."""
    count = len(centre)
    status = np.where(np.isfinite(centre), int(Status.OK), int(Status.NO_PEAK))
    return Stripe("columns", centre, np.full(count, sigma), np.full(count, 100.0), status)


def excess_of(centre, lag=1):
    stripe = stripe_of(centre)
    return excess(stripe, pieces(stripe), lag)


def smooth_line():
    return 60 + np.linspace(0, 9, COLUMNS) + 4 * np.sin(np.arange(COLUMNS) / 60)


def test_scatter_as_stated_is_left_as_it_is():
    rng = np.random.default_rng(1)
    found = [excess_of(smooth_line() + rng.normal(0, 0.1, COLUMNS)) for _ in range(200)]
    # Four standard deviations: 3 in 100,000 of a normal; a mean square has a longer tail.
    assert found.count(1.0) >= 199


def test_where_columns_share_errors_the_scatter_seen_is_taken_as_it_is():
    rng = np.random.default_rng(1)
    found = [excess_of(smooth_line() + rng.normal(0, 0.1, COLUMNS), 8) for _ in range(50)]
    # Half of them above 1, by their deviation of sqrt(2.31 / 2 / 616) = 4 %: 1.7 % on average.
    assert 1.0 < np.mean(found) < 1.0 + 2 * 0.017


@pytest.mark.parametrize("lag", [1, 8])
def test_excess_is_the_scatter_over_the_stated_one(lag):
    rng = np.random.default_rng(2)
    found = [excess_of(smooth_line() + rng.normal(0, 0.3, COLUMNS), lag) for _ in range(50)]
    # The relative deviation of a scatter by N third differences is sqrt(2.31 / 2 / N) or less,
    # of the mean of 50 a seventh: 0.6 %; three of them and the cut's own 0.3 %.
    assert np.mean(found) == pytest.approx(3.0, rel=0.025)


def test_errors_that_neighbours_share_are_seen_at_a_lag_beyond_them():
    rng = np.random.default_rng(3)
    shared = gaussian_filter1d(rng.normal(0, 1, (40, COLUMNS)), 2.0, axis=1, mode="wrap")
    shared *= 0.3 / shared.std()
    near, far = (
        np.mean([excess_of(smooth_line() + error, lag) for error in shared]) for lag in (1, 8)
    )
    # At 1 column the differences see exp(-h²/16) of the variance as common: 0.02 of it is left.
    assert near == 1.0
    # exp(-64 / 16) is common at 8 columns, 2 % of the variance, with the weight 30 / 20.
    assert far == pytest.approx(3.0, rel=0.05)


def test_relief_is_not_taken_for_scatter():
    rng = np.random.default_rng(4)
    # Ripples of 40 columns, 4 px high: their third differences are 2 (2 pi / 40)³ = 0.008 px.
    ripples = 2 * np.sin(2 * np.pi * np.arange(COLUMNS) / 40)
    assert excess_of(smooth_line() + ripples + rng.normal(0, 0.1, COLUMNS)) == 1.0


def test_nothing_is_taken_across_jumps_and_gaps():
    rng = np.random.default_rng(5)
    steps = 10.0 * (np.arange(COLUMNS) // 20 % 2)
    centre = smooth_line() + steps + rng.normal(0, 0.1, COLUMNS)
    centre[::53] = np.nan
    assert excess_of(centre) == 1.0
    assert excess_of(centre, lag=8) == 1.0  # pieces of 20 columns hold no three lags of 8


def test_few_columns_tell_nothing():
    rng = np.random.default_rng(6)
    assert excess_of(60 + rng.normal(0, 1, 30)) == 1.0
    assert excess_of(np.full(5, np.nan)) == 1.0


def test_pixels_of_their_own_share_nothing_and_those_of_a_camera_do():
    rng = np.random.default_rng(7)
    for width in (0.8, 1.5, 3.0):
        centre = centres_of(rng)
        image = noisy(rng, light_of(centre, width, 150.0), 20.0, 2.0, 0.2, 0.1)
        assert shared_columns(stripe_of(centre), image.T - 20) == 1
    image, centre = camera_picture(rng)
    assert shared_columns(stripe_of(centre), image[..., 0].T - 14.0) > 1


@pytest.mark.parametrize("name", ["centroid-relative", "ml", "smoothed-peak", "steger"])
def test_sigma_covers_the_errors_in_a_cameras_picture(name):
    pulls = []
    for seed in range(4):
        image, true = camera_picture(np.random.default_rng(seed))
        stripe = extract_stripe(image, StripeSection(extractor=name, threshold_dn=30.0))
        pulls.append((stripe.centre_px - true) / stripe.sigma_px)
    # The bar is 0.7 to 1.5 times the scatter.
    scatter = np.sqrt(np.mean(np.square(np.concatenate(pulls))))
    assert 1 / 1.5 <= scatter <= 1 / 0.7


def test_noise_that_is_stated_stands():
    image, _ = camera_picture(np.random.default_rng(8))
    stated = NoiseSection(read_dn=0.5)
    sigma = [
        np.median(extract_stripe(image, StripeSection(extractor="ml", noise=noise)).sigma_px)
        for noise in (None, stated)
    ]
    assert sigma[0] > 1.5 * sigma[1]
