"""The line in a part of the picture, and two lines told apart."""

import numpy as np
import pytest

from lscan.config.rig import StripeSection
from lscan.errors import InputError
from lscan.records import Axis, Bytes, Floats, Status, has_value
from lscan.stripe import extract_stripe
from lscan.stripe.extract import extract_within, told_apart

HEIGHT, WIDTH = 120, 160
SIGMA_PX, NOISE_DN = 1.5, 1.0


def drawn(*lines: tuple[Floats, float], seed: int = 1) -> Bytes:
    """(H, W, 3) red Gaussian lines, each of its v in every column and its height in DN."""
    v = np.arange(HEIGHT)[:, None]
    light = np.full((HEIGHT, WIDTH), 20.0)
    for centre, height in lines:
        light += height * np.exp(-((v - centre) ** 2) / (2 * SIGMA_PX**2))
    light += np.random.default_rng(seed).normal(0, NOISE_DN, light.shape)
    return np.repeat(np.clip(np.rint(light), 0, 255).astype(np.uint8)[:, :, None], 3, axis=2)


def level(v: float) -> Floats:
    return np.full(WIDTH, v)


def turned(image: Bytes, axis: Axis) -> Bytes:
    return image if axis == "columns" else np.ascontiguousarray(image.transpose(1, 0, 2))


@pytest.mark.parametrize("axis", ["columns", "rows"])
def test_only_the_part_is_looked_at(axis: Axis) -> None:
    image = drawn((level(30.3), 120.0), (level(80.6), 200.0))
    keep = np.zeros((HEIGHT, WIDTH), dtype=bool)
    keep[10:60, 40:100] = True
    settings = StripeSection(axis=axis)
    part = keep if axis == "columns" else keep.T
    stripe = extract_within(turned(image, axis), settings, part)
    inside = np.zeros(WIDTH, dtype=bool)
    inside[40:100] = True
    np.testing.assert_array_equal(has_value(stripe.status), inside)
    assert (stripe.status[~inside] == Status.NO_DATA).all()
    # Six standard deviations of a centroid over five pixels of noise 1 DN on 120 DN.
    assert np.abs(stripe.centre_px[inside] - 30.3).max() < 0.15
    assert stripe.axis == axis and len(stripe.peak) == WIDTH


def test_the_whole_picture_is_as_without_a_part() -> None:
    image = drawn((level(50.2), 150.0))
    whole = extract_within(image, StripeSection(), np.ones((HEIGHT, WIDTH), dtype=bool))
    plain = extract_stripe(image, StripeSection())
    np.testing.assert_array_equal(whole.centre_px, plain.centre_px)
    np.testing.assert_array_equal(whole.sigma_px, plain.sigma_px)
    np.testing.assert_array_equal(whole.status, plain.status)


def test_a_mask_takes_away_glare_of_any_outline() -> None:
    """Glare twice as bright as the line crosses the picture aslant; its mask is ten px wide."""
    u = np.arange(WIDTH, dtype=float)
    slanted = 90.0 - 0.3 * u
    image = drawn((level(70.4), 100.0), (slanted, 200.0))
    away = np.abs(np.arange(HEIGHT)[:, None] - slanted)
    stripe = extract_within(image, StripeSection(), away > 5)
    clear = np.abs(slanted - 70.4) > 5 + 4 * SIGMA_PX  # elsewhere the mask takes the line as well
    np.testing.assert_array_equal(has_value(stripe.status)[clear], True)
    assert np.abs(stripe.centre_px[clear] - 70.4).max() < 0.3
    shown = has_value(stripe.status)
    assert (away[np.rint(stripe.centre_px[shown]).astype(int), np.flatnonzero(shown)] > 5).all()


def test_a_background_is_subtracted_in_the_part_too() -> None:
    dark = drawn((level(40.0), 180.0), seed=2)
    lit = drawn((level(40.0), 180.0), (level(25.5), 60.0), seed=3)
    keep = np.zeros((HEIGHT, WIDTH), dtype=bool)
    keep[5:60] = True
    stripe = extract_within(lit, StripeSection(), keep, dark)
    assert has_value(stripe.status).all()
    assert np.abs(stripe.centre_px - 25.5).max() < 0.5


def test_a_background_or_a_mask_of_another_size_is_refused() -> None:
    """Cropped to the part they would have had the same size as the picture."""
    image = drawn((level(30.3), 120.0))
    keep = np.zeros((HEIGHT, WIDTH), dtype=bool)
    keep[10:60, 40:100] = True
    larger = np.zeros((HEIGHT + 1, WIDTH, 3), dtype=np.uint8)
    with pytest.raises(InputError, match=r"background: .*121, 160, 3.*120, 160, 3"):
        extract_within(image, StripeSection(), keep, larger)
    with pytest.raises(InputError, match=r"part of the picture: .*bool \(119, 160\)"):
        extract_within(image, StripeSection(), keep[1:])
    with pytest.raises(InputError, match=r"part of the picture: .*float64"):
        extract_within(image, StripeSection(), np.where(keep, 1.0, np.nan))  # type: ignore[arg-type]


def test_no_part_is_refused() -> None:
    with pytest.raises(InputError, match="no pixel"):
        extract_within(drawn(), StripeSection(), np.zeros((HEIGHT, WIDTH), dtype=bool))


@pytest.mark.parametrize("share", [0.5, 0.3])
def test_two_lasers_are_told_apart(share: float) -> None:
    """Of either power, and where one of the two lines is missing for some columns."""
    upper = 30.0 + 0.05 * np.arange(WIDTH)
    lower = 70.0 - 0.1 * np.arange(WIDTH)
    height = 220 * np.array([share, 1 - share])
    cut_upper, cut_lower = upper.copy(), lower.copy()
    cut_upper[60:80], cut_lower[100:120] = -100.0, -100.0
    image = drawn((cut_upper, height[0]), (cut_lower, height[1]))
    first, last = (
        extract_stripe(image, StripeSection(returns=which)) for which in ("first", "last")
    )
    above, below = told_apart(first, last)
    for line, true, cut in ((above, upper, cut_upper), (below, lower, cut_lower)):
        np.testing.assert_array_equal(has_value(line.status), cut > 0)
        assert np.abs(line.centre_px - true)[cut > 0].max() < 0.3


def test_of_one_line_alone_nothing_tells_which_it_is() -> None:
    image = drawn((level(50.0), 150.0))
    first, last = (
        extract_stripe(image, StripeSection(returns=which)) for which in ("first", "last")
    )
    for line in told_apart(first, last):
        assert (line.status == Status.AMBIGUOUS).all() and np.isnan(line.centre_px).all()
