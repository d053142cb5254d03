"""Lines by maximum likelihood in columns that hold more than the line: light that ends at it, and
the line of another surface."""

import numpy as np
from lines_drawn import drawn, speckled
from stripe_pictures import nothing_clipped

from lscan.config.rig import NoiseSection, StripeSection
from lscan.records import Status
from lscan.stripe.extractors.likelihood import maximum_likelihood

HEIGHT, WIDTH, WIDTH_PX, AMPLITUDE = 120, 320, 0.9, 150.0
NOISE = NoiseSection(read_dn=1.53, speckle=0.1)  # 1.5 DN, and rounding
SETTINGS = StripeSection(threshold_dn=15.0, noise=NOISE)


def found(light: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Centres and sigmas, px, of a noisy picture; NaN where nothing like a line could be fitted."""
    image = speckled(light, NOISE.speckle, np.random.default_rng(seed))
    stripe = maximum_likelihood(image, SETTINGS, nothing_clipped(image))
    assert np.mean(stripe.status == Status.OK) > 0.98
    return stripe.centre_px, stripe.sigma_px


def test_light_that_ends_at_the_line_draws_its_centre_by_less_than_half_a_width() -> None:
    """It is a third as high as the line, on either side, 8 px long, in every 20th column.

    On a sloping ground the whole line lies off by a width and more.  The crest's half that the
    light covers is higher by a third of the crest, by which a Gaussian falls within 0.9 widths:
    half of that displaces both halves alike.
    """
    centre = 60 + 8 * np.sin(np.arange(WIDTH) / 40)
    light = drawn(centre, WIDTH_PX, HEIGHT, AMPLITUDE)
    rows, lit = np.arange(HEIGHT)[:, None], np.arange(10, WIDTH, 20)
    above = np.arange(len(lit)) % 2 == 0
    aside = np.where(above, centre[lit] - rows, rows - centre[lit])
    side = (aside > 0) & (aside < 8)
    light[:, lit] = np.maximum(light[:, lit], side * AMPLITUDE / 3)
    got, sigma = found(light, 3)
    lit = lit[np.isfinite(got[lit])]
    assert len(lit) >= 10
    error = np.abs(got - centre)[lit]
    assert error.max() < WIDTH_PX / 2
    assert np.mean(error <= 2 * sigma[lit]) >= 0.9


def test_beside_a_step_a_column_shows_the_brighter_of_two_lines() -> None:
    """Blur takes a third of either piece's light into the other's last column.

    The pieces lie four widths apart: each one's flank is gone at the other's crest.
    """
    steps = np.arange(20, WIDTH, 20)
    beside = np.concatenate([steps - 1, steps])
    high = np.searchsorted(steps, np.arange(WIDTH), side="right") % 2 == 1
    rows = np.where(high, 60 + 4 * WIDTH_PX, 60.0)
    other = np.where(high, 60.0, 60 + 4 * WIDTH_PX)
    share = np.zeros(WIDTH)
    share[beside] = 1 / 3
    light = drawn(rows, WIDTH_PX, HEIGHT, AMPLITUDE * (1 - share))
    got, sigma = found(light + drawn(other, WIDTH_PX, HEIGHT, AMPLITUDE * share), 4)
    error = np.abs(got - rows)[beside]
    assert error.max() < WIDTH_PX / 2
    assert np.mean(error <= 2 * sigma[beside]) >= 0.9
