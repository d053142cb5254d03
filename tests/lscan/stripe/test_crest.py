"""Sigma of lines in columns that hold more than the line, and where it is wide and speckled."""

import numpy as np
import pytest
from lines_drawn import drawn, speckled
from stripe_pictures import nothing_clipped

from lscan.config.rig import NoiseSection, StripeSection
from lscan.records import has_value
from lscan.stripe import extract_stripe
from lscan.stripe.likelihood import maximum_likelihood
from lscan.stripe.peaks import FWHM

HEIGHT, WIDTH, WIDTH_PX, AMPLITUDE = 120, 640, 0.9, 150.0
NOISE = NoiseSection(read_dn=1.53, speckle=0.2)  # 1.5 DN, and rounding
SETTINGS = StripeSection(threshold_dn=15.0, noise=NOISE)


@pytest.mark.parametrize(("share", "length_px"), [(1 / 5, 5), (1 / 4, 5)])
def test_sigma_covers_what_light_that_ends_at_the_line_does(share: float, length_px: int) -> None:
    """Such light, on either side in every tenth column, draws the whole line by a width and more.

    The crest lies near the truth, and the doubt is that of a uniform distribution as far: three
    standard deviations of that reach beyond its end by half, which is left to the crest's own
    error.  The misfit's root alone covers none.  Where no fit comes to rest, NO_PEAK is as good: of
    half of the columns at most, so that there is something to judge.
    """
    centre = 60 + 8 * np.sin(np.arange(WIDTH) / 40)
    light = drawn(centre, WIDTH_PX, HEIGHT, AMPLITUDE)
    rows, lit = np.arange(HEIGHT)[:, None], np.arange(10, WIDTH, 10)
    above = np.arange(len(lit)) % 2 == 0
    aside = np.where(above, centre[lit] - rows, rows - centre[lit])
    beside = (aside > 0) & (aside < length_px)
    light[:, lit] = np.maximum(light[:, lit], beside * AMPLITUDE * share)
    image = speckled(light, NOISE.speckle, np.random.default_rng(3))
    stripe = maximum_likelihood(image, SETTINGS, nothing_clipped(image))
    pull = np.abs(stripe.centre_px - centre)[lit] / stripe.sigma_px[lit]
    pull = pull[np.isfinite(pull)]
    assert len(pull) > 0.5 * len(lit)
    assert np.mean(pull <= 3) >= 0.95


@pytest.mark.parametrize(
    ("fwhm_px", "stated", "times", "name", "most_px"),
    [
        (24.0, True, 1, "centroid-relative", 1.0),
        (24.0, True, 1, "ml", 0.5),
        (24.0, True, 4, "centroid-relative", 1.0),
        (12.0, False, 1, "max", 4.0),
        (12.0, False, 1, "steger", 0.3),
    ],
)
def test_a_wide_speckled_line_is_as_sure_as_it_scatters(
    fwhm_px: float, stated: bool, times: int, name: str, most_px: float
) -> None:
    """Each pixel has speckle of its own of 0.4: the brightest lies anywhere in the line's core.

    Four times overexposed the crest is clipped on 40 px: SATURATED, whose sigma covers all of it.
    """
    rng = np.random.default_rng(1)
    centre = 80 + 0.01 * np.arange(320)
    light = drawn(centre, fwhm_px / FWHM, 160, times * 140.0)
    image = np.clip(speckled(light, 0.4, rng, read_dn=1.0, ground_dn=4.0), 0, 255).astype(np.uint8)
    chosen = StripeSection(
        extractor=name, threshold_dn=20.0, line_width_px=fwhm_px if stated else None
    )
    stripe = extract_stripe(image, chosen)
    found = has_value(stripe.status)
    error, sigma = (stripe.centre_px - centre)[found], stripe.sigma_px[found]
    assert found.mean() >= 0.97
    assert np.sqrt(np.mean(error**2)) <= most_px
    assert np.mean(np.abs(error) <= 1.96 * sigma) >= 0.92
    assert times > 1 or np.median(sigma) <= 1.8 * error.std()
