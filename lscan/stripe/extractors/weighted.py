"""The centroid of squared intensities: bright pixels count for more, noise far out for less."""

import numpy as np

from lscan.config.rig import StripeSection
from lscan.records import Floats, Mask, Stripe
from lscan.stripe.extractors.rules import LineLight, extract_by


def centroid_squared(image: Floats, settings: StripeSection, clipped: Mask) -> Stripe:
    """The line at the centroid of the squared light within 2.5 widths of each column's peak.

    image: (H, W) grey values in DN.  clipped: (H, W), of no account to the rule.
    The squares of a Gaussian are a Gaussian, narrower by sqrt(2): the window cuts off what
    lies beyond 3.5 of its widths.  See rules.py.
    """
    return extract_by(_centroid_of_squares, image, settings, clipped)


def _centroid_of_squares(seen: LineLight) -> tuple[Floats, Floats]:
    reach = np.maximum(np.ceil(2.5 * seen.width_px), 2)[:, None]
    light = np.where(np.abs(seen.steps) <= reach, seen.light, 0.0)
    total = (light**2).sum(axis=1)
    total = np.where(total > 0, total, np.nan)
    offset = (light**2 @ seen.steps) / total
    return offset, 2 * light * (seen.steps - offset[:, None]) / total[:, None]
