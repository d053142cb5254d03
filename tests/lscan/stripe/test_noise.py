"""The noise model: estimated by light, stated in the rig file, and of a difference."""

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from stripe_pictures import centres_of, light_of, noisy

from lscan.config.rig import NoiseSection, StripeSection
from lscan.stripe import extract_stripe
from lscan.stripe.picture import Noise, difference_noise, scatter_noise, stated_noise


@examples(25)
@given(
    seed=st.integers(0, 2**32 - 1),
    gain=st.floats(0.05, 1.0),
    speckle=st.floats(0.0, 0.3),
)
def test_shot_noise_and_speckle_are_distinguished(seed, gain, speckle):
    rng = np.random.default_rng(seed)
    light, truth = rng.uniform(0, 200, 40_000), Noise(2.0, gain, speckle)
    square = truth.variance(light) * rng.standard_normal(light.shape) ** 2
    found = scatter_noise(square, light, 2.0)
    # Weighted least squares of squares with the relative variance 2; 5 sigma are left out,
    # which takes 2e-5 of the variance.
    weight = truth.variance(light) ** -2 / 2
    terms = np.stack([light, light**2])
    chance = 4 * np.sqrt(np.diag(np.linalg.inv((terms * weight) @ terms.T)))
    assert abs(found.per_dn - gain) <= chance[0]
    assert abs(found.speckle**2 - speckle**2) <= chance[1]


def test_neither_term_of_the_noise_is_negative():
    light = np.linspace(0, 200, 1000)
    for square in (np.zeros(1000), 2.0 - 0.01 * light, 2.0 + 0.5 * light - 1e-4 * light**2):
        found = scatter_noise(np.maximum(square, 0), light, 2.0)
        assert found.per_dn >= 0
        assert found.speckle >= 0
    assert scatter_noise(np.empty(0), np.empty(0), 2.0) == Noise(2.0, 0.0, 0.0)


def test_variance_is_the_sum_of_three_terms_and_the_veil_has_no_speckle():
    noise = Noise(2.0, 0.5, 0.1)
    assert noise.variance(np.array([100.0]), 20.0)[0] == pytest.approx(2 + 60 + 100)
    assert noise.variance(np.array([0.0]), -5.0)[0] == 2.0


def test_a_pictures_ground_has_shot_noise_too():
    section = NoiseSection(read_dn=2.0, dn_per_electron=0.5, speckle=0.2)
    assert stated_noise(section, 30.0) == Noise(19.0, 0.5, 0.2)
    assert stated_noise(section, -3.0) == Noise(4.0, 0.5, 0.2)


def test_the_noise_of_a_difference_is_that_of_both_pictures():
    rng = np.random.default_rng(1)
    read, gain, dark = 1.5, 0.4, 60.0
    pictures = [
        rng.poisson(dark / gain, 200_000) * gain + rng.normal(0, read, 200_000) for _ in range(2)
    ]
    section = difference_noise(NoiseSection(read_dn=read, dn_per_electron=gain), dark)
    # The relative deviation of a variance of N values is sqrt(2 / N): 3.3 of them.
    variance = (pictures[0] - pictures[1]).var()
    assert section.read_dn**2 == pytest.approx(variance, rel=3.3 * np.sqrt(2 / 200_000))
    assert section.dn_per_electron == gain


def test_sigma_holds_where_a_background_was_subtracted():
    rng = np.random.default_rng(2)
    stated = NoiseSection(read_dn=2.0, dn_per_electron=0.3)
    section = StripeSection(extractor="ml", noise=stated)
    pulls = []
    for _ in range(4):
        centre = centres_of(rng)
        line = light_of(centre, 1.2, 120.0)
        lit, dark = (
            np.clip(noisy(rng, light, 60.0, 1.98, 0.3), 0, 255).astype(np.uint8)
            for light in (line, np.zeros_like(line))
        )
        stripe = extract_stripe(lit, section, dark)
        pulls.append((stripe.centre_px - centre) / stripe.sigma_px)
    pull = np.concatenate(pulls)
    assert 0.85 <= (pull**2).mean() <= 1.15
