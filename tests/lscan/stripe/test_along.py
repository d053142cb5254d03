"""The scatter that a line shows from column to column, against what was made to scatter."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, gaussian_filter1d
from stripe_pictures import centres_of, light_of, noisy, nothing_clipped

from lscan.config.rig import NoiseSection, StripeSection
from lscan.records import Status, Stripe
from lscan.stripe import extract_stripe, find_extractor
from lscan.stripe.peaks import crests, pieces
from lscan.stripe.scatter import LightMoments, excess, light_moments
from tests.validation.surfaces.relief import camera_picture

COLUMNS = 640


def stripe_of(centre, sigma=0.1):
    """A stripe of these centres, px, all found, each of the same standard uncertainty."""
    count = len(centre)
    status = np.where(np.isfinite(centre), int(Status.OK), int(Status.NO_PEAK))
    return Stripe("columns", centre, np.full(count, sigma), np.full(count, 100.0), status)


def excess_of(centre, lag=1):
    stripe = stripe_of(centre)
    return excess(stripe, pieces(stripe), lag)


def shared_of(centre, light):
    stripe = stripe_of(centre)
    return light_moments((stripe, light, crests(light))).shared_columns(stripe)


def smooth_line():
    return 60 + np.linspace(0, 9, COLUMNS) + 4 * np.sin(np.arange(COLUMNS) / 60)


def test_scatter_as_stated_is_left_as_it_is():
    rng = np.random.default_rng(1)
    found = [excess_of(smooth_line() + rng.normal(0, 0.1, COLUMNS)) for _ in range(200)]
    # Four standard deviations: 3 in 100,000 of a normal; a mean square has a longer tail.
    assert found.count(1.0) >= 199


def test_excess_is_the_scatter_over_the_stated_one():
    rng = np.random.default_rng(2)
    found = [excess_of(smooth_line() + rng.normal(0, 0.3, COLUMNS)) for _ in range(50)]
    # The relative deviation of a scatter by 637 third differences is sqrt(2.31 / 2 / 637) = 4.3 %,
    # of the mean of 50 a seventh of it: four of these.
    assert np.mean(found) == pytest.approx(3.0, rel=0.025)


def test_where_columns_share_errors_the_largest_scatter_is_taken():
    rng = np.random.default_rng(1)
    found = [excess_of(smooth_line() + rng.normal(0, 0.1, COLUMNS), 8) for _ in range(50)]
    # The largest of six, each with a deviation of 4.3 %, lies 1.27 of these above the middle.
    assert 1.0 < np.mean(found) < 1.0 + 1.27 * 0.043 + 0.01


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


@pytest.mark.parametrize(("columns", "height_px"), [(20, 2.0), (40, 3.0), (12, 0.5)])
@pytest.mark.parametrize("name", ["centroid-relative", "ml"])
def test_relief_is_not_taken_for_scatter(name, columns, height_px):
    # Ripples up to 32 degrees steep: their blur is as wide across the line everywhere, wider and
    # dimmer along the column.
    rng = np.random.default_rng(4)
    turn = 2 * np.pi / columns
    phase = turn * np.arange(COLUMNS)
    centre = 60 + np.linspace(0, 3, COLUMNS) + height_px * np.sin(phase)
    steep = np.hypot(1, height_px * turn * np.cos(phase))
    image = noisy(rng, light_of(centre, 1.5 * steep, 150.0) / steep, 20.0, 1.5, 0.1)
    settings = StripeSection(extractor=name, threshold_dn=30.0)
    alone = find_extractor(name)(image, settings, nothing_clipped(image))
    found = extract_stripe(image.astype(np.uint8), settings)
    np.testing.assert_array_equal(found.sigma_px, alone.sigma_px)


def test_nothing_is_taken_across_jumps_and_gaps():
    rng = np.random.default_rng(5)
    steps = 10.0 * (np.arange(COLUMNS) // 20 % 2)
    centre = smooth_line() + steps + rng.normal(0, 0.1, COLUMNS)
    centre[::53] = np.nan
    assert excess_of(centre) == 1.0
    # Pieces of 20 columns hold no three lags of 8: what is left are the shorter ones.
    assert excess_of(centre, lag=8) < 1.1


def test_few_columns_tell_nothing():
    rng = np.random.default_rng(6)
    assert excess_of(60 + rng.normal(0, 1, 30)) == 1.0
    assert excess_of(np.full(5, np.nan)) == 1.0


def test_pixels_of_their_own_share_nothing_and_those_of_a_camera_do():
    rng = np.random.default_rng(7)
    for width in (0.8, 1.5, 3.0):
        centre = centres_of(rng)
        image = noisy(rng, light_of(centre, width, 150.0), 20.0, 2.0, 0.2, 0.1)
        assert shared_of(centre, image.T - 20) == 1
    image, centre = camera_picture(rng)
    assert shared_of(centre, image[..., 0].T - 14.0) > 1


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


def test_noise_that_is_stated_does_not_hide_errors_that_neighbours_share():
    # Neighbours share their errors, over t = 1.5 px, but no coder's blocks are seen (picture.py).
    # Of a line of w = 3 px the centre's variance is then 2 sqrt(pi) t (w² / (w² + t²))^1.5 times
    # that by independent pixels: sigma 1.95 times.
    rng = np.random.default_rng(8)
    light = light_of(smooth_line(), 3.0, 120.0, rows=130)
    shared = 20 * gaussian_filter(rng.normal(0, 1, light.shape), 1.5)
    image = np.rint(light + shared + 20).clip(0, 255).astype(np.uint8)
    stated = NoiseSection(read_dn=0.5)
    sigma = [
        np.median(extract_stripe(image, StripeSection(extractor="ml", noise=noise)).sigma_px)
        for noise in (None, stated)
    ]
    assert sigma[1] == pytest.approx(sigma[0], rel=0.15)


@pytest.mark.parametrize("name", ["centroid-relative", "gaussian", "ml", "steger"])
def test_noise_stated_too_small_does_not_make_the_line_surer(name: str) -> None:
    """Speckle of 0.4 where another rig's 0.05 and a tenth of its other noise are stated."""
    ratios = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        centre = 60.0 + 0.02 * np.arange(640) + rng.uniform(-1, 1)
        rows = np.arange(120)[:, None]
        light = (
            120 * np.exp(-((rows - centre) ** 2) / (2 * 1.5**2)) * rng.gamma(6.25, 0.16, (120, 640))
        )
        image = np.clip(np.rint(light + rng.normal(8, 2, light.shape)), 0, 255).astype(np.uint8)
        wrong = NoiseSection(read_dn=0.3, dn_per_electron=0.001, speckle=0.05)
        found = extract_stripe(image, StripeSection(extractor=name, threshold_dn=30.0, noise=wrong))
        error = (found.centre_px - centre)[found.status == 0]
        ratios.append(np.median(found.sigma_px[found.status == 0]) / error.std())
    assert 0.8 < np.mean(ratios) < 1.4


def test_a_line_whose_width_is_known_in_every_other_column_says_nothing_of_shared_errors():
    """As of wide, speckled lines, whose width is not found in many of them."""
    rng = np.random.default_rng(8)
    squared = rng.normal(0.3, 0.01, COLUMNS)
    squared[1::2] = np.nan
    light = LightMoments(2.0, np.full(COLUMNS, 40.0), squared, np.full(COLUMNS, 100.0))
    assert light.shared_columns(stripe_of(np.full(COLUMNS, 40.0))) == 1
