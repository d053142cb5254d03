"""Pictures that were compressed in blocks are known as such, and others never are; half colours."""

from itertools import count
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from stripe_pictures import centres_of, light_of, noisy, settings_for

from lscan.config.rig import StripeSection
from lscan.devices.api import Grab
from lscan.devices.trials import try_camera
from lscan.stripe import extract_stripe
from lscan.stripe.picture import is_coded
from sim.sensor.webcam import from_jpeg, jpeg_bytes

READ, GAIN, SPECKLE = 0.9, 0.017, 0.2
SETTINGS = settings_for(READ, GAIN, SPECKLE).model_copy(update={"extractor": "ml"})
ESTIMATED = SETTINGS.model_copy(update={"noise": None})


def picture_of(seed, height=150.0):
    """The centres of a red line, px, and its picture, not coded."""
    rng = np.random.default_rng(seed)
    centre = centres_of(rng)
    red = noisy(rng, light_of(centre, 0.9, height), 8.0, READ, GAIN, SPECKLE)
    others = np.rint(rng.normal(4.0, READ, (2, *red.shape)))
    seen = np.clip(np.stack([red, *others], axis=-1), 0, 255)
    return centre, seen.astype(np.uint8)


def coded(picture, quality=85, subsampling="4:2:0"):
    return from_jpeg(jpeg_bytes(picture, quality, subsampling))


@pytest.mark.parametrize("quality", [50, 75, 85, 90])
@pytest.mark.parametrize("subsampling", ["4:2:0", "4:4:4"])
def test_a_coded_picture_is_known_wherever_it_was_cut(quality, subsampling):
    picture = coded(picture_of(1)[1], quality, subsampling)[..., 0]
    for cut in (0, 3, 7):
        assert is_coded(picture[cut:, cut:].T)


def test_no_other_picture_is():
    # Five standard deviations of a binomial of 80 blocks or more, and a mean that stands out: of
    # noise alone that comes once in thousands of pictures.
    for seed in range(30):
        _, picture = picture_of(seed)
        assert not is_coded(picture[..., 0].T)


def test_nor_one_of_a_colour_filter_or_a_sharp_texture():
    rng = np.random.default_rng(1)
    every_second = rng.normal(100, 1 + 4 * (np.arange(1920)[:, None] % 2), (1920, 200))
    assert not is_coded(np.rint(every_second).astype(np.uint8))
    checks = (np.add.outer(np.arange(640) // 13, np.arange(200) // 13) % 2) * 120
    assert not is_coded(np.rint(checks + rng.normal(50, 1, checks.shape)).astype(np.uint8))
    assert not is_coded(np.zeros((640, 200), np.uint8))


def test_the_stated_noise_is_left_aside_in_coded_pictures_alone():
    _, picture = picture_of(2)
    for seen, same in ((coded(picture), True), (picture, False)):
        stated, estimated = (extract_stripe(seen, given) for given in (SETTINGS, ESTIMATED))
        assert np.array_equal(stated.centre_px, estimated.centre_px, equal_nan=True) == same
        assert np.array_equal(stated.sigma_px, estimated.sigma_px, equal_nan=True) == same


def test_a_line_in_a_coded_picture_is_where_it_is_within_its_sigma():
    ratios = []
    for seed in range(12):
        centre, picture = picture_of(10 + seed, height=60.0)
        stripe = extract_stripe(coded(picture), SETTINGS)
        ratios.append((stripe.centre_px - centre) / stripe.sigma_px)
    # Within a quarter, as sigma holds elsewhere; robust, for columns share the errors of a block.
    assert 0.8 < 1.4826 * np.nanmedian(np.abs(ratios)) < 1.25


def as_yuyv(picture: np.ndarray, first: bool) -> np.ndarray:
    """The picture as a camera's YUYV gives it back: pairs have the first's colour, or the mean."""
    yuv = cv2.cvtColor(picture, cv2.COLOR_RGB2YUV).astype(float)
    pairs = yuv.reshape(len(yuv), -1, 2, 3)
    pairs[..., 1:] = pairs[:, :, :1, 1:] if first else pairs[..., 1:].mean(axis=2, keepdims=True)
    return cv2.cvtColor(np.rint(yuv).clip(0, 255).astype(np.uint8), cv2.COLOR_YUV2RGB)


@pytest.mark.parametrize(
    ("channel", "shift_px", "first"), [("red", 0.35, False), ("red-excess", 0.5, True)]
)
def test_sigma_holds_the_shift_of_half_colours_and_the_trial_says_it(channel, shift_px, first):
    """An upright red line in the mean of its rows; one that lies along the pairs has no shift."""
    held = []
    for seed in range(2):
        centre, picture = picture_of(seed)
        image = as_yuyv(picture.transpose(1, 0, 2), first)
        chosen = StripeSection(axis="rows", channel=channel, extractor="ml", threshold_dn=20.0)
        stripe = extract_stripe(image, chosen)
        held.append(np.abs(stripe.centre_px - centre) <= 1.96 * stripe.sigma_px)
        level = extract_stripe(
            as_yuyv(picture, first), chosen.model_copy(update={"axis": "columns"})
        )
        assert np.nanmedian(level.sigma_px) < shift_px / np.sqrt(3) < np.nanmedian(stripe.sigma_px)
    assert np.mean(held) >= 0.92
    grabs = (Grab(np.roll(image, turn, axis=0), float(turn), 1.0) for turn in count())
    said = try_camera(SimpleNamespace(grab=lambda: next(grabs)), 4, "red").remarks
    assert sum("two pixels share one" in remark for remark in said) == 1


def test_smoothing_of_a_coded_picture_knows_that_neighbours_share_their_errors():
    """Blocks of 8 pixels, 16 of colours: where columns counted as independent, 70 % were within."""
    settings = ESTIMATED.model_copy(update={"smooth_px": 4.0})
    within = []
    for seed in range(12):
        centre, picture = picture_of(seed)
        stripe = extract_stripe(coded(picture), settings)
        within.append(np.nanmean(np.abs(stripe.centre_px - centre) < 1.96 * stripe.sigma_px))
    assert np.mean(within) > 0.93
