"""Noise distinguished from lack of fit by what neighbouring columns have in common."""

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from stripe_pictures import HEIGHT, centres_of, light_of, noisy, nothing_clipped, settings_for

from lscan.config.rig import StripeSection
from lscan.stripe import find_extractor
from lscan.stripe.fit import Scatter, chance_of_variances
from lscan.stripe.likelihood import survey
from lscan.stripe.picture import Noise, constant_variance, robust_variance


def lopsided(rng, width, height, share, columns=640):
    """Centres and light of two Gaussians a width apart, the second with ``share`` of the light."""
    centre = centres_of(rng, columns)
    light = light_of(centre, width, (1 - share) * height)
    return centre, light + light_of(centre + width, width, share * height)


@examples(15)
@given(seed=st.integers(0, 2**32 - 1), share=st.floats(0.0, 0.3))
def test_a_lopsided_line_is_not_taken_for_noise(seed, share):
    rng = np.random.default_rng(seed)
    _, light = lopsided(rng, 2.0, 150.0, share)
    image = noisy(rng, light, 20.0, 2.0)
    found = survey(image, StripeSection(), nothing_clipped(image)).noise
    # 256 columns of some 20 pixels: a variance is known to sqrt(2 / 2500) = 3 %, four of them.
    assert found.constant == pytest.approx(2.0**2 + 1 / 12, rel=0.12)
    # At the crest, with 256 pairs at most, the noise is known to sqrt(2 / 128) = 12 % of its
    # variance, and its part that grows with light to thrice that: the shape is not in it.
    assert found.variance(np.array([100.0]))[0] <= (2.0**2 + 1 / 12) * 1.5


@pytest.mark.parametrize(("pairs", "columns_afar"), [(40, 120), (500, 10)])
def test_variances_of_pairs_and_of_pixels_afar_differ_by_chance_as_stated(pairs, columns_afar):
    # The first case is of the pairs' chance, the second of that of the pixels afar.
    rng = np.random.default_rng(6)
    ratios = []
    for _ in range(600):
        beside, afar = rng.normal(0, 2.0, (pairs + 1, 9)), rng.normal(0, 2.0, (columns_afar, 42))
        between = robust_variance(np.diff(beside, axis=0)) / 2
        ratios.append(between / constant_variance(afar))
    # A standard deviation of 600 draws is known to sqrt(1 / 1200) = 2.9 %, four of them.
    chance = chance_of_variances(9 * pairs, 40 * columns_afar)
    assert np.std(ratios) == pytest.approx(chance, rel=0.115)


@pytest.mark.parametrize(("deviations", "taken"), [(3.9, False), (4.1, True)])
def test_noise_beside_a_line_counts_from_four_standard_deviations_on(deviations, taken):
    different = np.random.default_rng(7).normal(0, 1, 400) ** 2
    more = 1 + deviations * chance_of_variances(400, 5000)
    different *= 4.0 * more / robust_variance(np.sqrt(different))
    scatter = Scatter(np.zeros(400), different, different, np.full(400, True))
    assert (scatter.noise(4.0, 5000).constant > 4.0) == taken


def test_misfit_grows_as_the_line_grows_lopsided():
    # The third moment of two lines of shares p and 1 - p is p (1 - p) (1 - 2 p) times the cube
    # of their distance: it rises up to p = 0.21.
    found = []
    for share in (0.0, 0.05, 0.1, 0.2):
        rng = np.random.default_rng(1)
        _, light = lopsided(rng, 2.0, 150.0, share)
        image = noisy(rng, light, 20.0, 1.0)
        found.append(survey(image, settings_for(1.0), nothing_clipped(image)).misfit)
    assert found[0] < 0.01
    assert found == sorted(found)


def test_misfit_is_the_root_of_what_is_common():
    rng = np.random.default_rng(2)
    light = rng.uniform(0, 100, 50_000)
    common = (0.05 * light) ** 2 + rng.normal(0, 4.0, light.shape)
    scatter = Scatter(light, np.full_like(light, 4.0), common, light < 1)
    # Weighted least squares of the square: sum of light^4 is N 100^4 / 5.
    chance = 4 * 4.0 / np.sqrt(50_000 * 100.0**4 / 5)
    assert scatter.misfit(Noise(4.0, 0.0)) ** 2 == pytest.approx(0.05**2, abs=chance)
    assert Scatter(light, common, -common, light < 1).misfit(Noise(4.0, 0.0)) == 0.0


@pytest.mark.parametrize("name", ["ml", "gaussian", "centroid-squared", "smoothed-peak"])
def test_misfit_never_makes_a_line_surer(name):
    rng = np.random.default_rng(3)
    _, light = lopsided(rng, 2.0, 150.0, 0.25)
    pure = light_of(centres_of(np.random.default_rng(3)), 2.0, 150.0)
    sigma = []
    for drawn in (pure, light):
        image = noisy(np.random.default_rng(4), drawn, 20.0, 1.0)
        stripe = find_extractor(name)(image, settings_for(1.0), nothing_clipped(image))
        sigma.append(np.median(stripe.sigma_px))
    assert sigma[1] > sigma[0]


def test_a_picture_that_is_noisy_only_beside_its_line_is_not_taken_at_its_word():
    # As compression leaves it: no noise at all far away.
    rng = np.random.default_rng(5)
    centre = centres_of(rng)
    image = noisy(rng, light_of(centre, 2.0, 150.0), 20.0, 3.0)
    far = np.abs(np.arange(HEIGHT)[:, None] - centre) > 12
    image[far] = 20.0
    pulls = {}
    for name in ("ml", "gaussian"):
        stripe = find_extractor(name)(image, StripeSection(), nothing_clipped(image))
        pulls[name] = np.mean(((stripe.centre_px - centre) / stripe.sigma_px) ** 2)
    assert all(0.8 <= value <= 1.25 for value in pulls.values()), pulls
