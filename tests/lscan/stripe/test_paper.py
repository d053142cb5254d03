"""The paper's three extractors: published numbers, invariances, and bounds against the truth."""

from fractions import Fraction

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import assume, given, strategies as st
from scipy.stats import norm

from lscan.config.rig import StripeSection
from lscan.records import Status, has_value
from lscan.stripe import rules

ALL = [rules.maximum, rules.centroid, rules.centroid_relative]
CENTROIDS = [rules.centroid, rules.centroid_relative]
ROUNDING = 1e-9  # float64 sums of a few hundred terms about pixel coordinates below 1000

# Sec. V.B: first pixel and the five grey values about the nominal peak, frames 1 to 3.
FRAMES = {
    1: (251, [142, 245, 255, 176, 120]),
    2: (251, [138, 233, 255, 186, 119]),
    3: (250, [126, 157, 255, 255, 168]),
}


DEFAULT = StripeSection()


def run(extract, image, section=DEFAULT):
    """The extractor's stripe of a picture in which nothing is clipped."""
    return extract(image, section, np.zeros(image.shape, dtype=bool))


def gaussian_line(centre, width, amplitude=150.0, height=80):
    """(height, W) picture of a Gaussian line, each pixel the mean of the light upon it."""
    rows = np.arange(height)[:, None]
    low, high = ((rows + half - np.atleast_1d(centre)) / width for half in (-0.5, 0.5))
    return amplitude * width * np.sqrt(2 * np.pi) * (norm.cdf(high) - norm.cdf(low))


def column_of(first, values, height=480):
    column = np.zeros((height, 1))
    column[first : first + len(values), 0] = values
    return column


def equation_8(first, values):
    """Eq. (8) in exact arithmetic."""
    moment = sum(Fraction(value) * (first + i) for i, value in enumerate(values))
    return float(moment / sum(values))


def pictures(seed, columns=8, height=80, ground=30):
    """A whole-numbered picture: rough ground in 0..ground and a bright line in the middle."""
    rng = np.random.default_rng(seed)
    centre = rng.uniform(30, 50, columns)
    line = gaussian_line(centre, rng.uniform(0.6, 3.0), rng.uniform(90, 200), height)
    return np.rint(rng.integers(0, ground + 1, (height, columns)) + line)


# -- published values --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("frame", "raw", "relative"), [(1, 252.8795, 252.6657), (2, 252.9087, 252.7470)]
)
def test_equation_8_gives_the_printed_results_of_frames_1_and_2(frame, raw, relative):
    image = column_of(*FRAMES[frame])
    printed = 0.5e-4  # four decimals
    assert run(rules.centroid, image).centre_px[0] == pytest.approx(raw, abs=printed)
    found = run(rules.centroid_relative, image).centre_px[0]
    assert found == pytest.approx(relative, abs=printed)


def test_frame_3_follows_from_its_printed_pixels_not_from_its_printed_results():
    # The paper prints 252.2313 and 252.6909 for frame 3; its own pixels in its own equation
    # give 252.1894 and 252.5498.  The arithmetic is what can be tested.
    first, values = FRAMES[3]
    least = min(values)
    raw = run(rules.centroid, column_of(first, values)).centre_px[0]
    relative = run(rules.centroid_relative, column_of(first, values)).centre_px[0]
    assert raw == pytest.approx(equation_8(first, values), abs=ROUNDING)
    assert relative == pytest.approx(
        equation_8(first, [value - least for value in values]), abs=ROUNDING
    )
    assert (round(raw, 4), round(relative, 4)) == (252.1894, 252.5498)


@pytest.mark.parametrize(("frame", "peak"), [(1, 253), (2, 253), (3, 252)])
def test_nominal_peak_is_the_underlined_pixel(frame, peak):
    stripe = run(rules.maximum, column_of(*FRAMES[frame]))
    assert stripe.centre_px[0] == peak
    assert stripe.peak[0] == 255  # above a black ground


# -- invariances ------------------------------------------------------------------------


@pytest.mark.parametrize("extract", ALL)
@examples(30)
@given(seed=st.integers(0, 2**32 - 1), shift=st.integers(-15, 15))
def test_a_shift_by_whole_pixels_shifts_the_line(extract, seed, shift):
    image = pictures(seed)
    before = run(extract, image)
    after = run(extract, np.roll(image, shift, axis=0))
    assert np.array_equal(before.status, after.status)
    np.testing.assert_allclose(after.centre_px, before.centre_px + shift, atol=ROUNDING)


@pytest.mark.parametrize("extract", ALL)
@examples(30)
@given(seed=st.integers(0, 2**32 - 1), gain=st.floats(0.1, 5.0))
def test_gain_does_not_move_the_line(extract, seed, gain):
    image = pictures(seed)
    before = run(extract, image, StripeSection(threshold_dn=20))
    after = run(extract, gain * image, StripeSection(threshold_dn=20 * gain))
    np.testing.assert_allclose(after.centre_px, before.centre_px, atol=ROUNDING)


@pytest.mark.parametrize("extract", [rules.maximum, rules.centroid_relative])
@examples(30)
@given(seed=st.integers(0, 2**32 - 1), offset=st.integers(-100, 100))
def test_an_even_background_does_not_move_the_relative_line(extract, seed, offset):
    image = pictures(seed)
    before, after = (run(extract, picture) for picture in (image, image + offset))
    np.testing.assert_allclose(after.centre_px, before.centre_px, atol=ROUNDING)
    np.testing.assert_allclose(after.sigma_px, before.sigma_px, rtol=1e-6)
    np.testing.assert_allclose(after.peak, before.peak, atol=ROUNDING)


def test_an_even_background_draws_the_raw_centroid_to_the_nominal_peak():
    image = gaussian_line(40.4, 1.0)
    bare, veiled = (run(rules.centroid, image + veil) for veil in (0, 60))
    assert 40 < veiled.centre_px[0] < bare.centre_px[0]


@pytest.mark.parametrize("extract", ALL)
@examples(30)
@given(seed=st.integers(0, 2**32 - 1))
def test_upside_down_is_mirrored_where_the_maximum_is_single(extract, seed):
    image = pictures(seed)
    image = image + np.random.default_rng(seed).uniform(0, 0.5, image.shape)  # no two equal
    upright, flipped = (run(extract, picture) for picture in (image, image[::-1]))
    np.testing.assert_allclose(flipped.centre_px, 79 - upright.centre_px, atol=ROUNDING)
    np.testing.assert_allclose(flipped.sigma_px, upright.sigma_px, rtol=1e-6)


@examples(30)
@given(first=st.integers(3, 60), equal=st.integers(2, 10))
def test_of_equal_maxima_the_first_from_the_top_is_the_peak(first, equal):
    image = column_of(first, [200] * equal, height=80)
    assert run(rules.maximum, image).centre_px[0] == first


def test_two_equal_lines_give_the_upper_one():
    image = gaussian_line(20.0, 1.0) + gaussian_line(60.0, 1.0)
    for extract in ALL:
        assert run(extract, image).centre_px[0] == pytest.approx(20.0, abs=1e-6)


# -- error bound against the truth --------------------------------------------------------


def bias_bound(centre, width, span, relative):
    """Largest error in px of eq. (8) for a noise-free, pixel-integrated Gaussian line.

    Let d = |centre - nominal peak| <= 1/2 and g the unit Gaussian of the line's width.
    1. Over all pixels the centroid is the centre but for aliasing.  By Poisson's sum formula
       that is the derivative of exp(-w²W²/2) sinc(W/2) at W = 2 pi k, summed over k != 0: at
       most sum of exp(-2 pi² w² k²) / (pi k).
    2. The window lacks the tails beyond span + 1/2 from the peak.  A pixel's moment is at
       most the integral of (y + 1/2) g, so the nearer tail lacks at most
       w phi(a/w) + Q(a/w) / 2 with a = span + 1/2 - d; the farther takes off less, with the
       opposite sign.
    3. Taking off the least value m (that of the far end, span + d away) takes (2 span + 1) m
       from the sum and (2 span + 1) m d from the moment about the centre.
    """
    d = np.abs(centre - np.rint(centre))
    k = np.arange(1, 20)
    aliasing = (np.exp(-2 * (np.pi * width * k) ** 2) / (np.pi * k)).sum()
    near, far = (span + 0.5 - d) / width, (span + 0.5 + d) / width
    moment = aliasing + width * norm.pdf(near) + norm.sf(near) / 2
    lost = norm.sf(near) + norm.sf(far)
    if relative:
        least = norm.sf((span + d - 0.5) / width) - norm.sf((span + d + 0.5) / width)
        moment += (2 * span + 1) * least * d
        lost = lost + (2 * span + 1) * least
    return moment / (1 - lost)


@pytest.mark.parametrize("extract", CENTROIDS)
@examples(60)
@given(
    centre=st.floats(30, 50),
    width=st.floats(0.4, 1.5),
    span=st.integers(2, 12),
)
def test_noise_free_error_is_within_the_truncation_bound(extract, centre, width, span):
    assume(abs(centre % 1 - 0.5) > 1e-6)  # the nominal peak is the nearest pixel
    stripe = run(extract, gaussian_line(centre, width), StripeSection(span_px=span))
    bound = bias_bound(centre, width, span, extract is rules.centroid_relative)
    assert abs(stripe.centre_px[0] - centre) <= bound + ROUNDING


@pytest.mark.parametrize("extract", CENTROIDS)
def test_the_bias_vanishes_with_a_large_span(extract):
    centre = np.linspace(39.51, 40.49, 99)
    stripe = run(extract, gaussian_line(centre, 1.5), StripeSection(span_px=15))
    # At 10 widths the tails hold 1e-23; what remains is aliasing, exp(-44) / pi.
    np.testing.assert_allclose(stripe.centre_px, centre, atol=ROUNDING)


@examples(40)
@given(centre=st.floats(30, 49), shift=st.floats(0, 1), width=st.floats(0.5, 1.2))
def test_a_shift_by_part_of_a_pixel_shifts_the_line_within_the_bounds(centre, shift, width):
    places = np.array([centre, centre + shift])
    assume((np.abs(places % 1 - 0.5) > 1e-6).all())
    stripe = run(rules.centroid_relative, gaussian_line(places, width), StripeSection(span_px=3))
    bounds = bias_bound(places, width, 3, relative=True)
    moved = stripe.centre_px[1] - stripe.centre_px[0]
    assert abs(moved - shift) <= bounds.sum() + ROUNDING


@examples(40)
@given(centre=st.floats(30, 50), width=st.floats(0.5, 3.0))
def test_the_brightest_pixel_is_within_half_a_pixel(centre, width):
    stripe = run(rules.maximum, gaussian_line(centre, width))
    assert abs(stripe.centre_px[0] - centre) <= 0.5 + ROUNDING


# -- columns without a line, and lines at the border ------------------------------------


@pytest.mark.parametrize("extract", ALL)
@examples(20)
@given(seed=st.integers(0, 2**32 - 1), threshold=st.integers(1, 100))
def test_nothing_above_the_threshold_is_no_peak(extract, seed, threshold):
    rng = np.random.default_rng(seed)
    # No value can exceed the median by more than the range of all values.
    image = rng.integers(20, 20 + threshold + 1, (60, 9)).astype(float)
    stripe = run(extract, image, StripeSection(threshold_dn=threshold))
    assert (stripe.status == Status.NO_PEAK).all()
    assert np.isnan(stripe.centre_px).all()
    assert np.isnan(stripe.sigma_px).all()


@pytest.mark.parametrize("extract", ALL)
def test_the_peak_must_exceed_the_columns_median_by_more_than_the_threshold(extract):
    image = np.full((20, 3), 25.0)
    image[10] = 25.0 + np.array([39, 40, 41])
    stripe = run(extract, image, StripeSection(threshold_dn=40))
    np.testing.assert_array_equal(stripe.status, [Status.NO_PEAK, Status.NO_PEAK, Status.OK])
    np.testing.assert_array_equal(stripe.peak, [39, 40, 41])


@pytest.mark.parametrize("extract", ALL)
@pytest.mark.parametrize("span", [1, 2, 5])
def test_a_window_cut_by_the_border_has_no_value(extract, span):
    height = 40
    image = np.zeros((height, height))
    np.fill_diagonal(image, 200.0)  # column i has its peak in row i
    stripe = run(extract, image, StripeSection(span_px=span))
    fits = (np.arange(height) >= span) & (np.arange(height) < height - span)
    assert (stripe.status[fits] == Status.OK).all()
    assert (stripe.status[~fits] == Status.AT_BORDER).all()
    assert np.array_equal(np.isnan(stripe.centre_px), ~fits)


@pytest.mark.parametrize("extract", ALL)
@examples(40)
@given(seed=st.integers(0, 2**32 - 1), span=st.integers(1, 30))
def test_any_picture_gives_values_exactly_where_the_status_says_so(extract, seed, span):
    rng = np.random.default_rng(seed)
    shape = tuple(rng.integers(1, 50, 2))
    image = rng.integers(-200, 256, shape).astype(float)  # a background may have been taken off
    stripe = run(extract, image, StripeSection(span_px=span))
    valued = has_value(stripe.status)
    assert np.array_equal(np.isfinite(stripe.centre_px), valued)
    assert np.array_equal(np.isfinite(stripe.sigma_px), valued)
    assert (stripe.sigma_px[valued] > 0).all()
    peak_row = image.argmax(axis=0)
    assert (np.abs(stripe.centre_px - peak_row)[valued] <= span).all()
