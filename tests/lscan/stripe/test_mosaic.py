"""What a colour camera's mosaic leaves of a line, read by ``ml``."""

import numpy as np
import pytest
from lines_drawn import drawn
from scipy.ndimage import convolve

from lscan.config.rig import StripeSection
from lscan.records import Bytes, Status, Stripe, has_value
from lscan.stripe import extract_stripe

HEIGHT, WIDTH = 80, 300
BESIDE = np.array([[1, 2, 1], [2, 4, 2], [1, 2, 1]]) / 4  # bilinear, of every second row and column
READ_DN, PER_DN = 0.9, 0.017


def red_of(
    width_px: float,
    centre: float,
    first: tuple[int, int] | None,
    seed: int,
    amplitude: float = 150.0,
) -> Bytes:
    """A level line in a colour that every pixel sees, or one in four from ``first`` on."""
    rng = np.random.default_rng(seed)
    light = drawn(np.full(WIDTH, centre), width_px, HEIGHT, amplitude) + 8.0
    grey = light + rng.normal(0, np.sqrt(READ_DN**2 + PER_DN * light))
    if first is not None:
        seen = np.zeros(grey.shape)
        seen[first[0] :: 2, first[1] :: 2] = 1.0
        filled = convolve(grey * seen, BESIDE, mode="constant")
        grey = filled / convolve(seen, BESIDE, mode="constant")
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def line_by_ml(picture: Bytes) -> Stripe:
    return extract_stripe(picture, StripeSection(extractor="ml", channel="grey", threshold_dn=15.0))


@pytest.mark.parametrize("first", [None, (0, 0), (1, 0)])
@pytest.mark.parametrize("width_px", [1.1, 2.0])
def test_the_mean_of_a_level_line_is_off_by_chance_alone(
    first: tuple[int, int] | None, width_px: float
) -> None:
    for seed, phase in enumerate(np.linspace(0.0, 2.0, 6, endpoint=False)):
        stripe = line_by_ml(red_of(width_px, 40.0 + phase, first, seed))
        off = stripe.centre_px - (40.0 + phase)
        assert has_value(stripe.status).all()
        # A colour seen in every second column has half of its columns' errors in common.
        independent = WIDTH / (1 if first is None else 2)
        assert abs(off.mean()) < 4 * np.median(stripe.sigma_px) / np.sqrt(independent)
        assert 0.6 < np.std(off) / np.median(stripe.sigma_px) < 1.4


@pytest.mark.parametrize("amplitude", [150.0, 500.0])
def test_a_line_narrower_than_the_seen_rows_are_apart_has_no_place_between_them(
    amplitude: float,
) -> None:
    for seed, phase in enumerate((0.0, 0.3, 0.6)):
        stripe = line_by_ml(red_of(0.6, 40.0 + phase, (0, 0), seed, amplitude))
        assert has_value(stripe.status).mean() < 0.1
        assert (stripe.status == Status.AMBIGUOUS).any()
    seen_everywhere = line_by_ml(red_of(0.6, 40.3, None, 0))
    assert (seen_everywhere.status == Status.OK).all()


def test_what_a_fit_through_every_bright_pixel_leaves_over_is_no_misfit() -> None:
    # Where noise alone was read from the skirts as the line's shape, sigma was ten times too large.
    ratio = []
    for seed, phase in enumerate(np.linspace(0.0, 1.0, 8, endpoint=False)):
        stripe = line_by_ml(red_of(0.45, 40.0 + phase, None, 200 + seed))
        ratio.append(np.std(stripe.centre_px - (40.0 + phase)) / np.median(stripe.sigma_px))
    assert 0.5 < np.mean(ratio) < 1.2
