"""What is found in windows, on integers or by counting is what the whole picture gives."""

from typing import Any

import cv2
import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from lines_drawn import drawn, speckled
from scipy.ndimage import find_objects, label, maximum_filter1d

from lscan.config.plugins import installed
from lscan.config.rig import StripeSection
from lscan.records import Bytes, Floats, Mask, Stripe
from lscan.stripe import extract_stripe, find_extractor
from lscan.stripe.api import takes_integers
from lscan.stripe.peaks import (
    REACH_PX,
    crests,
    medians,
    order_statistic,
    relief_of,
    running_median,
    spots_of,
    windows,
)
from lscan.stripe.picture import ROUNDING_VARIANCE, constant_variance, robust_variance

HEIGHT, WIDTH = 260, 60
COLUMN = np.arange(WIDTH)
FEW = examples(25)


def picture(seed: int, middle: float, width_px: float, peak: float, others: int) -> Bytes:
    """A line, up to two more, specks and noise; the line may lie at the picture's edge."""
    generator = np.random.default_rng(seed)
    centre = middle + 6 * np.sin(COLUMN / generator.uniform(4, 30))
    light = drawn(centre, width_px, HEIGHT, peak)
    for _ in range(others):
        light = light + drawn(centre + generator.uniform(-90, 90), width_px, HEIGHT, peak / 2)
    for _ in range(8):
        light[generator.integers(HEIGHT), generator.integers(WIDTH)] += 120
    shown = speckled(light, 0.2, generator) + generator.normal(4, 1.5, light.shape)
    return np.clip(np.rint(shown), 0, 255).astype(np.uint8)


pictures = st.builds(
    picture,
    seed=st.integers(0, 2**31),
    middle=st.floats(-5, HEIGHT + 5),
    width_px=st.floats(0.7, 8.0),
    peak=st.floats(20, 400),
    others=st.integers(0, 2),
)


def spots_by_definition(columns: Bytes, threshold_dn: float, **ground: Any) -> list[tuple]:
    """Of whole columns, one by one: where the light exceeds half of what it is nearby."""
    relief = relief_of(columns, **ground)
    light, above = relief.smoothed - relief.ground, columns - relief.ground
    bright = (light > maximum_filter1d(light, 2 * REACH_PX + 1, axis=1) / 2) & (
        light > threshold_dn / 4
    )
    found = []
    closed = cv2.morphologyEx(bright.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((1, 3), np.uint8))
    for column, inside in enumerate(closed):
        number, _ = label(inside)
        for (rows,) in find_objects(number):
            over = above[column, rows]
            if over.max() > threshold_dn:
                found.append((column, rows.start, rows.stop - 1, over.sum(), over.max()))
    return found


@FEW
@given(
    image=pictures,
    threshold_dn=st.floats(3.0, 60.0),
    ground=st.sampled_from(
        [{}, {"ground_px": 21, "sharp": True}, {"ground_px": 61, "width_px": 9.0}]
    ),
)
def test_stretches_hold_the_spots_of_the_whole_picture(
    image: Bytes, threshold_dn: float, ground: dict[str, Any]
) -> None:
    columns = np.ascontiguousarray(image.T)
    found = np.array([*vars(spots_of(columns, threshold_dn, **ground)).values()]).T
    np.testing.assert_allclose(
        found, spots_by_definition(columns, threshold_dn, **ground), rtol=1e-5, atol=1e-3
    )


def test_without_a_bright_pixel_there_is_no_spot() -> None:
    assert len(spots_of(np.full((WIDTH, HEIGHT), 7, np.uint8), 15.0).column) == 0


@FEW
@given(image=pictures, rank=st.integers(0, HEIGHT - 1))
def test_ranks_are_those_of_sorted_columns(image: Bytes, rank: int) -> None:
    for kind in (np.uint8, np.int16, np.float64):
        columns = np.ascontiguousarray(image.T).astype(kind)
        assert (order_statistic(columns, rank) == np.sort(columns, axis=1)[:, rank]).all()
        for part in (columns, columns[:, 1:]):  # of an even number of pixels, and of an odd one
            assert (medians(part) == np.median(part, axis=1)).all()
        assert (crests(columns) == columns.argmax(axis=1)).all()
    columns[::3, 5] += 0.25  # no grey value: such columns are sorted, not counted
    assert (order_statistic(columns, rank) == np.sort(columns, axis=1)[:, rank]).all()


@FEW
@given(size=st.integers(0, 40), half=st.integers(0, 20), seed=st.integers(0, 2**32 - 1))
def test_a_running_median_is_that_of_sorted_neighbours_however_few(
    size: int, half: int, seed: int
) -> None:
    values = np.random.default_rng(seed).normal(size=size)
    around = np.arange(size)[:, None] + np.arange(-half, half + 1)
    expected = np.median(values[np.clip(around, 0, size - 1)], axis=1) if size else values
    assert running_median(values, 2 * half + 1) == pytest.approx(expected, abs=0)


@FEW
@given(image=pictures)
def test_integers_are_counted_as_floats_are_measured(image: Bytes) -> None:
    columns = np.ascontiguousarray(image.T)
    bends = np.diff(columns.astype(float), n=2, axis=1)
    measured = robust_variance(bends, 6 * ROUNDING_VARIANCE) / 6
    for kind in (columns, columns * 1.0, columns * 1.0 + 0.25):  # the last is measured
        assert constant_variance(kind) == pytest.approx(max(measured, ROUNDING_VARIANCE), 1e-12)


@FEW
@given(image=pictures, reach=st.integers(0, 40), seed=st.integers(0, 99))
def test_windows_repeat_the_pixels_at_the_edge(image: Bytes, reach: int, seed: int) -> None:
    columns, generator = np.ascontiguousarray(image.T), np.random.default_rng(seed)
    at, rows = generator.integers(0, WIDTH, 9), generator.integers(-9, HEIGHT + 9, 9)
    padded = np.pad(columns, ((0, 0), (99, 99)), mode="edge")
    expected = [
        padded[k, 99 + row - reach : 100 + row + reach] for k, row in zip(at, rows, strict=True)
    ]
    found = windows(columns, at, rows, reach)
    assert found.dtype == np.float64 and (found == expected).all()


@pytest.mark.parametrize("name", installed("lscan.extractors"))
def test_an_extractor_that_takes_integers_finds_the_same(name: str) -> None:
    extractor, section = find_extractor(name), StripeSection(threshold_dn=15.0)
    assert takes_integers(extractor)
    image = picture(3, 120.0, 1.8, 180.0, 0)
    columns, clipped = np.ascontiguousarray(image.T), np.zeros((WIDTH, HEIGHT), dtype=bool)
    whole, floats = (
        extractor(lines.T, section, clipped.T) for lines in (columns, columns.astype(float))
    )
    np.testing.assert_array_equal(whole.status, floats.status)
    np.testing.assert_allclose(whole.centre_px, floats.centre_px, rtol=0, atol=1e-9)
    np.testing.assert_allclose(whole.sigma_px, floats.sigma_px, rtol=1e-9)


def mean_row(image: Floats, settings: StripeSection, clipped: Mask) -> Stripe:
    """Another package's extractor: integers would overflow in its sum."""
    assert image.dtype == np.float64
    return find_extractor("centroid")(image, settings, clipped)


def test_other_extractors_are_given_floats() -> None:
    image = picture(4, 120.0, 1.8, 180.0, 0)
    stripe = extract_stripe(image, StripeSection(extractor=f"{__name__}:mean_row"))
    assert (stripe.status == 0).any()
