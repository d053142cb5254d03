"""Sigma of lines by maximum likelihood in columns that hold more than the line."""

import numpy as np
import pytest
from lines_drawn import drawn, speckled
from stripe_pictures import nothing_clipped

from lscan.config.rig import NoiseSection, StripeSection
from lscan.stripe.likelihood import maximum_likelihood

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
