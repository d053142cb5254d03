"""Pictures that were compressed in blocks are known as such, and others never are."""

import numpy as np
import pytest
from stripe_pictures import centres_of, light_of, noisy, settings_for

from lscan.stripe import extract_stripe
from lscan.stripe.extract import extract_stripes
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


def test_coded_pictures_among_others_are_read_as_by_themselves():
    pictures = [
        picture_of(3)[1],
        coded(picture_of(4)[1]),
        picture_of(5)[1],
        coded(picture_of(6)[1]),
    ]
    together = extract_stripes([(picture, None) for picture in pictures], SETTINGS)
    for stripe, picture in zip(together, pictures, strict=True):
        alone = extract_stripe(picture, SETTINGS)
        # Sums over more lines are added up in another order: some last digits.
        np.testing.assert_allclose(stripe.centre_px, alone.centre_px, rtol=1e-12)
        np.testing.assert_allclose(stripe.sigma_px, alone.sigma_px, rtol=1e-12)


def test_a_line_in_a_coded_picture_is_where_it_is_within_its_sigma():
    ratios = []
    for seed in range(12):
        centre, picture = picture_of(10 + seed, height=60.0)
        stripe = extract_stripe(coded(picture), SETTINGS)
        ratios.append((stripe.centre_px - centre) / stripe.sigma_px)
    # Within a quarter, as sigma holds elsewhere; robust, for columns share the errors of a block.
    assert 0.8 < 1.4826 * np.nanmedian(np.abs(ratios)) < 1.25
