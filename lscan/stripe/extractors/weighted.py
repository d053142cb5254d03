"""The centroid of squared intensities: bright pixels count for more, noise far out for less."""

import numpy as np

from lscan.records import Floats
from lscan.stripe.extractors.rules import LineLight, extractor


@extractor
def centroid_squared(seen: LineLight) -> tuple[Floats, Floats]:
    """The line at the centroid of the squared light within 2.5 widths of each column's peak.

    The squares of a Gaussian are a Gaussian, narrower by sqrt(2): the window cuts off what
    lies beyond 3.5 of its widths.  See rules.py.

    Parameters
    ----------
    image : (H, W) array, DN, grey values
    settings : StripeSection, threshold and span
    clipped : (H, W) mask, of the pixels that may have seen more light than they say
    """
    reach = np.maximum(np.ceil(2.5 * seen.width_px), 2)[:, None]
    light = np.where(np.abs(seen.steps) <= reach, seen.light, 0.0)
    total = (light**2).sum(axis=1)
    total = np.where(total > 0, total, np.nan)
    offset = (light**2 @ seen.steps) / total
    return offset, 2 * light * (seen.steps - offset[:, None]) / total[:, None]
