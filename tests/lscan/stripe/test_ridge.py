"""Steger's detector: closed forms, a correct sigma, invariances, and the ends of lines."""

from itertools import pairwise

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from lines_drawn import drawn, speckled

from lscan.config.rig import NoiseSection, StripeSection
from lscan.records import Status
from lscan.stripe import extract_stripe
from lscan.stripe.peaks import crests, line_width
from lscan.stripe.ridge import steger

HEIGHT, WIDTH = 90, 150
FEW = examples(12)
SLOPES = st.floats(-0.6, 0.6)


def sloping(slope, phase=0.0):
    return HEIGHT / 2 + phase + slope * (np.arange(WIDTH) - WIDTH / 2) / 2


def ridge_of(image, **changes):
    image = np.asarray(image, dtype=float)
    return steger(image, StripeSection(threshold_dn=15.0, **changes), image >= 255)


@FEW
@given(width_px=st.floats(0.8, 4.0), slope=SLOPES, phase=st.floats(-0.5, 0.5))
def test_a_straight_line_is_found_without_bias(width_px, slope, phase):
    # The pixels' raster leaves a ripple of exp(-2 pi² s²), s² the line's width squared and
    # the pixel's 1/12: 1e-4 at 0.8 px and a smaller part after smoothing.  The kernel ends at
    # 4 sigma, beyond which a Gaussian has 6e-5 of itself, and the columns near the ends are
    # smoothed alone: 0.01 px is the bar for the bias of an extractor.
    centre = sloping(slope, phase)
    stripe = ridge_of(drawn(centre, width_px, HEIGHT))
    assert (stripe.status == Status.OK).all()
    assert np.abs(stripe.centre_px - centre).max() <= 0.01


@pytest.mark.parametrize("curvature", [0.01, 0.02])
def test_a_bent_line_moves_inwards_by_the_smoothing(curvature):
    # Smoothing by s along a parabola of curvature k moves the crest by k s²/2 (the mean of
    # k t²/2 over the kernel), to second order in k s; s is the line's width as found.
    column = np.arange(WIDTH) - WIDTH / 2
    centre = 20 + curvature * column**2 / 2
    centre = centre[np.abs(column) < 20]
    image = drawn(centre, 1.2, HEIGHT)
    stripe, scale = ridge_of(image), line_width(image.T, np.arange(len(centre)), crests(image.T))
    middle = np.abs(column[np.abs(column) < 20]) < 5
    moved = (stripe.centre_px - centre)[middle]
    assert moved == pytest.approx(curvature * scale**2 / 2, rel=0.1)


def test_sigma_covers_what_smoothing_does_to_bent_and_unevenly_bright_lines():
    """30 lines with bends of up to 0.01 / px and light that changes by up to 2 % a column."""
    rng, within = np.random.default_rng(58), []
    columns = np.arange(500)
    for _ in range(30):
        turn, phase = 2 * np.pi / rng.uniform(150, 400), rng.uniform(0, 2 * np.pi, 2)
        centre = (
            60 + 0.1 * (columns - 250) * rng.uniform(-1, 1) + 6 * np.sin(turn * columns + phase[0])
        )
        height = rng.uniform(80, 160) * (1 + 0.2 * np.sin(2 * np.pi * columns / 60 + phase[1]))
        light = drawn(centre, rng.uniform(1.2, 3.0), 120, height)
        image = np.rint(rng.poisson(80 * light) / 80 + 10 + rng.normal(0, 1, light.shape))
        stripe = extract_stripe(image.astype(np.uint8), StripeSection(extractor="steger"))
        within.append(np.mean(np.abs(stripe.centre_px - centre) < 1.96 * stripe.sigma_px))
    # Lines differ by 0.02 to 0.05 among themselves, so that the mean is known to 0.01.
    assert 0.93 < np.mean(within) < 0.98, np.std(within)


@FEW
@given(
    width_px=st.floats(0.8, 3.0),
    slope=SLOPES,
    seed=st.integers(0, 2**31),
    kind=st.sampled_from(["read", "shot", "speckle"]),
)
def test_sigma_is_the_scatter_where_the_noise_is_known(width_px, slope, seed, kind):
    rng = np.random.default_rng(seed)
    centre = sloping(slope)
    light = drawn(centre, width_px, HEIGHT)
    if kind == "read":
        noise, image = NoiseSection(read_dn=2.0), light + rng.normal(0, 2, light.shape)
    elif kind == "shot":
        noise = NoiseSection(read_dn=0.3, dn_per_electron=0.5)
        image = rng.poisson(2 * light) / 2
    else:
        noise, image = NoiseSection(read_dn=1.5, speckle=0.2), speckled(light, 0.2, rng)
    stripe = ridge_of(image, noise=noise)
    pull = (stripe.centre_px - centre) / stripe.sigma_px
    # Neighbours share their noise over about 2 sqrt(pi) widths: so many independent values,
    # of which 99.9 % of chi-square/N lies within 3.3 deviations.  On top, 20 %: the noise is
    # taken at the nearest row and from the noisy light itself.
    chance = 3.3 * np.sqrt(2 * 2 * np.sqrt(np.pi) * max(width_px, 1.0) / WIDTH)
    assert np.mean(pull**2) == pytest.approx(1.0, abs=chance + 0.2)


def test_sigma_grows_with_the_noise_stated():
    image = speckled(drawn(sloping(0.2), 1.2, HEIGHT), 0.2, np.random.default_rng(1))
    stated = [
        NoiseSection(read_dn=1.0),
        NoiseSection(read_dn=2.0),
        NoiseSection(read_dn=2.0, dn_per_electron=0.5),
        NoiseSection(read_dn=2.0, dn_per_electron=0.5, speckle=0.2),
    ]
    sigmas = [ridge_of(image, noise=noise).sigma_px for noise in stated]
    for less, more in pairwise(sigmas):
        assert (more > less).all()


@FEW
@given(shift=st.integers(-8, 8), scale=st.floats(0.6, 2.0), offset=st.floats(-5, 50))
def test_shifted_scaled_and_offset_pictures_give_the_same_line(shift, scale, offset):
    # So flat that the 30 px about it, from which its width is found, stay in the picture.
    image = speckled(drawn(sloping(0.1), 1.2, HEIGHT), 0.2, np.random.default_rng(2))
    here = ridge_of(image)
    there = ridge_of(np.roll(image, shift, axis=0) * scale + offset)
    # Scale and offset differ by rounding only, a relative 1e-7 in single precision medians.
    np.testing.assert_allclose(there.centre_px, here.centre_px + shift, atol=1e-4)


def test_the_picture_upside_down_gives_the_line_upside_down():
    image = speckled(drawn(sloping(0.3), 1.2, HEIGHT), 0.2, np.random.default_rng(3))
    here, turned = ridge_of(image), ridge_of(image[::-1])
    np.testing.assert_allclose(turned.centre_px, HEIGHT - 1 - here.centre_px, atol=1e-4)
    mirrored = ridge_of(image[:, ::-1])
    np.testing.assert_allclose(mirrored.centre_px[::-1], here.centre_px, atol=1e-4)


@pytest.mark.parametrize("slope", [-0.6, 0.3, 0.6])
def test_the_ends_of_a_sloping_line_are_not_drawn_aside(slope):
    centre = sloping(slope)
    image = drawn(centre, 1.5, HEIGHT)
    image[:, :40] = image[:, 110:] = 0.0
    stripe = ridge_of(image)
    lit = np.arange(40, 110)
    assert (np.delete(stripe.status, lit) == Status.NO_PEAK).all()
    assert np.abs(stripe.centre_px - centre)[lit].max() <= 0.01


def test_statuses():
    dark = ridge_of(np.full((HEIGHT, WIDTH), 12.0))
    assert (dark.status == Status.NO_PEAK).all()
    assert np.isnan(dark.centre_px).all()
    assert np.isnan(dark.sigma_px).all()
    edge = ridge_of(drawn(np.full(WIDTH, 1.0), 1.5, HEIGHT))
    assert (edge.status == Status.AT_BORDER).all()
    assert np.isnan(edge.centre_px).all()
    bar = np.zeros((HEIGHT, WIDTH))
    bar[20:70, 50:54] = 100.0  # a line that runs along the columns
    within = ridge_of(bar)
    assert not np.isfinite(within.centre_px[:49]).any()


def test_a_clipped_crest_is_found_in_its_middle_and_says_so():
    centre = sloping(0.2)
    image = np.clip(np.rint(drawn(centre, 1.5, HEIGHT, amplitude=900.0)), 0, 255).astype(np.uint8)
    stripe = extract_stripe(image, StripeSection(extractor="steger"))
    assert (stripe.status == Status.SATURATED).all()
    # Clipped symmetrically but for the raster: the middle of the flat top is within half a px.
    assert np.abs(stripe.centre_px - centre).max() <= 0.5
    assert (np.abs(stripe.centre_px - centre) <= 4 * stripe.sigma_px).all()


@pytest.mark.parametrize("width_px", [0.8, 1.5, 3.0, 6.0])
def test_line_width_is_that_of_the_line(width_px):
    columns = drawn(sloping(0.2), width_px, HEIGHT).T
    found = line_width(columns, np.arange(WIDTH), crests(columns))
    # The pixel widens it by 1/12 px², laying brightest pixels over each other by as much again;
    # the half-height is interpolated linearly, off by at most an eighth of a pixel squared
    # times the bend of the flank, 0.6 / width: 10 % in all at 0.8 px.
    expected = np.sqrt(width_px**2 + 2 / 12)
    assert found == pytest.approx(expected, rel=0.1)


@pytest.mark.parametrize("lit", [0, 70, WIDTH - 1])
def test_a_line_one_column_long_has_no_ridge(lit):
    # Light in one column runs along it: there is nothing to cross.
    image = np.zeros((HEIGHT, WIDTH))
    image[:, lit] = drawn(sloping(0.0), 1.5, HEIGHT)[:, lit]
    stripe = ridge_of(image)
    assert (stripe.status == Status.NO_PEAK).all()


@pytest.mark.parametrize("shape", [(1, 1), (1, 30), (2, 2), (30, 1), (3, 3)])
def test_a_picture_of_next_to_no_size_is_read(shape):
    image = np.random.default_rng(1).integers(0, 256, shape).astype(np.uint8)
    stripe = extract_stripe(image, StripeSection(extractor="steger", threshold_dn=8.0))
    assert len(stripe.centre_px) == shape[1]
    assert np.isin(stripe.status, [Status.NO_PEAK, Status.AT_BORDER, Status.AMBIGUOUS]).all()


def test_sigma_is_the_noise_of_every_pixel_beside_a_sloping_line():
    """By changing one pixel after the other, on a line that leans by 45 degrees.

    A change turns the ridge as well, which moves its crossing by less than a twentieth of what
    it moves the ridge.
    """
    centre = HEIGHT / 2 + 0.3 + np.arange(-20.0, 21.0)
    noise = NoiseSection(read_dn=1.0, dn_per_electron=1e-9, speckle=0.0)
    image = drawn(centre, 1.5, HEIGHT, 200.0)

    def found(picture):
        return ridge_of(picture, noise=noise, line_width_px=2.355 * 1.5)

    moved = []
    for row in range(-14, 15):
        for column in range(-8, 9):
            shifts = []
            for change in (0.5, -0.5):
                changed = image.copy()
                changed[int(centre[20]) + row, 20 + column] += change
                shifts.append(found(changed).centre_px[20])
            moved.append(shifts[0] - shifts[1])
    expected = np.sqrt(np.square(moved).sum())
    assert found(image).sigma_px[20] == pytest.approx(expected, rel=0.05)
