"""Roughness against closed forms: sines, Parseval's theorem, white noise, power laws."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from lscan.errors import InputError, MeasurementError
from lscan.measure.roughness import (
    Spectrum,
    fit_power_law,
    power_spectrum,
    rms_height,
    structure_function,
)
from lscan.records import Floats, Status
from lscan.surface import Slice

STEP_MM = 0.5


def cut(z: Floats) -> Slice:
    along = STEP_MM * np.arange(len(z))
    status = np.where(np.isfinite(z), int(Status.OK), int(Status.NO_DATA))
    return Slice(np.column_stack([along, 0 * along]), along, z, 0 * z + 0.1, status, 1.4)


def wave(amplitude: float, cycles: int, count: int = 400) -> Floats:
    return amplitude * np.cos(2 * np.pi * cycles * (np.arange(count) + 0.5) / count)


@given(st.floats(0.1, 10), st.integers(2, 40), st.floats(-5, 5), st.floats(-0.1, 0.1))
@settings(max_examples=30)
def test_rms_of_a_wave_on_a_slope(a: float, cycles: int, offset: float, slope: float) -> None:
    # A cosine symmetric about the slice's middle has no trend of its own.
    z = wave(a, cycles) + offset + slope * np.arange(400)
    assert rms_height(cut(z)) == pytest.approx(a / np.sqrt(2), rel=1e-9)


def test_the_integral_of_the_spectrum_is_the_variance() -> None:
    """Parseval's theorem, about the trend that was taken out."""
    measured = cut(np.random.default_rng(1).normal(0, 2, 401).cumsum())
    spectrum = power_spectrum(measured, window="boxcar")
    bin_width = spectrum.wavenumber_per_mm[0]
    total = float(np.sum(spectrum.density_mm3) * bin_width)
    assert total == pytest.approx(rms_height(measured) ** 2, rel=1e-9)


def test_a_wave_stands_at_its_wavenumber() -> None:
    spectrum = power_spectrum(cut(wave(3.0, 16)))
    top = int(np.argmax(spectrum.density_mm3))
    assert spectrum.wavenumber_per_mm[top] == pytest.approx(16 / (400 * STEP_MM))


def test_white_noise_is_flat_at_twice_its_variance_times_the_step() -> None:
    rng = np.random.default_rng(2)
    densities = [power_spectrum(cut(rng.normal(0, 0.3, 400))).density_mm3 for _ in range(200)]
    inner = np.mean(densities, axis=0)[5:-5]
    # Each value scatters by its own size: 1 / sqrt(200) in the mean, five times that.
    np.testing.assert_allclose(inner, 2 * 0.3**2 * STEP_MM, rtol=0.36)
    assert inner.mean() == pytest.approx(2 * 0.3**2 * STEP_MM, rel=0.03)


def test_structure_function_of_a_slope_is_its_square() -> None:
    distance, mean, pairs = structure_function(cut(0.2 * STEP_MM * np.arange(100.0)))
    np.testing.assert_allclose(distance, STEP_MM * np.arange(1, 51))
    np.testing.assert_allclose(mean, (0.2 * distance) ** 2, rtol=1e-6, atol=1e-9)
    np.testing.assert_array_equal(pairs, 100 - np.arange(1, 51))


def test_structure_function_skips_holes() -> None:
    """Against the definition, pair by pair."""
    z = np.random.default_rng(3).normal(0, 1, 60)
    z[[4, 5, 30]] = np.nan
    distance, mean, pairs = structure_function(cut(z))
    for k in range(len(distance)):
        lag = round(distance[k] / STEP_MM)
        differences = z[lag:] - z[:-lag]
        known = np.isfinite(differences)
        assert pairs[k] == known.sum()
        assert mean[k] == pytest.approx(np.mean(differences[known] ** 2), rel=1e-9)


def test_the_spectrum_says_what_it_left_out() -> None:
    z = wave(1.0, 10)
    z[100] = np.nan
    spectrum = power_spectrum(cut(z))
    assert (spectrum.points, spectrum.left_out) == (299, 101)


def test_a_power_law_is_found() -> None:
    wavenumber = np.arange(1, 200) / 200
    law = fit_power_law(Spectrum(wavenumber, 0.02 * wavenumber**-3.2, 400, 0), (0.02, 0.5))
    assert law.exponent == pytest.approx(3.2)
    assert law.strength == pytest.approx(0.02)
    assert law.exponent_sigma < 1e-9


def test_too_little_data_is_said() -> None:
    empty = cut(np.full(50, np.nan))
    for measure in (rms_height, structure_function, power_spectrum):
        with pytest.raises(MeasurementError, match="0 slice points"):
            measure(empty)
    with pytest.raises(InputError, match="unknown window"):
        power_spectrum(cut(wave(1.0, 5)), window="no such")
    with pytest.raises(MeasurementError, match="power law: 0 values"):
        fit_power_law(power_spectrum(cut(wave(1.0, 5))), (5.0, 6.0))
