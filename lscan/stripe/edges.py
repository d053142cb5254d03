"""What an edge of the target's texture along the line does to the line's centre."""

from dataclasses import replace

import numpy as np

from lscan.records import Floats, Stripe, has_value
from lscan.stripe.peaks import windows
from lscan.stripe.width import line_width

_BESIDE = ((1.5, 2.5), (2.5, 4.5))
"""Where the ground beside the line is seen, in standard deviations of the line from its centre: in
the flanks, which are symmetric where no edge crosses them, and beyond."""


def doubted(stripe: Stripe, light: Floats, ground: Floats, threshold_dn: float) -> Stripe:
    """The stripe with sigma_px enlarged where the target is brighter on one side of the line.

    A line half on white and half on black is seen displaced towards the white: with its middle on
    the edge by sqrt(2 / pi) c of its standard deviation, where (1 + c) / (1 - c) is the ratio of
    the reflectances.  The target under other light shows that ratio.  Edges that near displace
    the line by anything between none and that.

    Parameters
    ----------
    stripe : Stripe, px, of N entries
    light : (N, L) array, DN, the line, one row for each entry of the stripe
    ground : (N, L) array, DN, the target; light of the line's own is symmetric
    threshold_dn : float, DN, what a darker ground says nothing against

    References
    ----------
    The mean of a Gaussian whose halves are weighed by 1 + c and 1 - c; a uniform distribution
    from there to none on either side, JCGM 100:2008, sec. 4.3.7.
    """
    at = np.flatnonzero(has_value(stripe.status))
    if len(at) == 0:
        return stripe
    width_px = line_width(light, at)
    row = np.rint(stripe.centre_px[at]).astype(np.int64)
    reach_px = np.zeros(len(at))
    for first, last in _BESIDE:
        beside = np.arange(int(np.ceil(first * width_px)), int(np.ceil(last * width_px)) + 1)
        above, below = (windows(ground, at, row, side).mean(axis=1) for side in (-beside, beside))
        # Colours less each other may leave a negative ground.
        one, other = np.abs(above) + threshold_dn / 4, np.abs(below) + threshold_dn / 4
        contrast, ratio = np.abs(one - other) / (one + other), np.abs(np.log(one / other))
        reach_px = np.maximum(reach_px, contrast * np.sqrt(2 * ratio) * width_px)
    sigma_px = stripe.sigma_px.copy()
    sigma_px[at] = np.hypot(sigma_px[at], reach_px / np.sqrt(3))
    return replace(stripe, sigma_px=sigma_px)
