"""Spectra and moments of patches against closed forms: waves, white noise, Parseval's theorem."""

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from rough_patches import patch, wave, whole

from lscan.errors import InputError, MeasurementError
from lscan.roughness import (
    Patch,
    PowerLaw,
    by_rings,
    capon_spectrum,
    from_profiles,
    moments,
    patch_spectrum,
    profile_spectrum,
    structure_function,
)
from lscan.roughness.spectra import detrend, sine_tapers

CELL_CM = 0.2


def test_tapers_are_orthonormal() -> None:
    tapers = sine_tapers(50, 5)
    np.testing.assert_allclose(tapers @ tapers.T, np.eye(5), atol=1e-12)


@examples(20)
@given(seed=st.integers(0, 2**31), rows=st.integers(16, 40), columns=st.integers(16, 40))
def test_the_integral_of_a_spectrum_is_the_mean_square_under_its_tapers(
    seed: int, rows: int, columns: int
) -> None:
    """Parseval's theorem: the sum over the plane times its cell is the tapered mean square."""
    z = np.random.default_rng(seed).normal(0, 2, (rows, columns))
    found = patch_spectrum(whole(z, CELL_CM), tapers=1)
    cell = (2 * np.pi / CELL_CM) ** 2 / z.size
    y, x = np.indices(z.shape)
    design = np.column_stack([np.ones(z.size), y.ravel(), x.ravel()])
    flat = z.ravel() - design @ np.linalg.lstsq(design, z.ravel(), rcond=None)[0]
    taper = np.outer(sine_tapers(rows, 1)[0], sine_tapers(columns, 1)[0])
    expected = np.sum((taper * flat.reshape(z.shape)) ** 2)
    assert found.density_cm4.sum() * cell == pytest.approx(expected, rel=1e-9)


def test_white_noise_is_flat_whatever_is_missing() -> None:
    """At variance times a cell over (2 pi)²; the mean of 20 patches' inner values to 3 sigmas."""
    rng, means = np.random.default_rng(2), []
    for _ in range(20):
        seen = rng.random((40, 48)) > 0.2
        found = patch_spectrum(patch(rng.normal(0, 0.3, seen.shape), seen, CELL_CM))
        size = np.hypot(found.along_y_per_cm, found.along_x_per_cm)
        means.append(found.density_cm4[size > 3.0].mean())
    expected = 0.3**2 * CELL_CM**2 / (2 * np.pi) ** 2
    error = np.std(means, ddof=1) / np.sqrt(20)
    assert np.mean(means) == pytest.approx(expected, abs=3 * error)
    assert error < 0.01 * expected


def test_rings_hold_an_isotropic_law() -> None:
    """The rings' means of a law's own values lie between the law at their edges."""
    found = patch_spectrum(whole(np.random.default_rng(1).normal(size=(64, 64)), CELL_CM))
    law = PowerLaw(3.0, 0.01)
    known = type(found)(
        found.along_y_per_cm,
        found.along_x_per_cm,
        law.density(found.along_y_per_cm, found.along_x_per_cm),
        found.freedom,
    )
    rings = by_rings(known)
    np.testing.assert_allclose(
        rings.density_cm4, law.density(0.0, rings.wavenumber_per_cm), rtol=0.35
    )
    assert (rings.low_cm4 < rings.density_cm4).all()
    assert (rings.density_cm4 < rings.high_cm4).all()


def test_profiles_have_the_spectrum_of_their_noise() -> None:
    """Two-sided: variance times a cell over 2 pi; holes leave their profiles out."""
    rng = np.random.default_rng(3)
    seen = np.ones((200, 64), dtype=bool)
    seen[:50, 7] = False
    found = profile_spectrum(patch(rng.normal(0, 0.5, seen.shape), seen, CELL_CM), axis=1)
    assert found.profiles == 150
    inner = found.density_cm3[4:-1]
    expected = 0.5**2 * CELL_CM / (2 * np.pi)
    # 150 profiles of 3 tapers: each value scatters by 1 / sqrt(450).
    np.testing.assert_allclose(inner, expected, rtol=5 / np.sqrt(450))
    with pytest.raises(MeasurementError, match="no profile along y"):
        profile_spectrum(patch(rng.normal(size=(64, 40)), rng.random((64, 40)) > 0.3, 0.2), axis=0)


def test_capon_stands_at_a_wave_and_is_flat_on_noise() -> None:
    rng = np.random.default_rng(4)
    k = np.linspace(1.0, 12.0, 111)
    noise = rng.normal(0, 0.1, (40, 48))
    seen = np.ones(noise.shape, dtype=bool)
    flat = capon_spectrum(noise, seen, CELL_CM, k, 12)
    expected = 0.1**2 * CELL_CM / (2 * np.pi)
    # Below a window's own resolution the slope that is taken away is missing.
    apart = k > 2 * np.pi / (12 * CELL_CM)
    np.testing.assert_allclose(flat.density_cm3[apart], expected, rtol=0.25)
    along = CELL_CM * np.arange(48)
    waves = noise + np.cos(6.0 * along + rng.uniform(0, 6, 40)[:, None])
    found = capon_spectrum(waves, seen, CELL_CM, k, 12)
    assert k[np.argmax(found.density_cm3)] == pytest.approx(6.0, abs=0.1)
    with pytest.raises(InputError, match="order"):
        capon_spectrum(noise, seen, CELL_CM, k, 30)


@pytest.mark.parametrize("gamma2", [2.2, 3.0, 3.9])
def test_a_profile_s_law_is_the_integral_of_the_surface_s(gamma2: float) -> None:
    law = PowerLaw(gamma2, 0.004)
    gamma1, w1 = law.one_dimensional
    across = np.sinh(np.linspace(-18, 18, 20001))  # the integral's steps grow with the wavenumber
    integral = np.trapezoid(law.density(across, 2.0 + 0 * across), across)
    # Beyond the last step: 2 w2 K^(1 - gamma2) / (gamma2 - 1), 1e-9 of it and less.
    assert integral == pytest.approx(w1 * 2.0**-gamma1, rel=1e-5)
    assert from_profiles(gamma1, w1).w2_cm4 == pytest.approx(0.004)


def test_stretch_keeps_the_plane_s_area_and_says_its_heading() -> None:
    law = PowerLaw(3.0, 0.01, (0.0, -0.5 * np.log(4.0) * 2))
    assert law.ratio == pytest.approx(4.0)
    assert law.heading_deg == pytest.approx(45.0)
    angle = np.radians([45.0, 135.0])
    rough, smooth = law.density(np.sin(angle), np.cos(angle))
    assert rough / smooth == pytest.approx(4.0**3)


def test_moments_of_a_wave_on_a_slope() -> None:
    """rms a / sqrt(2); the difference of neighbours of a wave is 2 sin(k d / 2) times it."""
    z = wave((64, 80), CELL_CM, 8.0, 90.0, 1.5) + 0.3 + 0.02 * np.arange(80)
    found = moments(whole(z, CELL_CM))
    k = 2 * np.pi * 8 / (64 * CELL_CM)
    assert found.rms_height_cm == pytest.approx(1.5 / np.sqrt(2), rel=1e-3)
    slope = 1.5 / np.sqrt(2) * 2 * np.sin(k * CELL_CM / 2) / CELL_CM
    assert found.rms_slope_y == pytest.approx(slope, rel=0.02)
    assert found.rms_slope_x == pytest.approx(0.0, abs=1e-3)
    assert found.skewness == pytest.approx(0.0, abs=1e-3)


def test_noise_is_taken_off_the_moments() -> None:
    rng = np.random.default_rng(5)
    smooth = wave((64, 64), CELL_CM, 4.0, 0.0, 0.2)
    noisy = patch(smooth + rng.normal(0, 0.1, smooth.shape), None, CELL_CM, 0.1**2)
    clean = moments(whole(smooth, CELL_CM))
    found = moments(noisy)
    # The mean square of 4,096 values of noise is known to 2.2 %, 2e-4 cm² of 0.02.
    assert found.rms_height_cm == pytest.approx(clean.rms_height_cm, rel=0.03)
    with pytest.raises(MeasurementError, match="no more than"):
        moments(patch(rng.normal(0, 0.09, (40, 40)), None, CELL_CM, 0.1**2))


def test_structure_function_counts_pairs_by_the_definition() -> None:
    rng = np.random.default_rng(6)
    seen = rng.random((20, 24)) > 0.2
    z = rng.normal(0, 1, seen.shape)
    one = patch(z, seen, CELL_CM)
    flat = np.where(seen, detrend(one), np.nan)
    for axis in (0, 1):
        found = structure_function(one, axis)
        turned = flat if axis == 1 else flat.T
        for lag in range(1, len(found.pairs) + 1):
            differences = turned[:, lag:] - turned[:, :-lag]
            known = np.isfinite(differences)
            assert found.pairs[lag - 1] == known.sum()
            assert found.difference_cm2[lag - 1] == pytest.approx(
                np.mean(differences[known] ** 2), rel=1e-9
            )


def test_too_small_or_empty_patches_are_refused() -> None:
    with pytest.raises(MeasurementError, match="10 by 40 cells"):
        whole(np.zeros((10, 40)), 0.1)
    with pytest.raises(MeasurementError, match="% of the patch's cells"):
        Patch(np.zeros((40, 40)), np.zeros((40, 40), dtype=bool), 0.1)
