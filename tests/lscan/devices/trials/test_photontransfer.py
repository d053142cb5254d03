"""Photon transfer on simulated sensors whose gain and noise are known."""

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st

from lscan.devices.photontransfer import (
    ROUNDING_DN,
    Levels,
    dark_level,
    grey_levels,
    linearity,
    photon_transfer,
)
from lscan.errors import InputError, MeasurementError
from lscan.records import Bytes, Floats, Singles

SHAPE = (48, 64)
SIGMAS = 5.0
"""A figure may lie this many of its own standard uncertainties off: one in 1.7 million."""


def sensor(
    scene_dn: Floats,
    pictures: int,
    gain: float,
    read_dn: float,
    black_dn: float | Floats = 0.0,
    light: Floats | None = None,
    seed: int = 1,
    bits: int = 8,
) -> Bytes | Singles:
    """Pictures (N, H, W) of a linear camera: Poisson electrons, Gaussian noise, rounding.

    scene_dn: (H, W) mean light in DN.  light: (N,) brightness of the lamp at each picture.
    bits: of the camera: float32 from 10 on.
    """
    generator = np.random.default_rng(seed)
    lamp = np.ones(pictures) if light is None else light
    electrons = generator.poisson(lamp[:, None, None] * scene_dn / gain)
    value = black_dn + gain * electrons + generator.normal(0, read_dn, (pictures, *SHAPE))
    if bits == 8:
        return np.clip(np.rint(value), 0, 255).astype(np.uint8)
    steps = 2.0 ** (bits - 8)
    return np.clip(np.rint(steps * value) / steps, 0, 255).astype(np.float32)


def gradient(low_dn: float = 20.0, high_dn: float = 200.0) -> Floats:
    return np.linspace(low_dn, high_dn, SHAPE[0] * SHAPE[1]).reshape(SHAPE)


def total_read_dn(read_dn: float) -> float:
    """With rounding; exact to 1e-4 from 0.5 DN on (Sheppard's correction)."""
    return float(np.hypot(read_dn, ROUNDING_DN))


@examples(25)
@given(gain=st.floats(0.02, 1.0), read_dn=st.floats(0.5, 4.0), seed=st.integers(0, 10**6), dark=...)
def test_gain_and_read_noise_are_recovered(
    gain: float, read_dn: float, seed: int, dark: bool
) -> None:
    # At 20 DN the noise in the dark, at most 4 DN, is not clipped.
    black_dn = 20.0 if dark else 0.0
    pictures = sensor(gradient(60, 200), 16, gain, read_dn, black_dn, seed=seed)
    unlit = sensor(np.zeros(SHAPE), 16, gain, read_dn, black_dn, seed=seed + 1) if dark else None
    found = photon_transfer(grey_levels(pictures), None if unlit is None else dark_level(unlit))
    assert abs(found.dn_per_electron - gain) < SIGMAS * found.gain_sigma
    # Drawn on from 60 DN, the variance in the dark may come out below that of rounding: then
    # the noise is known as little as its variance.
    variance, expected = found.read_dn**2, total_read_dn(read_dn) ** 2
    assert abs(variance - expected) < SIGMAS * 2 * found.read_dn * found.read_sigma_dn
    # chi² over k degrees of freedom has standard deviation sqrt(2 / k).
    count = len(found.levels.mean_dn)
    assert abs(found.chi2 - 1) < SIGMAS * np.sqrt(2 / (count - 2))


@pytest.mark.parametrize("bits", [12, 16])
def test_a_deep_camera_s_noise_is_known_below_one_dn(bits: int) -> None:
    """Rounded to s DN a noise of a sixth of a DN has s²/12 more variance."""
    lit = sensor(gradient(60, 200), 16, 0.01, 0.16, 20.0, bits=bits)
    unlit = sensor(np.zeros(SHAPE), 16, 0.01, 0.16, 20.0, seed=2, bits=bits)
    found = photon_transfer(grey_levels(lit), dark_level(unlit))
    assert abs(found.dn_per_electron - 0.01) < SIGMAS * found.gain_sigma
    expected = np.sqrt(0.16**2 + 4.0 ** (8 - bits) / 12)
    assert abs(found.read_dn - expected) < SIGMAS * found.read_sigma_dn
    assert found.read_dn < ROUNDING_DN and not found.read_is_rounding


def test_the_stated_uncertainty_is_the_scatter() -> None:
    """Over 60 sensors, z has the standard deviation 1; that of 60 values is known to 9 %."""
    z = []
    for seed in range(60):
        found = photon_transfer(grey_levels(sensor(gradient(), 8, 0.2, 1.5, seed=seed)))
        z.append((found.dn_per_electron - 0.2) / found.gain_sigma)
    assert abs(np.std(z) - 1) < 4 * 0.09
    assert abs(np.mean(z)) < 4 / np.sqrt(60)


def test_more_pictures_are_surer() -> None:
    sigmas = [
        photon_transfer(grey_levels(sensor(gradient(), count, 0.1, 1.0))).gain_sigma
        for count in (8, 32, 128)
    ]
    # 16 times the data, a quarter of the uncertainty.
    np.testing.assert_allclose(sigmas[0] / sigmas[2], 4.0, rtol=0.1)
    assert sigmas[0] > sigmas[1] > sigmas[2]


@pytest.mark.parametrize(("offset_dn", "columns_dn"), [(0.0, 0.0), (3.0, 0.0), (0.0, 3.0)])
def test_pixels_are_sorted_by_neither_noise_nor_offset(offset_dn: float, columns_dn: float) -> None:
    """In a scene almost flat, levels made of either would have a slope of 0; z has mean 0 here."""
    z = []
    for seed in range(40):
        draw = np.random.default_rng(1000 + seed).normal
        offsets = draw(0, offset_dn, SHAPE) + draw(0, columns_dn, SHAPE[1])
        pictures = sensor(gradient(96, 106), 16, 0.5, 1.0, offsets, seed=seed)
        found = photon_transfer(grey_levels(pictures))
        z.append((found.dn_per_electron - 0.5) / found.gain_sigma)
    assert abs(np.mean(z)) < 4 / np.sqrt(40)


def test_a_flat_scene_does_not_determine_the_gain() -> None:
    """Then nothing is found, or with an uncertainty as large as the gain itself."""
    flat = grey_levels(sensor(np.full(SHAPE, 100.0), 16, 0.5, 1.0))
    try:
        found = photon_transfer(flat)
    except MeasurementError:
        return
    assert found.gain_sigma > 0.5


def test_a_lamp_that_drifts_is_taken_out() -> None:
    """A flicker of 3 % is 6 DN at 200 DN, twice the noise, and the same all over a level."""
    lamp = 1 + 0.03 * np.random.default_rng(4).standard_normal(16)
    found = photon_transfer(grey_levels(sensor(gradient(), 16, 0.05, 0.8, light=lamp)))
    assert abs(found.dn_per_electron - 0.05) < SIGMAS * found.gain_sigma


def test_what_stands_still_is_not_noise() -> None:
    """Fixed pattern: pixels that differ from each other by far more than by their noise."""
    pattern = np.random.default_rng(2).uniform(30, 200, SHAPE)
    found = photon_transfer(grey_levels(sensor(pattern, 16, 0.1, 1.0)))
    assert abs(found.dn_per_electron - 0.1) < SIGMAS * found.gain_sigma


def test_clipped_levels_are_passed_over() -> None:
    clear = grey_levels(sensor(gradient(20, 400), 16, 0.3, 1.0))
    assert clear.mean_dn.max() < 255 - 3 * np.sqrt(0.3 * 240)
    found = photon_transfer(clear)
    assert abs(found.dn_per_electron - 0.3) < SIGMAS * found.gain_sigma


def test_a_dark_that_is_clipped_does_not_count_as_noise() -> None:
    """At black level 0 half of the noise is cut off; the line is drawn on to 0 instead."""
    unlit = dark_level(sensor(np.zeros(SHAPE), 16, 0.1, 2.0))
    assert unlit.variance[0] < 0.6 * total_read_dn(2.0) ** 2
    found = photon_transfer(grey_levels(sensor(gradient(), 16, 0.1, 2.0)), unlit)
    assert found.dark_dn == 0
    assert abs(found.read_dn - total_read_dn(2.0)) < SIGMAS * found.read_sigma_dn


def test_a_gamma_curve_shows_in_chi2() -> None:
    linear = sensor(gradient(), 64, 0.1, 1.0).astype(float)
    bent = np.rint(255 * (linear / 255) ** 0.45).astype(np.uint8)
    found = photon_transfer(grey_levels(bent))
    # For a linear camera chi² over k degrees of freedom is 1 with standard deviation sqrt(2 / k).
    assert found.chi2 > 1 + SIGMAS * np.sqrt(2 / (len(found.levels.mean_dn) - 2))


def test_dark_noise_is_that_of_the_sensor() -> None:
    unlit = dark_level(sensor(np.zeros(SHAPE), 8, 1.0, 1.5, black_dn=16))
    sigma = unlit.variance[0] * np.sqrt(2 / unlit.differences[0])
    assert abs(unlit.variance[0] - total_read_dn(1.5) ** 2) < SIGMAS * sigma
    assert abs(unlit.mean_dn[0] - 16) < SIGMAS * 1.6 / np.sqrt(8 * SHAPE[0] * SHAPE[1])


def test_levels_without_noise_still_give_finite_figures() -> None:
    count = 5
    still = Levels(
        np.arange(count) * 20.0 + 20,
        np.zeros(count),
        np.full(count, 1e4),
        np.zeros(count),
        np.ones(count),
    )
    found = photon_transfer(still)
    assert found.read_dn == pytest.approx(ROUNDING_DN)
    assert found.dn_per_electron == pytest.approx(0)
    assert np.isfinite([found.read_sigma_dn, found.gain_sigma, found.chi2]).all()


@pytest.mark.parametrize(
    "pictures",
    [
        np.zeros((3, 8, 8), np.uint8),
        np.zeros((8, 8), np.uint8),
        np.zeros((4, 8, 8), np.uint16),
        np.zeros((4, 8, 8, 3), np.uint8),
    ],
)
def test_pictures_that_cannot_be_used(pictures: Bytes) -> None:
    with pytest.raises(InputError, match=r"uint8 or float32 of shape \(N, H, W\), N at least 4"):
        grey_levels(pictures)


@pytest.mark.parametrize("value", [0, 255])
def test_a_scene_all_black_or_white(value: int) -> None:
    levels = grey_levels(np.full((4, *SHAPE), value, np.uint8))
    with pytest.raises(MeasurementError, match=r"0 unclipped levels.*bright and dark parts"):
        photon_transfer(levels)


def test_linearity_of_a_line_and_of_a_parabola() -> None:
    """Closed forms: a line has no error; 40 t (1 + 0.1 t) is off its line by a known part."""
    exposure_ms = np.array([1.0, 2.0, 3.0, 4.0, 5.0])
    straight = linearity(exposure_ms, 3 + 45 * exposure_ms)
    assert straight.error_percent == pytest.approx(0, abs=1e-9)
    assert (straight.offset_dn, straight.dn_per_ms) == pytest.approx((3, 45))
    two = linearity(np.array([1.0, 1.0, 2.0, 3.0]), np.array([49.0, 51.0, 100.0, 150.0]))
    # The line 50 t leaves 1 in 50 at two of four exposures: 1 % in the mean.
    assert two.error_percent == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("gamma", [1.0, 1.8, 2.2, 2.6])
def test_a_tone_curve_is_found_from_exposures(gamma: float) -> None:
    """Grey values to 0.1 DN behind a curve over a dark level of 4 DN: gamma within 4 sigma."""
    exposure_ms, generator = np.arange(1.0, 9.0), np.random.default_rng(11)
    light = (4 + 25 * exposure_ms) / 255
    found = linearity(exposure_ms, 255 * light ** (1 / gamma) + generator.normal(0, 0.1, 8))
    assert found.gamma is not None and found.gamma_sigma is not None
    assert abs(found.gamma - gamma) < 4 * found.gamma_sigma < 0.2
    assert found.is_curved == (gamma > 1)


def test_a_camera_that_does_not_obey_has_no_curve() -> None:
    grey = 44.4 + 0.2 * np.random.default_rng(3).normal(size=8)
    assert not linearity(np.arange(1.0, 9.0), grey).is_curved


def test_linearity_needs_three_exposures_in_range() -> None:
    with pytest.raises(MeasurementError, match="13 to 242 DN"):
        linearity(np.array([1.0, 2.0, 3.0, 4.0]), np.array([5.0, 50.0, 100.0, 250.0]))
