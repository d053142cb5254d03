"""Relief as fine as the sheet is thick: its transfer, its spectrum, and what is recovered of it."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st

from lscan.config.rig import SheetSection
from lscan.records import Floats, Ints, Surface
from lscan.surface.sheetresponse import (
    SEGMENT,
    ReliefSpectrum,
    Sight,
    responses,
    series_shifts,
    spectrum_of,
    transfer,
)
from lscan.surface.thickness import correct_thickness

pytestmark = pytest.mark.xdist_group("relief")  # one worker: they share a fixture

SHEET = SheetSection(thickness_mm=1.5, camera_mm=(0.0, -870.0, 300.0), apex_mm=(0.0, 0.0, 250.0))
SIGMA_MM = SHEET.thickness_mm / 2
LEVEL_MM, ROW_MM, COLUMN_MM = -330.0, 1.0, 1.1
FINE_MM = 0.05
Relief = Callable[[Floats], Floats]


def shown(relief: Relief, y_mm: Floats) -> Floats:
    """(R,) heights that the line shows of a relief along y, by quadrature from first principles.

    The centroid of what is seen, in the plane through the camera: Gaussian light, the cosine of
    incidence from straight above, the stretching of the picture, and what hides what.
    """
    y = np.arange(-3.5, 3.5, 0.02) * SIGMA_MM
    tau = (SHEET.camera_mm[2] - LEVEL_MM) / -SHEET.camera_mm[1]
    around = relief(y_mm[:, None] + y) + tau * y
    rise = np.gradient(around, y, axis=1)
    cosine = 1 / np.hypot(1, rise - tau)
    seen = (around >= np.maximum.accumulate(around, axis=1) - 1e-9) & (rise > 0)
    light = np.where(seen, cosine * rise * np.exp(-0.5 * (y / SIGMA_MM) ** 2), 0.0)
    return np.asarray((light * around).sum(axis=1) / light.sum(axis=1))


def scan(height: Floats, noise_mm: float, generator: np.random.Generator) -> Surface:
    """A scan of R by C heights about LEVEL_MM, each with noise of its own, stated."""
    rows, columns = height.shape
    x = COLUMN_MM * (np.arange(columns) - columns // 2)
    x, y = np.meshgrid(x, ROW_MM * np.arange(rows))
    z = LEVEL_MM + height + generator.normal(0.0, noise_mm, height.shape)
    sigma = np.full(height.shape, noise_mm)
    ok = np.zeros(height.shape, dtype=np.int64)
    return Surface(np.stack([x, y, z], axis=-1), 0 * sigma, sigma, ok, ROW_MM * np.arange(rows))


def rough(generator: np.random.Generator, rms_mm: float = 0.4) -> Relief:
    """A bed whose amplitude spectrum falls with the wavenumber, from 100 mm down to 3 mm."""
    wavenumber = np.exp(generator.uniform(np.log(0.01), np.log(0.33), 200))
    phase = generator.uniform(0, 2 * np.pi, 200)
    amplitude = rms_mm * np.sqrt(2 * wavenumber**-1.2 / (wavenumber**-1.2).sum())

    def relief(y: Floats) -> Floats:
        turns = 2 * np.pi * y[..., None] * wavenumber + phase
        return np.asarray((amplitude * np.cos(turns)).sum(axis=-1))

    return relief


# --- the transfer -------------------------------------------------------------------------


@given(wave_mm=st.floats(3.5, 60.0))
@examples(25)
def test_small_waves_are_shown_with_the_gain_stated(wave_mm: float) -> None:
    """Of an amplitude of 1e-4 of the wave's length what is not linear is 1e-3 of it."""
    amplitude, k = 1e-4 * wave_mm, 2 * np.pi / wave_mm
    y = np.arange(0.0, 120.0, 0.5)
    wave = shown(lambda y: amplitude * np.cos(k * y), y)
    gain = 2 * np.mean(wave * np.cos(k * y)) / amplitude
    whole = 2 * np.mean(np.cos(k * y) ** 2)  # the scan is no whole number of waves
    expected = transfer(np.array([1 / wave_mm]), SIGMA_MM)[0]
    assert gain / whole == pytest.approx(expected, abs=5e-3)


@pytest.mark.parametrize("slope", [0.0, 0.3])
def test_a_plane_is_shown_as_it_is(slope: float) -> None:
    height = LEVEL_MM + slope * np.arange(0.0, 40.0, 0.5)[:, None] * np.ones(5)
    tau = np.full(height.shape, 0.7)
    sight = Sight(tau, np.zeros(5), np.stack([0 * tau, 580.0 + 0 * tau]))
    for found in responses(height, 0.5, 1.0, 0.75, sight):
        np.testing.assert_allclose(found[8:-8], height[8:-8], atol=1e-6)


def test_the_response_is_that_of_the_integral() -> None:
    """On ripples of 20 mm by 2 mm, by another quadrature: 25 to 700 places across the sheet."""
    k = 2 * np.pi / 20.0

    def relief(y: Floats) -> Floats:
        return np.cos(k * y)

    y = np.arange(0.0, 60.0, 0.5)
    height = LEVEL_MM + relief(y)[:, None] * np.ones(3)
    tau = np.full(height.shape, (SHEET.camera_mm[2] - LEVEL_MM) / -SHEET.camera_mm[1])
    sight = Sight(tau, np.zeros(3), np.stack([0 * tau, 1e6 + 0 * tau]))
    found, linear = responses(height, 0.5, 1.0, SIGMA_MM, sight)
    inner = slice(10, -10)
    np.testing.assert_allclose(found[inner, 1] - LEVEL_MM, shown(relief, y)[inner], atol=2e-3)
    gain = transfer(np.array([1 / 20.0]), SIGMA_MM)[0]
    np.testing.assert_allclose(linear[inner, 1] - LEVEL_MM, gain * relief(y)[inner], atol=2e-3)


def test_what_a_steep_ripple_hides_is_not_shown() -> None:
    """Ripples of 2 mm by 1.6 mm, twice as steep as the line of sight: half of them is hidden."""
    k = 2 * np.pi / 2.0

    def relief(y: Floats) -> Floats:
        return 0.8 * np.cos(k * y)

    y = np.arange(0.0, 12.0, 0.05)
    height = LEVEL_MM + relief(y)[:, None] * np.ones(1)
    tau = np.full(height.shape, (SHEET.camera_mm[2] - LEVEL_MM) / -SHEET.camera_mm[1])
    sight = Sight(tau, np.zeros(1), np.stack([0 * tau, 1e6 + 0 * tau]))
    found = responses(height, 0.05, 1.0, SIGMA_MM, sight)[0][60:-60, 0] - LEVEL_MM
    # Taken at every quarter of a sigma, an edge of what is hidden is off by an eighth of one.
    assert np.sqrt(np.mean((found - shown(relief, y)[60:-60]) ** 2)) < 0.08


# --- the spectrum -------------------------------------------------------------------------


@pytest.mark.parametrize("wave_mm", [pytest.param(4.0, marks=pytest.mark.slow), 10.0])
def test_what_the_series_leaves_of_a_wave_is_stated(wave_mm: float) -> None:
    """Of small waves at one wavenumber; where they are long the scan's few of them blur it."""
    x, y = np.meshgrid(np.arange(-5.0, 5.0, 0.25), np.arange(0.0, 60.0, 0.25))
    k, amplitude = 2 * np.pi / wave_mm, 1e-5
    gain = float(transfer(np.array([1 / wave_mm]), SIGMA_MM)[0])
    sigma, ok = np.full(x.shape, 1e-6), np.zeros(x.shape, dtype=np.int64)
    z = LEVEL_MM + amplitude * gain * np.cos(k * y)
    surface = Surface(np.stack([x, y, z], axis=-1), 0 * sigma, sigma, ok, y[:, 0])
    shift, _ = series_shifts(surface, SHEET, 0.0)
    inner, wave = np.s_[32:-32, 20], np.cos(k * y[32:-32, 20])
    made = float(shift[inner] @ wave / (wave @ wave)) / amplitude
    numbers = np.array([0.0, 1 / wave_mm])
    relief = np.array([np.inf, amplitude**2 * wave_mm / 4])
    found = ReliefSpectrum(numbers, relief, 0.0, np.array([1.0, gain]), np.zeros(2), SIGMA_MM)
    left = np.sqrt(2 * found.series_variance) / amplitude
    assert left == pytest.approx(abs(1 - gain + made), abs=0.006)


def test_the_relief_s_spectrum_comes_back() -> None:
    """White relief shown with H, and noise: 400 segments give S to 4 standard errors, 20 %."""
    generator = np.random.default_rng(2)
    long = generator.normal(0.0, 0.3, (16 * SEGMENT, 400))
    gain = transfer(np.fft.rfftfreq(len(long), ROW_MM), SIGMA_MM)[:, None]
    seen = np.fft.irfft(np.fft.rfft(long, axis=0) * gain, axis=0)[:SEGMENT]
    noisy = seen + generator.normal(0.0, 0.02, seen.shape)
    found = spectrum_of(noisy, ROW_MM, SIGMA_MM, 0.02)
    clear = (found.wavenumber_per_mm > 0.05) & (found.gain > 0.3)
    np.testing.assert_allclose(found.relief[clear], 0.3**2 * ROW_MM, rtol=0.2)
    assert (np.abs(found.filter * found.gain) <= 1).all()


def test_of_noise_alone_nothing_is_recovered() -> None:
    noise = np.random.default_rng(3).normal(0.0, 0.05, (SEGMENT, 300))
    found = spectrum_of(noise, ROW_MM, SIGMA_MM, 0.05)
    assert found.series_variance < 0.01**2
    assert (found.filter[2:] < 0.2).all()


# --- the correction -----------------------------------------------------------------------


@pytest.fixture(scope="module")
def bed() -> tuple[Floats, Surface]:
    """True heights (R, C) of a bed rough across the track, and a scan of it."""
    generator = np.random.default_rng(5)
    y = ROW_MM * np.arange(160)
    # Each of four columns has another profile: interpolated between, they are no bed.
    parts = [rough(generator) for _ in range(8)]
    true = np.repeat(np.column_stack([part(y) for part in parts]), 12, axis=1)
    seen = np.repeat(np.column_stack([shown(part, y) for part in parts]), 12, axis=1)
    return true, scan(seen, 0.03, generator)


@pytest.fixture(scope="module")
def corrected(bed: tuple[Floats, Surface]) -> Surface:
    return correct_thickness(bed[1], SHEET)


def _errors(surface: Surface, true: Floats) -> Floats:
    """Errors away from the scan's ends and from the seams of its eight profiles."""
    inner = np.zeros(true.shape, dtype=bool)
    inner[12:-12] = True
    seams = np.arange(true.shape[1]) % 12
    inner[:, (seams < 3) | (seams > 8)] = False
    off = surface.xyz_mm[..., 2] - LEVEL_MM - true
    return np.asarray(np.where(inner, off, np.nan))


def test_fine_relief_is_recovered_and_its_intervals_hold(
    bed: tuple[Floats, Surface], corrected: Surface
) -> None:
    """What the series leaves is halved; of some 8 x 136 independent heights 95 % hold to 4 %."""
    true, surface = bed
    moved = corrected
    assert "relief down to waves of" in moved.corrections[-1]
    raw, found = _errors(surface, true), _errors(moved, true)
    shift, _ = series_shifts(surface, SHEET, 0.0)
    xyz = surface.xyz_mm.copy()
    xyz[..., 2] -= shift
    series = _errors(replace(surface, xyz_mm=xyz), true)
    noise = 0.03**2
    left, without = (np.nanmean(error**2) - noise for error in (found, series))
    assert left < without / 2 < (np.nanmean(raw**2) - noise) / 2
    held = np.abs(found) <= 1.96 * moved.sigma_z_mm
    assert 0.90 <= held[np.isfinite(found)].mean() <= 0.99


def test_smooth_targets_are_left_to_the_series() -> None:
    generator = np.random.default_rng(7)
    y = ROW_MM * np.arange(120)[:, None] * np.ones(80)
    surface = scan(8 * np.cos(2 * np.pi * y / 150), 0.03, generator)
    moved = correct_thickness(surface, SHEET)
    shift, _ = series_shifts(surface, SHEET, 0.0)
    np.testing.assert_allclose(moved.xyz_mm[..., 2], surface.xyz_mm[..., 2] - shift, atol=1e-9)
    assert "relief" not in moved.corrections[-1]


def test_walls_and_gaps_keep_the_relief_apart(
    bed: tuple[Floats, Surface], corrected: Surface
) -> None:
    """A step of 30 mm and a gap change nothing 25 mm away from them, and leave finite sigmas."""
    _, surface = bed
    xyz = surface.xyz_mm.copy()
    xyz[80:, :, 2] += 30.0
    xyz[60:64] = np.nan
    status = np.where(np.isfinite(xyz[..., 2]), 0, 1)
    broken = replace(surface, xyz_mm=xyz, status=status.astype(np.int64))
    moved, whole = correct_thickness(broken, SHEET), corrected
    np.testing.assert_array_equal(np.isfinite(moved.xyz_mm[..., 2]), status == 0)
    assert np.isfinite(moved.sigma_z_mm[status == 0]).all()
    far = np.s_[:30, :, 2]
    change = np.abs(moved.xyz_mm[far] - whole.xyz_mm[far])
    assert np.sqrt(np.mean(change**2)) < np.sqrt(np.mean(whole.sigma_z_mm[:30] ** 2)) / 4


def test_neither_the_way_of_the_track_nor_a_mirrored_camera_matters(
    bed: tuple[Floats, Surface], corrected: Surface
) -> None:
    """The same points, last profile and last column first.

    Spectra are then taken of other segments: the heights differ by a tenth of their uncertainty.
    """
    _, surface = bed
    one = corrected
    other = correct_thickness(_picked(surface, np.s_[::-1], np.s_[::-1]), SHEET)
    assert "relief down to waves of" in other.corrections[-1]
    change = other.xyz_mm[::-1, ::-1, 2] - one.xyz_mm[..., 2]
    assert np.sqrt(np.mean(change**2)) < 0.1 * np.sqrt(np.mean(one.sigma_z_mm**2))


def test_profiles_beside_missing_ones_are_no_neighbours(bed: tuple[Floats, Surface]) -> None:
    """Twenty are missing: the others are corrected as at the end of a scan, half blind."""
    true, surface = bed
    kept = np.r_[:80, 100:160]
    errors = _errors(correct_thickness(_picked(surface, kept), SHEET), true[kept])
    beside, far = (np.sqrt(np.nanmean(errors[rows] ** 2)) for rows in (np.s_[74:86], np.s_[30:60]))
    assert beside < 1.5 * far


def _picked(surface: Surface, rows: slice | Ints, columns: slice = np.s_[:]) -> Surface:
    """Some of a scan's profiles and columns."""
    return replace(
        surface,
        xyz_mm=surface.xyz_mm[rows][:, columns],
        sigma_x_mm=surface.sigma_x_mm[rows][:, columns],
        sigma_z_mm=surface.sigma_z_mm[rows][:, columns],
        status=surface.status[rows][:, columns],
        position_mm=surface.position_mm[rows],
    )


@pytest.mark.parametrize("row_mm", [0.5, 2.0])
def test_a_sheet_far_thicker_than_a_profile_s_step(row_mm: float) -> None:
    """What a filter of 28 sigmas would need is not there: the heights stay finite."""
    generator = np.random.default_rng(9)
    rows = row_mm * np.arange(80)[:, None]
    x, y = np.broadcast_arrays(COLUMN_MM * np.arange(16.0), rows)
    z = LEVEL_MM + 0.3 * np.sin(y) + generator.normal(0.0, 0.03, y.shape)
    sigma, ok = np.full(y.shape, 0.03), np.zeros(y.shape, dtype=np.int64)
    surface = Surface(np.stack([x, y, z], axis=-1), 0 * sigma, sigma, ok, rows[:, 0])
    moved = correct_thickness(surface, SHEET.model_copy(update={"thickness_mm": 100.0}))
    assert np.isfinite(moved.xyz_mm).all() and np.isfinite(moved.sigma_z_mm).all()


@pytest.mark.slow  # smooth targets are left to the series above
def test_kinks_of_a_smooth_target_are_left_to_the_series() -> None:
    """A ridge no steeper than a slope may be has a wide spectrum, and no fine relief around it."""
    generator = np.random.default_rng(7)
    y = ROW_MM * np.arange(240)[:, None] * np.ones(80)
    ridge = 1.5 * np.maximum(10 - np.abs(y - y[30]), 0)
    surface = scan(8 * np.cos(2 * np.pi * y / 150) + ridge, 0.01, generator)
    moved = correct_thickness(surface, SHEET)
    shift, _ = series_shifts(surface, SHEET, 0.0)
    np.testing.assert_allclose(moved.xyz_mm[..., 2], surface.xyz_mm[..., 2] - shift, atol=1e-9)
    assert "relief" not in moved.corrections[-1]
