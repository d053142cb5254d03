"""From picture to stripe: channel, axis, background, clipping, plug-ins, overlay, bad input."""

from dataclasses import replace
from inspect import signature

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st

from lscan.config.rig import StripeSection
from lscan.errors import InputError
from lscan.records import Status, Stripe, has_value
from lscan.stripe import draw_stripe, extract_stripe, find_extractor

NAMES = ["max", "centroid", "centroid-relative"]


def line_picture(seed=0, height=60, width=30, amplitude=150.0, line_width=1.2):
    """A grey uint8 picture of a curved Gaussian line without background, and its centres."""
    rng = np.random.default_rng(seed)
    centre = height / 2 + rng.uniform(-10, 10) + 3 * np.sin(np.arange(width) / 7)
    rows = np.arange(height)[:, None]
    light = amplitude * np.exp(-((rows - centre) ** 2) / (2 * line_width**2))
    return np.clip(np.rint(light), 0, 255).astype(np.uint8), centre


def same(first, second):
    return all(
        np.array_equal(getattr(first, name), getattr(second, name), equal_nan=True)
        for name in ("centre_px", "sigma_px", "peak", "status")
    )


@pytest.mark.parametrize("name", NAMES)
@examples(15)
@given(seed=st.integers(0, 2**32 - 1))
def test_rows_are_the_columns_of_the_transposed_picture(name, seed):
    image = np.random.default_rng(seed).integers(0, 256, (40, 25, 3), dtype=np.uint8)
    columns = extract_stripe(image, StripeSection(extractor=name, axis="columns"))
    turned = image.transpose(1, 0, 2)
    rows = extract_stripe(turned, StripeSection(extractor=name, axis="rows"))
    assert same(rows, columns)
    assert (columns.axis, rows.axis) == ("columns", "rows")
    np.testing.assert_array_equal(rows.image_px, columns.image_px[:, ::-1])


@pytest.mark.parametrize("name", NAMES)
@examples(15)
@given(seed=st.integers(0, 2**32 - 1))
def test_subtracting_the_background_gives_the_stripe_of_the_line_alone(name, seed):
    line, _ = line_picture(seed)
    background = np.random.default_rng(seed).integers(0, 100, line.shape, dtype=np.uint8)
    chosen = StripeSection(extractor=name)
    found = extract_stripe(line + background, chosen, background)
    alone = extract_stripe(line, chosen)
    # The background's edges make the line less certain, and move nothing.
    assert same(replace(found, sigma_px=alone.sigma_px), alone)
    assert (found.sigma_px >= alone.sigma_px)[has_value(alone.status)].all()


@pytest.mark.parametrize("channel", ["red", "green", "blue"])
def test_only_the_chosen_channel_counts(channel):
    line, _ = line_picture()
    image = np.random.default_rng(1).integers(0, 256, (*line.shape, 3), dtype=np.uint8)
    image[..., ["red", "green", "blue"].index(channel)] = line
    chosen = StripeSection(channel=channel)
    assert same(extract_stripe(image, chosen), extract_stripe(line, chosen))


def test_grey_weighs_the_colours():
    line, centre = line_picture()
    green = np.zeros((*line.shape, 3), dtype=np.uint8)
    green[..., 1] = line
    stripe = extract_stripe(green, StripeSection(channel="grey"))
    np.testing.assert_allclose(stripe.peak, 0.587 * line.max(axis=0), atol=0.5)
    # Within the half pixel of the nominal peak and half a pixel more of centroid.
    assert (np.abs(stripe.centre_px - centre) < 1).all()


# -- clipping -------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
@examples(25)
@given(
    seed=st.integers(0, 2**32 - 1),
    amplitude=st.floats(300, 20_000),
    line_width=st.floats(0.8, 3.0),
)
def test_a_flat_top_is_saturated_and_its_sigma_covers_the_truth(name, seed, amplitude, line_width):
    image, centre = line_picture(seed, amplitude=amplitude, line_width=line_width)
    clipped = image == 255
    flat = clipped.sum(axis=0)
    stripe = extract_stripe(image, StripeSection(extractor=name))
    lit = flat > 0
    assert (stripe.status[lit] == Status.SATURATED).all()
    assert (stripe.status[~lit] == Status.OK).all()
    # Symmetric light is clipped symmetrically: the truth is within half a pixel of the
    # middle of the flat top, whose half width (flat - 1) / 2 is sqrt(3) sigma of a uniform
    # distribution; the centre lies between its first pixel and half a pixel past the middle.
    reach = np.sqrt(3) * stripe.sigma_px + 0.5
    assert (np.abs(stripe.centre_px - centre)[lit] <= reach[lit] + 1e-9).all()


def test_clipping_is_judged_before_the_background_is_subtracted():
    line, _ = line_picture(amplitude=200.0)
    background = np.full_like(line, 100)
    image = np.clip(line.astype(int) + background, 0, 255).astype(np.uint8)
    stripe = extract_stripe(image, StripeSection(), background)
    assert stripe.peak.max() == 155
    assert (stripe.status == Status.SATURATED).all()


def test_a_lamp_that_is_clipped_in_both_pictures_is_not_the_lasers_doing():
    line = np.zeros((60, 9), dtype=np.uint8)
    line[29:32] = [[60], [150], [60]]
    background = np.zeros_like(line)
    background[32] = 255  # within the window of the line at row 30
    stripe = extract_stripe(np.maximum(line, background), StripeSection(), background)
    assert (stripe.status == Status.OK).all()
    alone = extract_stripe(line, StripeSection())
    assert same(replace(stripe, sigma_px=alone.sigma_px), alone)


def test_grey_is_clipped_where_any_colour_is():
    line, _ = line_picture(amplitude=400.0)
    image = np.zeros((*line.shape, 3), dtype=np.uint8)
    image[..., 0] = line  # grey of a full red is 76
    stripe = extract_stripe(image, StripeSection(channel="grey"))
    assert np.array_equal(stripe.status == Status.SATURATED, line.max(axis=0) == 255)
    assert has_value(stripe.status).all()


# -- plug-ins -------------------------------------------------------------------------


def middle_of_the_picture(image, settings, clipped):
    """A user's extractor: half way down, always."""
    height, width = image.shape
    centre = np.full(width, (height - 1) / 2)
    status = np.zeros(width, dtype=np.int64)
    return Stripe("columns", centre, np.full(width, 0.5), np.full(width, 100.0), status)


def one_column_short(image, settings, clipped):
    return middle_of_the_picture(image[:, 1:], settings, clipped)


def test_a_users_function_is_found_by_its_full_name():
    name = f"{__name__}:middle_of_the_picture"
    image = np.zeros((11, 5), dtype=np.uint8)
    stripe = extract_stripe(image, StripeSection(extractor=name, axis="rows"))
    assert stripe.axis == "rows"
    np.testing.assert_array_equal(stripe.centre_px, np.full(11, 2.0))


def test_the_papers_extractors_are_registered():
    assert {find_extractor(name).__name__ for name in NAMES} == {
        "maximum",
        "centroid",
        "centroid_relative",
    }


@pytest.mark.parametrize(
    "name",
    [*NAMES, "gaussian", "ml", "blais-rioux", "centroid-squared", "smoothed-peak", "steger"],
)
def test_every_extractor_has_an_extractors_signature(name):
    assert list(signature(find_extractor(name)).parameters) == ["image", "settings", "clipped"]


@pytest.mark.parametrize(
    "name",
    ["magic", "no.such.module:f", "lscan.stripe.rules:no_such", "numpy:pi", ":f", "a:"],
)
def test_an_unknown_extractor_is_refused_by_name(name):
    with pytest.raises(InputError, match="no such") as caught:
        extract_stripe(np.zeros((9, 9), np.uint8), StripeSection(extractor=name))
    assert repr(name) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_extractor_that_loses_columns_is_refused():
    name = f"{__name__}:one_column_short"
    with pytest.raises(InputError, match=r"wrong length \(got 4; allowed: 5\)"):
        extract_stripe(np.zeros((11, 5), np.uint8), StripeSection(extractor=name))


def spoilt(name, value):
    """An extractor that gives one column a bad value."""

    def extractor(image, settings, clipped):
        stripe = middle_of_the_picture(image, settings, clipped)
        getattr(stripe, name)[3] = value
        return stripe

    return extractor


def failing(image, settings, clipped):
    raise ValueError("two\nlines")


def scribbling(image, settings, clipped):
    image[:] = 0


lost = spoilt("centre_px", np.nan)
far = spoilt("centre_px", 11.0)
negative = spoilt("sigma_px", -0.1)
certain = spoilt("sigma_px", 0.0)
unsure = spoilt("sigma_px", np.nan)
strange = spoilt("status", 77)


@pytest.mark.parametrize(
    ("function", "message"),
    [
        ("lost", r"bad centre_px in column 3 \(got nan; allowed: -0\.5 to 10\.5\)"),
        ("far", r"bad centre_px in column 3 \(got 11\.0"),
        ("negative", r"bad sigma_px in column 3 \(got -0\.1; allowed: finite, above 0\)"),
        ("certain", r"bad sigma_px in column 3 \(got 0\.0"),
        ("unsure", r"bad sigma_px in column 3 \(got nan"),
        ("strange", r"bad status in column 3 \(got 77; allowed: 0 OK"),
        ("failing", r"failed: ValueError: two lines \(.*test_extract\.py line \d+\)$"),
        ("scribbling", r"failed: ValueError: .*read-only"),
    ],
)
def test_an_extractor_that_breaks_its_word_is_named(function, message):
    name = f"{__name__}:{function}"
    with pytest.raises(InputError, match=message) as caught:
        extract_stripe(np.zeros((11, 5), np.uint8), StripeSection(extractor=name))
    assert str(caught.value).startswith(f"extractor {name}: ")
    assert "\n" not in str(caught.value)


# -- bad input ------------------------------------------------------------------------


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((9, 9)),
        np.zeros((9, 9), np.int16),
        np.zeros((9, 9, 4), np.uint8),
        np.zeros((0, 9), np.uint8),
        np.zeros(9, np.uint8),
        None,  # as OpenCV gives it for a file that is not there
    ],
)
def test_what_is_no_picture_is_refused(image):
    with pytest.raises(InputError, match=r"image: is not a picture \(got '(u?\w+ \(|NoneType)"):
        extract_stripe(image, StripeSection())


def test_a_background_of_another_size_or_type_is_refused():
    image = np.zeros((9, 9), np.uint8)
    with pytest.raises(InputError, match=r"background: .* \(9, 8\); allowed: \(9, 9\)"):
        extract_stripe(image, StripeSection(), image[:, :8])
    with pytest.raises(InputError, match="background: is not a picture"):
        extract_stripe(image, StripeSection(), image.astype(float))


def test_the_callers_pictures_are_left_alone():
    image, _ = line_picture(amplitude=400.0)
    background = np.full_like(image, 9)
    kept = image.copy(), background.copy()
    extract_stripe(image, StripeSection(axis="rows"), background)
    np.testing.assert_array_equal(image, kept[0])
    np.testing.assert_array_equal(background, kept[1])


# -- overlay --------------------------------------------------------------------------


@pytest.mark.parametrize("axis", ["columns", "rows"])
def test_the_overlay_marks_each_centre_and_every_status(axis):
    status = np.array([Status.OK, Status.SATURATED, Status.NO_PEAK, Status.AT_BORDER])
    centre = np.array([7.4, 7.6, np.nan, np.nan])
    stripe = Stripe(axis, centre, np.ones(4), np.ones(4), status)
    image = np.full((12, 4), 50, dtype=np.uint8)
    image = image if axis == "columns" else image.T
    overlay = draw_stripe(image, stripe)
    assert overlay.shape == (*image.shape, 3)
    lines = overlay if axis == "columns" else overlay.transpose(1, 0, 2)
    assert tuple(lines[7, 0]) == (0, 255, 0)
    assert tuple(lines[8, 1]) == (255, 200, 0)
    assert (lines[4:, 2:] == 50).all()
    assert len({tuple(colour) for colour in lines[0]}) == 4
    assert (image == 50).all()


def test_an_overlay_of_another_size_is_refused():
    line, _ = line_picture()
    stripe = extract_stripe(line, StripeSection())
    with pytest.raises(InputError, match="not of the picture's size"):
        draw_stripe(line[:, 1:], stripe)


@pytest.mark.parametrize("width_px", [1.1, 3.0, 7.6, 10.0])
@pytest.mark.parametrize("times", [4, 16])
@pytest.mark.parametrize("name", [*NAMES, "ml"])
def test_a_clipped_line_is_in_the_middle_of_its_crest(name, times, width_px):
    """The first of its equal values is 1.3 to 26 px above it, in every column alike."""
    rows, bias = np.arange(130)[:, None], []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        centre = 60 + rng.uniform(-0.5, 0.5) + 0.01 * np.arange(200)
        light = 230 * times * np.exp(-((rows - centre) ** 2) / (2 * width_px**2)) + 8
        image = np.clip(np.rint(light + rng.normal(0, 1, light.shape)), 0, 255).astype(np.uint8)
        section = StripeSection(extractor=name, channel="grey", threshold_dn=15.0)
        found = extract_stripe(image, section)
        assert (found.status == Status.SATURATED).all()
        bias.append(np.mean(found.centre_px - centre))
    # A middle is known to half a pixel, of a slanted line as often above it as below.
    assert abs(np.mean(bias)) < 0.02
