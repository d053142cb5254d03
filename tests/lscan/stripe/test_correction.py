"""The correction for blur along the line: closed forms, random curves, noise, gaps, bad input."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from scipy.ndimage import gaussian_filter

from lscan.config.rig import StripeSection
from lscan.errors import InputError
from lscan.records import Floats, Status, Stripe, has_value
from lscan.stripe.corrections import (
    FEWEST_COLUMNS,
    PIXEL_VARIANCE,
    REACH_PX,
    _derivatives,
    _shift,
    correct_blur,
    correction_gain,
    line_flux,
    smoothing_doubt,
)

COLUMNS, ROWS, FINE = 120, 96, 8
U = np.arange(COLUMNS, dtype=float)
Curve = Callable[[Floats], Floats]


def picture(centre: Curve, flux: Curve, blur_px: float, width_px: float = 0.9) -> Floats:
    """(COLUMNS, ROWS) light of a line: drawn FINE times as fine, blurred, then binned."""
    u = (np.arange(COLUMNS * FINE) + 0.5) / FINE - 0.5
    v = (np.arange(ROWS * FINE) + 0.5) / FINE - 0.5
    line = np.exp(-0.5 * ((v - centre(u)[:, None]) / width_px) ** 2) * flux(u)[:, None]
    blurred = gaussian_filter(line, blur_px * FINE, mode="nearest", truncate=6.0)
    return blurred.reshape(COLUMNS, FINE, ROWS, FINE).mean(axis=(1, 3))


def centroids(light: Floats, sigma_px: float = 1e-3) -> Stripe:
    total = light.sum(axis=1)
    centre = (light * np.arange(ROWS)).sum(axis=1) / total
    ones = np.ones(COLUMNS)
    return Stripe("columns", centre, sigma_px * ones, light.max(1), np.zeros(COLUMNS, dtype=int))


def errors(centre: Curve, flux: Curve, blur_px: float) -> tuple[Floats, Floats, Stripe]:
    """Error as found, error corrected, both away from the picture's sides; the stripe."""
    light = picture(centre, flux, blur_px)
    found = centroids(light)
    sharp = correct_blur(found, StripeSection(blur_px=blur_px), light)
    inner = slice(8, -8)
    truth = centre(U)
    return (found.centre_px - truth)[inner], (sharp.centre_px - truth)[inner], sharp


@examples(30)
@given(st.integers(0, 10_000))
def test_derivatives_are_those_of_least_squares(seed: int) -> None:
    """Column by column, by NumPy's own solver, with gaps and unknown values anywhere."""
    rng = np.random.default_rng(seed)
    values, sigma = rng.normal(100.0, 5.0, 40), rng.uniform(0.1, 8.0, 40)
    run = np.repeat(np.arange(4) - 1, 10)
    values[rng.random(40) < 0.2] = np.nan
    of, covariance = _derivatives(values, sigma, run)
    for column in range(40):
        near = np.arange(max(column - REACH_PX, 0), min(column + REACH_PX + 1, 40))
        near = near[(run[near] == run[column]) & (run[column] >= 0) & np.isfinite(values[near])]
        if len(near) < FEWEST_COLUMNS:
            assert np.isnan(of[column]).all()
            continue
        design = np.vander((near - column).astype(float), 3, increasing=True)
        fitted, squares, *_ = np.linalg.lstsq(design, values[near], rcond=None)
        variance = max(float(squares[0]) / max(len(near) - 3, 1), (sigma[near] ** 2).mean())
        inverse = np.linalg.inv(design.T @ design)
        np.testing.assert_allclose(of[column], fitted, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(covariance[column], inverse * variance, rtol=1e-8)


def test_a_parabola_is_displaced_by_half_the_variance_times_its_curvature() -> None:
    """And with even brightness that is all: the correction is exact."""
    curve = lambda u: 40 + 0.004 * (u - 60) ** 2  # noqa: E731
    raw, left, _ = errors(curve, np.ones_like, 1.5)
    # The derivation's own number; the picture is drawn in steps of 1/8 px, worth 1e-3.
    np.testing.assert_allclose(raw, (1.5**2 + PIXEL_VARIANCE) * 0.004, atol=1e-3)
    np.testing.assert_allclose(left, 0, atol=1e-3)


def test_a_sloping_line_of_exponential_brightness_is_displaced_by_their_product() -> None:
    raw, left, _ = errors(lambda u: 20 + 0.5 * u, lambda u: np.exp(0.05 * u), 1.2)
    np.testing.assert_allclose(raw, 0.5 * (1.2**2 + PIXEL_VARIANCE) * 0.05, atol=2e-3)
    # F'/F is that of a quadratic over 2 REACH_PX columns: off by (0.05 REACH_PX)² / 10 of it.
    assert np.abs(left).max() < 0.05 * np.abs(raw).max() + 1e-3


@given(
    st.floats(0.3, 1.5),
    st.floats(2.0, 9.0),
    st.floats(0.05, 0.15),
    st.floats(0.0, 0.5),
    st.floats(0.0, 6.0),
)
@examples(12)
def test_waves_of_uneven_brightness_come_back(
    blur_px: float, height: float, wave: float, contrast: float, phase: float
) -> None:
    """What is left is of the next order of the series in (s wave)²."""
    raw, left, _ = errors(
        lambda u: 48 + height * np.sin(wave * u),
        lambda u: 1 + contrast * np.sin(wave * u + phase),
        blur_px,
    )
    spread = blur_px**2 + PIXEL_VARIANCE
    # Derivatives over REACH_PX columns are short by their Taylor remainder, (wave reach)² / 6
    # at most; both factors of the product v' F'/F have it.
    order = wave**2 * spread + (wave * REACH_PX) ** 2 / 3
    largest = spread * height * wave**2 * (0.5 + contrast / (1 - contrast))
    assert np.abs(left).max() < order * largest + 2e-3
    if np.abs(raw).max() > 0.02:
        assert np.sqrt(np.mean(left**2)) < 0.5 * np.sqrt(np.mean(raw**2))


def test_nothing_changes_without_blur_or_without_a_line() -> None:
    light = picture(lambda u: 48 + 0 * u, np.ones_like, 0.7)
    found = centroids(light)
    assert correct_blur(found, StripeSection(), light) is found
    nothing = Stripe(
        "columns",
        np.full(COLUMNS, np.nan),
        np.full(COLUMNS, np.nan),
        np.zeros(COLUMNS),
        np.full(COLUMNS, int(Status.NO_PEAK)),
    )
    same = correct_blur(nothing, StripeSection(blur_px=0.7), light)
    np.testing.assert_array_equal(same.centre_px, nothing.centre_px)
    np.testing.assert_array_equal(same.status, nothing.status)


@given(st.floats(-20, 20), st.floats(0.1, 10))
@examples(10)
def test_shifted_lines_and_brighter_light_are_corrected_alike(by: float, gain: float) -> None:
    settings_ = StripeSection(blur_px=1.0)
    wave = lambda u: 48 + 5 * np.sin(0.1 * u)  # noqa: E731
    light = picture(wave, lambda u: 1.5 + np.cos(0.1 * u), 1.0)
    found = centroids(light)
    base = correct_blur(found, settings_, light)
    rolled = np.roll(light, round(by), axis=1) * gain
    moved = Stripe(
        "columns", found.centre_px + round(by), found.sigma_px, found.peak * gain, found.status
    )
    again = correct_blur(moved, settings_, rolled)
    np.testing.assert_allclose(again.centre_px - round(by), base.centre_px, atol=1e-9)
    np.testing.assert_allclose(again.sigma_px, base.sigma_px, rtol=1e-6)


def test_sigma_is_the_scatter_and_never_shrinks() -> None:
    """200 noisy copies of one line: their scatter is known to 1 / sqrt(400) = 5 %."""
    generator = np.random.default_rng(7)
    settings_ = StripeSection(blur_px=1.5)
    light = picture(lambda u: 30 + 0.4 * u, lambda u: np.exp(0.02 * u), 1.5)
    found = centroids(light, sigma_px=0.1)
    centres, sigmas = [], []
    for _ in range(200):
        noisy = Stripe(
            "columns",
            found.centre_px + generator.normal(0, 0.1, COLUMNS),
            found.sigma_px,
            found.peak,
            found.status,
        )
        factor = generator.gamma(50.0, 1 / 50.0, COLUMNS)[:, None]
        sharp = correct_blur(noisy, settings_, light * factor)
        centres.append(sharp.centre_px)
        sigmas.append(sharp.sigma_px)
        assert (sharp.sigma_px >= noisy.sigma_px).all()
    inner = slice(REACH_PX, -REACH_PX)
    scatter = np.std(centres, axis=0)[inner]
    stated = np.sqrt(np.mean(np.square(sigmas), axis=0))[inner]
    # The correction's noise is partly the centre's own, which the sum of variances counts as
    # independent: by half s² / (2 (REACH² + REACH) / 3) at most, 6 % of sigma here.
    assert np.all(np.abs(scatter / stated - 1) < 4 * 0.05 + 0.06)


def test_a_gap_and_a_jump_are_not_bridged() -> None:
    light = picture(lambda u: 40 + 0.004 * (u - 60) ** 2, lambda u: np.exp(0.02 * u), 1.0)
    found = centroids(light)
    status = found.status.copy()
    status[60:63] = int(Status.NO_PEAK)
    centre = np.where(status == Status.OK, found.centre_px, np.nan)
    sigma = np.where(status == Status.OK, found.sigma_px, np.nan)
    left_only = Stripe("columns", centre, sigma, found.peak, status)
    whole = correct_blur(left_only, StripeSection(blur_px=1.0), light)
    np.testing.assert_array_equal(np.isfinite(whole.centre_px), has_value(status))
    np.testing.assert_array_equal(np.isfinite(whole.sigma_px), has_value(status))
    changed = Stripe("columns", centre + 20.0 * (U > 60), sigma, found.peak, status)
    other = correct_blur(changed, StripeSection(blur_px=1.0), light)
    np.testing.assert_array_equal(other.centre_px[:60], whole.centre_px[:60])
    jumped = Stripe("columns", found.centre_px + 6.0 * (U > 60), sigma, found.peak, found.status)
    assert np.isfinite(correct_blur(jumped, StripeSection(blur_px=1.0), light).centre_px).all()
    shift = correct_blur(jumped, StripeSection(blur_px=1.0), light).centre_px - jumped.centre_px
    assert np.abs(shift).max() < 0.1  # bridged, the jump would bend the line by a pixel a column


def test_a_short_piece_keeps_its_place_and_says_so() -> None:
    light = picture(lambda u: 48 + 0 * u, np.ones_like, 0.8)
    found = centroids(light)
    status = np.full(COLUMNS, int(Status.NO_PEAK))
    status[50:53] = int(Status.OK)
    there = status == Status.OK
    short = Stripe(
        "columns",
        np.where(there, found.centre_px, np.nan),
        np.where(there, 0.1, np.nan),
        found.peak,
        status,
    )
    kept = correct_blur(short, StripeSection(blur_px=0.8), light)
    np.testing.assert_array_equal(kept.centre_px, short.centre_px)
    np.testing.assert_allclose(kept.sigma_px[there], np.hypot(0.1, 0.8))


def test_the_flux_is_the_lines_light_above_the_background() -> None:
    light = picture(lambda u: 40 + 0.1 * u, lambda u: 1 + 0.01 * u, 0.7)
    flux = line_flux(centroids(light), light + 17.0)
    expected = (1 + 0.01 * U) * 0.9 * np.sqrt(2 * np.pi)
    np.testing.assert_allclose(flux[8:-8], expected[8:-8], rtol=1e-3)


def test_light_of_another_length_is_refused() -> None:
    light = picture(lambda u: 48 + 0 * u, np.ones_like, 0.7)
    with pytest.raises(InputError, match=r"light: is not of the stripe's length.*\(120, L\)"):
        correct_blur(centroids(light), StripeSection(blur_px=0.7), light[:-1])


@pytest.mark.parametrize("columns", [6.0, 9.0, 20.0])
def test_the_correction_s_gain_is_what_it_makes_of_waves(columns: float) -> None:
    """Exactly, of an evenly bright line: the correction is linear then.  Of long waves it is the
    inverse of the blur, to w^4, which is 1e-12."""
    wave = 2 * np.pi / columns
    light = picture(lambda u: 48.0 + 0 * u, lambda u: 100.0 + 0 * u, 0.7)
    found = centroids(light)
    cosine = 0.2 * np.cos(wave * U)
    waving = replace(found, centre_px=found.centre_px + cosine)
    sharp = correct_blur(waving, StripeSection(blur_px=0.7), light)
    inner = slice(REACH_PX, -REACH_PX)
    shown = (sharp.centre_px - found.centre_px)[inner]
    np.testing.assert_allclose(shown, correction_gain(wave, 0.7) * cosine[inner], atol=1e-9)
    long = 1e-3
    inverse = 1 + (0.7**2 + PIXEL_VARIANCE) * long**2 / 2
    assert float(correction_gain(long, 0.7)) == pytest.approx(inverse, abs=1e-11)


def test_noise_alone_is_hardly_taken_for_bends() -> None:
    """What smoothing does to a straight line is nothing, however its centres scatter.

    Of one noisy part of a variance 1 the square less 1, where that is positive, is .48 on average
    (twice the normal density at 1); of several it is less.
    """
    rng = np.random.default_rng(4)
    light = picture(lambda u: 40 + 0.1 * u, lambda u: 0 * u + 100, 0.7)
    line = centroids(light)
    doubts, noise = [], []
    for _ in range(40):
        centre = line.centre_px + rng.normal(0, 0.05, COLUMNS)
        noisy = replace(line, centre_px=centre, sigma_px=np.full(COLUMNS, 0.05))
        doubts.append(smoothing_doubt(noisy, light, 2.0)[8:-8])
        noise.append(_shift(noisy, light, 2.0)[1][8:-8])
    assert np.mean(np.square(doubts)) < 0.5 * np.mean(np.square(noise))


def test_a_bend_is_doubted_by_what_smoothing_moves_it() -> None:
    bend, spread = 0.004, 2.0
    light = picture(lambda u: 40 + bend / 2 * (u - 60) ** 2, lambda u: 0 * u + 100, 0.7)
    doubt = smoothing_doubt(centroids(light), light, spread)[8:-8]
    np.testing.assert_allclose(doubt, spread * bend / 2, rtol=0.05)
