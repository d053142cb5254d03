"""Twenty mistakes that one makes in an extractor, each put into one of our own.

A suite and the paired test must notice each of them: ``tests.validation.regression.mutations``.
Those of MUTANTS are extractors by the name ``tests.validation.regression.mutants:NAME``.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import wraps

import numpy as np
from scipy.ndimage import median_filter, uniform_filter1d

from lscan.config.rig import StripeSection
from lscan.records import Floats, Mask, Status, Stripe, has_value
from lscan.stripe import find_extractor

LIKELIHOOD, CENTROID, GAUSSIAN = "ml", "centroid-relative", "gaussian"
Given = tuple[Floats, StripeSection, Mask]
Mutant = Callable[[Floats, StripeSection, Mask], Stripe]
MUTANTS: dict[str, str] = {}
"""By name, the extractor that each was made of."""


def _before(base: str) -> Callable[[Callable[[Floats, StripeSection, Mask], Given]], Mutant]:
    """An extractor whose input is changed."""

    def made(change: Callable[[Floats, StripeSection, Mask], Given]) -> Mutant:
        MUTANTS[change.__name__] = base

        @wraps(change)
        def mutant(image: Floats, settings: StripeSection, clipped: Mask) -> Stripe:
            return find_extractor(base)(*change(image, settings, clipped))

        return mutant

    return made


def _after(base: str) -> Callable[[Callable[[Stripe, Floats], Stripe]], Mutant]:
    """An extractor whose result is changed."""

    def made(change: Callable[[Stripe, Floats], Stripe]) -> Mutant:
        MUTANTS[change.__name__] = base

        @wraps(change)
        def mutant(image: Floats, settings: StripeSection, clipped: Mask) -> Stripe:
            return change(find_extractor(base)(image, settings, clipped), image)

        return mutant

    return made


def _moved(stripe: Stripe, centre_px: Floats, image: Floats) -> Stripe:
    """The stripe with other centres, within the picture, where it has any."""
    inside = np.clip(centre_px, -0.5, len(image) - 0.5)
    centre = np.where(np.isfinite(inside), inside, stripe.centre_px)
    return replace(stripe, centre_px=np.where(has_value(stripe.status), centre, np.nan))


def _without(stripe: Stripe, lost: Mask) -> Stripe:
    """The stripe without the values of some columns."""
    status = np.where(lost, int(Status.NO_PEAK), stripe.status)
    centre, sigma, peak = (
        np.where(lost, np.nan, values)
        for values in (stripe.centre_px, stripe.sigma_px, stripe.peak)
    )
    return replace(stripe, status=status, centre_px=centre, sigma_px=sigma, peak=peak)


@_after(LIKELIHOOD)
def half_a_pixel_off(stripe: Stripe, image: Floats) -> Stripe:
    """The centre of a pixel taken for its edge."""
    return _moved(stripe, stripe.centre_px + 0.5, image)


@_after(LIKELIHOOD)
def lower_half_one_off(stripe: Stripe, image: Floats) -> Stripe:
    """A window's first row counted from 1, in the lower half of the picture."""
    return _moved(stripe, stripe.centre_px + (stripe.centre_px > len(image) / 2), image)


@_after(LIKELIHOOD)
def next_column(stripe: Stripe, image: Floats) -> Stripe:
    """Every centre given to the column beside it."""
    return _moved(stripe, np.roll(stripe.centre_px, 1), image)


@_after(LIKELIHOOD)
def whole_pixels(stripe: Stripe, image: Floats) -> Stripe:
    """The fraction of a pixel cut off and half of one put there instead."""
    return _moved(stripe, np.floor(stripe.centre_px) + 0.5, image)


@_after(LIKELIHOOD)
def magnified(stripe: Stripe, image: Floats) -> Stripe:
    """A scale wrong by one percent about the middle of the picture."""
    middle = (len(image) - 1) / 2
    return _moved(stripe, middle + 1.01 * (stripe.centre_px - middle), image)


@_after(LIKELIHOOD)
def smoothed(stripe: Stripe, image: Floats) -> Stripe:
    """The median of 15 columns in place of each."""
    filtered = median_filter(np.nan_to_num(stripe.centre_px), 15, mode="nearest")
    return _moved(stripe, filtered, image)


@_after(LIKELIHOOD)
def every_hundredth_wrong(stripe: Stripe, image: Floats) -> Stripe:
    """One column in a hundred is 20 px off and says it is good."""
    wrong = np.arange(len(stripe.status)) % 100 == 50
    return _moved(stripe, stripe.centre_px + 20.0 * wrong, image)


@_after(LIKELIHOOD)
def every_tenth_lost(stripe: Stripe, _: Floats) -> Stripe:
    """One column in ten is given up."""
    return _without(stripe, np.arange(len(stripe.status)) % 10 == 0)


@_after(LIKELIHOOD)
def clipped_given_up(stripe: Stripe, _: Floats) -> Stripe:
    """No value where pixels are clipped."""
    return _without(stripe, stripe.status == Status.SATURATED)


@_after(LIKELIHOOD)
def sigma_halved(stripe: Stripe, _: Floats) -> Stripe:
    """A variance halved twice."""
    return replace(stripe, sigma_px=stripe.sigma_px / 2)


@_after(LIKELIHOOD)
def sigma_doubled(stripe: Stripe, _: Floats) -> Stripe:
    """A standard deviation taken for half of one."""
    return replace(stripe, sigma_px=stripe.sigma_px * 2)


@_after(LIKELIHOOD)
def sigma_for_all(stripe: Stripe, _: Floats) -> Stripe:
    """The picture's mean sigma in every column."""
    return replace(stripe, sigma_px=np.where(
        has_value(stripe.status), np.nan_to_num(stripe.sigma_px).mean(), np.nan
    ))  # fmt: skip


@_before(LIKELIHOOD)
def clipped_trusted(image: Floats, settings: StripeSection, clipped: Mask) -> Given:
    """Clipped pixels taken for measured ones."""
    return image, settings, np.zeros_like(clipped)


@_before(LIKELIHOOD)
def noise_unstated(image: Floats, settings: StripeSection, clipped: Mask) -> Given:
    """The reading noise of the rig file taken three times too large."""
    noise = settings.noise
    if noise is None or noise.read_dn is None:
        return image, settings, clipped
    more = noise.model_copy(update={"read_dn": 3 * noise.read_dn})
    return image, settings.model_copy(update={"noise": more}), clipped


@_before(LIKELIHOOD)
def threshold_doubled(image: Floats, settings: StripeSection, clipped: Mask) -> Given:
    """Faint lines not looked for."""
    twice = settings.model_copy(update={"threshold_dn": 2 * settings.threshold_dn})
    return image, twice, clipped


@_before(GAUSSIAN)
def threshold_forgotten(image: Floats, settings: StripeSection, clipped: Mask) -> Given:
    """The highest pixel of noise taken for a line."""
    return image, settings.model_copy(update={"threshold_dn": 1.0}), clipped


@_before(CENTROID)
def blurred_first(image: Floats, settings: StripeSection, clipped: Mask) -> Given:
    """The picture smoothed along the line, over 9 columns, before it is read."""
    return uniform_filter1d(image.astype(float), 9, axis=1), settings, clipped


@_before(CENTROID)
def squared_twice(image: Floats, settings: StripeSection, clipped: Mask) -> Given:
    """Grey values squared, as if the camera had a gamma of its own."""
    return np.sign(image) * image.astype(float) ** 2 / 255, settings, clipped


@_before(CENTROID)
def wrapped_at_128(image: Floats, settings: StripeSection, clipped: Mask) -> Given:
    """Grey values in eight bits with a sign: bright ones turn dark."""
    grey = image.astype(float)
    return np.where(grey >= 128, grey - 256, grey), settings, clipped


@_before(CENTROID)
def ground_left_in(image: Floats, settings: StripeSection, clipped: Mask) -> Given:
    """A ground that grows across the line is added, as where none is taken off."""
    rows = np.linspace(0.0, 1.0, len(image))[:, None]
    return image + 2 * settings.threshold_dn * rows, settings, clipped
