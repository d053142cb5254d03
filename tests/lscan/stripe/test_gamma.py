"""A camera's tone curve, undone before the line is read."""

import numpy as np
import pytest

from lscan.config.plugins import installed
from lscan.config.rig import StripeSection
from lscan.files.pictures import linear_picture
from lscan.records import Bytes, Floats, has_value
from lscan.stripe import extract_stripe

WIDTH, HEIGHT, END, BLUR_PX = 200, 64, 150, 1.5


def linear_dn(seed: int, clips: bool = False) -> tuple[Floats, Floats]:
    """(H, W) DN of a linear camera: a slanted line that ends at a column, blurred; its centres."""
    generator = np.random.default_rng(seed)
    centre = 30.0 + 0.03 * np.arange(WIDTH) + generator.uniform(-5, 5)
    rows = np.arange(HEIGHT)[:, None]
    ends = 1 / (1 + np.exp((np.arange(WIDTH) - END) / (0.6 * BLUR_PX)))  # all but an error function
    light = (600.0 if clips else 170.0) * ends * np.exp(-((rows - centre) ** 2) / (2 * BLUR_PX**2))
    noisy = 0.02 * generator.poisson((light + 6.0) / 0.02) + generator.normal(0, 0.6, light.shape)
    return np.clip(noisy, 0, 255), centre


def curved(linear: Floats, gamma: float | str) -> Bytes:
    """The picture of a camera with that curve, by the curve's own definition."""
    share = linear / 255
    if gamma == "srgb":
        bent = np.where(share <= 0.0031308, 12.92 * share, 1.055 * share ** (1 / 2.4) - 0.055)
    else:
        bent = share ** (1 / float(gamma))
    return np.rint(255 * bent).astype(np.uint8)


@pytest.mark.parametrize("gamma", [1.8, 2.2, "srgb"])
@pytest.mark.parametrize("name", installed("lscan.extractors"))
def test_behind_a_stated_curve_the_line_is_that_of_a_linear_camera(
    name: str, gamma: float | str
) -> None:
    linear, centre = linear_dn(3)
    section = StripeSection(extractor=name, channel="grey", threshold_dn=20.0)
    plain = extract_stripe(np.rint(linear).astype(np.uint8), section)
    stated = StripeSection(extractor=name, channel="grey", threshold_dn=20.0, gamma=gamma)
    found = extract_stripe(curved(linear, gamma), stated)
    both = has_value(found.status) & has_value(plain.status)
    # Rounding, twice and up to 2.2 DN coarse, is a part of the noise that sigma states.
    apart = (found.centre_px - plain.centre_px)[both] / found.sigma_px[both]
    assert np.sqrt(np.mean(apart**2)) < 1
    assert (
        abs(np.count_nonzero(has_value(found.status)) - np.count_nonzero(has_value(plain.status)))
        <= 1
    )
    off = (found.centre_px - centre)[both] / found.sigma_px[both]
    assert np.sqrt(np.mean(off**2)) < 1.6


def test_a_line_whose_curve_is_not_stated_ends_a_column_late() -> None:
    """20 DN above a ground of 6 are, behind 2.2, 7 of a linear camera's: 1.03 columns later."""
    section = StripeSection(channel="grey", threshold_dn=20.0)
    later = []
    for linear, _ in map(linear_dn, range(12)):
        pictures = np.rint(linear).astype(np.uint8), curved(linear, 2.2)
        first, last = (has_value(extract_stripe(one, section).status).sum() for one in pictures)
        later.append(int(last) - int(first))
    assert 0.5 < np.mean(later) < 1.5


def test_what_the_curve_clipped_is_clipped_behind_it() -> None:
    linear, _ = linear_dn(4, clips=True)
    sections = StripeSection(channel="grey"), StripeSection(channel="grey", gamma=2.2)
    plain, found = (
        extract_stripe(picture, section)
        for picture, section in zip(
            (np.rint(linear).astype(np.uint8), curved(linear, 2.2)), sections, strict=True
        )
    )
    np.testing.assert_array_equal(plain.status[: END - 9], found.status[: END - 9])


def test_a_background_is_taken_off_the_light_and_not_off_grey_values() -> None:
    """Light adds, grey values behind a curve do not: a streak beside the line leaves nothing."""
    linear, centre = linear_dn(5)
    streak = 90.0 * np.exp(-((np.arange(HEIGHT)[:, None] - centre - 3) ** 2) / 4.5)
    stated = StripeSection(channel="grey", threshold_dn=20.0, gamma=2.2)
    lit, dark = curved(linear * 0.6 + streak, 2.2), curved(streak, 2.2)
    off = (extract_stripe(lit, stated, dark).centre_px - centre)[: END - 9]
    assert abs(np.mean(off)) < 0.02


@pytest.mark.parametrize(
    ("grey", "gamma", "dn"),
    # IEC 61966-2-1: 128 is 0.21586 of the light, 10 lies on the straight part; 255 x 0.5^2.2 = 55.5
    [(128, "srgb", 55), (10, "srgb", 1), (255, "srgb", 255), (186, 2.2, 127), (0, 2.2, 0)],
)
def test_curves_have_their_published_values(grey: int, gamma: float | str, dn: int) -> None:
    assert linear_picture(np.array([[grey]], dtype=np.uint8), gamma)[0, 0] == dn  # type: ignore[arg-type]


def test_a_linear_picture_stays_the_same_array() -> None:
    picture = np.zeros((3, 3), dtype=np.uint8)
    assert linear_picture(picture, 1.0) is picture
