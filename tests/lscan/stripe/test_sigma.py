"""The stated uncertainty of the stripe against the scatter that noise really causes."""

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from lines_drawn import drawn
from scipy.ndimage import gaussian_filter
from scipy.stats import norm

from lscan.config.rig import NoiseSection, StripeSection
from lscan.stripe import extract_stripe, picture as noise, rules
from lscan.stripe.loops.centre import CENTROID, RELATIVE, _centroid

HEIGHT, WIDTH = 480, 640


DEFAULT = StripeSection()


def run(extract, image, section=DEFAULT):
    """The extractor's stripe of a picture in which nothing is clipped."""
    return extract(image, section, np.zeros(image.shape, dtype=bool))


def gaussian_picture(rng, line_width, amplitude):
    """A slightly sloping line at a random place: centres (W,) and noise-free picture."""
    centre = 240 + rng.uniform(-1, 1) + np.linspace(0, 9, WIDTH)
    rows = np.arange(HEIGHT)[:, None]
    low, high = ((rows + half - centre) / line_width for half in (-0.5, 0.5))
    light = amplitude * line_width * np.sqrt(2 * np.pi) * (norm.cdf(high) - norm.cdf(low))
    return centre, light


def pulls(extract, section, line_width, add_noise, pictures, seed):
    """(error / stated sigma) of every column of several noisy pictures."""
    rng = np.random.default_rng(seed)
    result = []
    for _ in range(pictures):
        centre, light = gaussian_picture(rng, line_width, amplitude=150.0)
        stripe = run(extract, add_noise(rng, light), section)
        result.append((stripe.centre_px - centre) / stripe.sigma_px)
    pull = np.concatenate(result)
    assert np.isfinite(pull).all()
    return pull


def reading_noise(rng, light):
    return np.rint(light + 30 + rng.normal(0, 2, light.shape)) - 30


def photon_noise(rng, light):
    """Two electrons for each digital number, and 1 DN of reading noise."""
    return rng.poisson(2 * light) / 2 + rng.normal(0, 1, light.shape)


@pytest.mark.parametrize("add_noise", [reading_noise, photon_noise])
def test_sigma_of_the_centroid_is_the_scatter_where_the_window_holds_the_line(add_noise):
    span, line_width = 8, 0.8  # the line ends 10 widths from the middle: nothing is cut off
    pull = pulls(rules.centroid, StripeSection(span_px=span), line_width, add_noise, 10, seed=1)
    mean_square = (pull**2).mean()
    # 99.9 % of chi-square/N lies within 3.3 of its standard deviations.
    chance = 3.3 * np.sqrt(2 / len(pull))
    # Stated on top of the noise, hence allowed downwards: the choice of the nominal peak,
    # whose two windows differ by one noisy pixel at either end, 2 (span + 1)² / 12 against
    # n (n² - 1) / 12 of the noise, four times that in the tenth of columns with two
    # candidates; and second differences on the line that look like noise, on at most the 8.4
    # rows within 4 widths and a pixel of the crest, each at most 3² of the noise.
    n = 2 * span + 1
    choice = 1.3 * 2 * (span + 1) ** 2 / (n * (n**2 - 1))
    mistaken = 8.4 / HEIGHT * (3**2 - 1)
    assert (1 - chance) / (1 + choice + mistaken) <= mean_square <= 1 + chance


@pytest.mark.parametrize(
    ("extract", "span", "line_width"),
    [
        *(
            (rules.centroid, span, width)
            for span, width in ((2, 0.6), (2, 1.4), (4, 1.0), (4, 2.0))
        ),
        (rules.maximum, 2, 1.0),
        (rules.maximum, 4, 2.0),
        (rules.centroid_relative, 2, 2.0),
        (rules.centroid_relative, 4, 0.6),
    ],
)
def test_two_sigma_cover_the_truth_where_the_window_cuts_the_line(extract, span, line_width):
    # The centroid is then biased by up to a few tenths of a pixel, with the sign of the
    # line's place within its pixel.  Coverage factor 2 is meant to hold 95 % (GUM 6.3.3).
    pull = pulls(extract, StripeSection(span_px=span), line_width, reading_noise, 3, seed=2)
    assert (np.abs(pull) <= 2).mean() >= 0.95


@pytest.mark.parametrize("extract", [rules.centroid, rules.centroid_relative])
@examples(30)
@given(values=st.permutations([20.0, 60.0, 110.0, 140.0]))
def test_noise_is_carried_through_the_derivative_of_the_centre(extract, values):
    # A single column, without neighbours to scatter against, has the noise of rounding only.
    column = np.zeros((21, 1))
    column[8:13, 0] = [*values[:2], 200.0, *values[2:]]
    step = 1e-4
    derivative = []
    for row in range(8, 13):
        high, low = column.copy(), column.copy()
        high[row] += step
        low[row] -= step
        ends = [run(extract, picture).centre_px[0] for picture in (high, low)]
        derivative.append((ends[0] - ends[1]) / (2 * step))
    noise_only = noise.ROUNDING_VARIANCE * np.square(derivative).sum()
    slope = np.empty(5)
    _centroid(
        column[8:13, 0],
        {rules.centroid: CENTROID, rules.centroid_relative: RELATIVE}[extract],
        slope,
    )
    # Central differences of a ratio of sums near 500 DN err by about (1e-4 / 500)² and by
    # rounding, 1e-14 / 1e-4.
    np.testing.assert_allclose(slope, derivative, atol=1e-9)
    assert run(extract, column).sigma_px[0] ** 2 >= noise_only * (1 - 1e-6)


@pytest.mark.parametrize("name", ["gaussian", "blais_rioux", "smoothed_peak", "centroid_squared"])
def test_sigma_is_the_noise_of_every_pixel_that_a_rule_heeds(name):
    """Column k, of as many as there are rows, has its row k brighter, then darker, by 0.01 DN.

    The line lies in the middle of a pixel, where no rule errs, on a slope that each takes off.
    To 0.5 %: the rules' derivatives are taken at a fitted line.  Without those by the ground's
    slope, sigma would be 2 % less.
    """
    extract, step, read_dn, size = getattr(rules, name), 0.01, 1.0, 60
    column = drawn(np.array([30.0]), 1.5, size, 150.0) + 20 + 0.4 * np.arange(size)[:, None]
    section = StripeSection(threshold_dn=10.0, noise=NoiseSection(read_dn=read_dn))
    stripe, brighter, darker = (
        run(extract, column + change * np.eye(size), section) for change in (0.0, step, -step)
    )
    derivative = (brighter.centre_px - darker.centre_px) / (2 * step)
    expected = read_dn * np.linalg.norm(derivative)
    np.testing.assert_allclose(stripe.sigma_px, expected, rtol=0.005)


def test_sigma_of_the_brightest_pixel_is_that_of_rounding():
    rng = np.random.default_rng(3)
    _, light = gaussian_picture(rng, 0.8, 150.0)
    stripe = run(rules.maximum, light)
    # A pixel is 1 px wide; two equally bright ones (within the rounding of grey values) are 2.
    doubtful = stripe.sigma_px > 1.5 / np.sqrt(12)
    np.testing.assert_allclose(stripe.sigma_px[~doubtful], 1 / np.sqrt(12), rtol=1e-12)
    np.testing.assert_allclose(stripe.sigma_px[doubtful], 2 / np.sqrt(12), rtol=1e-12)
    # d(peak)/d(place) is about 0.5 A / w² per pixel at the edge between two: 120 DN/px, and
    # two sigma of rounding are 0.58 DN, so less than 2 · 0.58 / 120 of the columns.
    assert doubtful.mean() < 0.01


@pytest.mark.parametrize("sigma", [1.0, 2.0, 5.0])
def test_constant_variance_finds_the_noise_beside_a_line_and_on_a_slope(sigma):
    rng = np.random.default_rng(4)
    _, light = gaussian_picture(rng, 1.0, 150.0)
    slope = np.linspace(20, 60, HEIGHT)[:, None]
    picture = np.rint(light + slope + rng.normal(0, sigma, light.shape))
    found = noise.constant_variance(np.ascontiguousarray(picture.T))
    # Second differences of independent pixels are correlated by -2/3 and 1/6, which makes
    # the relative variance of their mean square 2 (1 + 2 · 4/9 + 2/36) / N.
    chance = 3.3 * np.sqrt(2 * 1.94 / (64 * (HEIGHT - 2)))
    mistaken = 10 / HEIGHT * (3**2 - 1)  # as above, for a line of 1 px
    expected = sigma**2 + 1 / 12
    assert expected * (1 - chance) <= found <= expected * (1 + chance + mistaken)


def test_constant_variance_is_never_below_rounding():
    assert noise.constant_variance(np.full((10, 20), 7.0)) == pytest.approx(1 / 12)
    assert noise.constant_variance(np.full((10, 2), 7.0)) == pytest.approx(1 / 12)


def test_line_variance_is_that_of_photons():
    rng = np.random.default_rng(5)
    mean = np.array([20.0, 80.0, 150.0, 80.0, 20.0])
    electrons_per_dn = 2.0
    light = rng.poisson(electrons_per_dn * mean, (20_000, 5)) / electrons_per_dn
    light += rng.normal(0, 1.5, light.shape)
    found = noise.line_variance_per_dn(light, np.arange(20_000), constant=1.5**2)
    # As above for 20,000 sums, whose variance is 5 · 1.5² reading noise on 350 / 2.
    chance = 3.3 * np.sqrt(2 * 1.94 / 20_000) * (1 + 5 * 1.5**2 / 175)
    assert found == pytest.approx(1 / electrons_per_dn, rel=chance)


def test_line_variance_needs_neighbouring_columns():
    rng = np.random.default_rng(6)
    light = rng.uniform(50, 150, (40, 5))
    assert noise.line_variance_per_dn(light, np.arange(0, 80, 2), constant=0.1) == 0
    assert noise.line_variance_per_dn(light[:10], np.arange(10), constant=0.1) == 0
    assert noise.line_variance_per_dn(light, np.arange(40), constant=0.1) > 0
    dark = light - 2 * np.median(light)  # as where a brighter background was taken off
    assert noise.line_variance_per_dn(dark, np.arange(40), constant=0.1) == 0


@pytest.mark.parametrize("slope", [-2.0, 1.0])
@pytest.mark.parametrize("name", ["centroid-relative", "ml", "steger"])
def test_sigma_covers_what_blur_does_to_the_end_of_a_sloping_line(name: str, slope: float) -> None:
    """The last columns hold the last lit column's light, at its height: off by slope times them."""
    fine, blur_px = 4, 0.8
    place = (np.arange(300 * fine) + 0.5) / fine - 0.5
    row, column = place[:, None], place[: 160 * fine]
    centre = 150 + slope * (column - 80)
    light = (column <= 110.6) * np.exp(-((row - centre) ** 2) / (1 + slope**2))
    seen = gaussian_filter(light, blur_px * fine).reshape(300, fine, 160, fine).mean(axis=(1, 3))
    noise = np.random.default_rng(1).normal(8, 1, seen.shape)
    image = np.rint(160 * seen / seen.max() + noise).astype(np.uint8)
    stripe = extract_stripe(image, StripeSection(extractor=name, threshold_dn=20.0))
    pull = np.abs(stripe.centre_px - 150 - slope * (np.arange(160) - 80)) / stripe.sigma_px
    assert np.isfinite(pull[20:111]).all()
    assert pull[105:][np.isfinite(pull[105:])].max() < 3
    assert np.median(stripe.sigma_px[40:90]) < 0.2
