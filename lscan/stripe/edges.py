"""What an edge of the target's texture along the line does to the line's centre."""

from dataclasses import replace

import numpy as np

from lscan.records import GreyValues, Stripe, has_value
from lscan.stripe.peaks import windows
from lscan.stripe.ranks import crests
from lscan.stripe.width import line_width

_BESIDE = ((1.5, 2.5), (2.5, 4.5))
"""Where the ground beside the line is seen, in standard deviations of the line from its centre: in
the flanks, which are symmetric where no edge crosses them, and beyond."""

_ROUNDING_DN = 0.5  # a ground of 0 DN has been anything up to that: no edge is sharper


def doubted(stripe: Stripe, light: GreyValues, ground: GreyValues, threshold_dn: float) -> Stripe:
    """The stripe with sigma_px enlarged where the target is brighter on one side of the line.

    A line half on white and half on black is seen displaced towards the white.  Where the white,
    r times as bright, begins d standard deviations from the middle, the line's flank is there
    r exp(-d² / 2) times as bright as its crest, and is taken for it up to d = sqrt(2 ln r).
    A centroid, to which the black contributes as well, is displaced by less than (r - 1) / (r + 1)
    of that (from r = 1.4 on; before, by less than 0.14 standard deviations), which is what is
    allowed for.  The target under other light shows r.

    Parameters
    ----------
    stripe : Stripe, px, of N entries
    light : (N, L) array, DN, the line, one row for each entry of the stripe
    ground : (N, L) array, DN, the target; light of the line's own is symmetric
    threshold_dn : float, DN, what a darker ground says nothing against

    References
    ----------
    The limit is derived above; a uniform distribution up to it on either side, JCGM 100:2008,
    sec. 4.3.7.
    """
    at = np.flatnonzero(has_value(stripe.status))
    if len(at) == 0:
        return stripe
    width_px = line_width(light, at, crests(light)[at])
    row = np.rint(stripe.centre_px[at]).astype(np.int64)
    reach_px = np.zeros(len(at))
    least_dn = max(threshold_dn / 4, _ROUNDING_DN)
    for first, last in _BESIDE:
        beside = np.arange(int(np.ceil(first * width_px)), int(np.ceil(last * width_px)) + 1)
        above, below = (windows(ground, at, row, side).mean(axis=1) for side in (-beside, beside))
        # Colours less each other may leave a negative ground.
        one, other = np.abs(above) + least_dn, np.abs(below) + least_dn
        contrast, ratio = np.abs(one - other) / (one + other), np.abs(np.log(one / other))
        reach_px = np.maximum(reach_px, contrast * np.sqrt(2 * ratio) * width_px)
    sigma_px = stripe.sigma_px.copy()
    sigma_px[at] = np.hypot(sigma_px[at], reach_px / np.sqrt(3))
    return replace(stripe, sigma_px=sigma_px)
