"""Robust smoothing along the line, for those who want less scatter than resolution."""

from dataclasses import replace

import numpy as np

from lscan.records import Floats, Mask, Stripe, has_value
from lscan.stripe.pieces import neighbours, pieces

_REACH = 3  # standard deviations of the weight at which neighbours are left out
_TUKEY = 4.685
"""Residual, in robust standard deviations, beyond which a column has no weight: Tukey's
biweight with 95 % efficiency for normal errors (Holland & Welsch, Commun. Stat. A 6, 813,
1977)."""
_ROUNDS = 5
_FEWEST = 6  # neighbours, itself included: twice the three unknowns of a parabola
_MAD = 1.4826  # of the median absolute deviation, for the standard deviation of a normal


def smooth(stripe: Stripe, smooth_px: float) -> Stripe:
    """The stripe with each centre replaced by that of a parabola fitted to its neighbours.

    Every column has its own local quadratic regression, weighted by the distance, the columns' own
    sigma_px and Tukey's biweight of the residuals.  Neighbours beyond a gap or a jump (pieces.py)
    have no part in it, and a column with fewer than six stays as it is.

    sigma_px is that of the regression, for columns that err independently: neighbours within
    some smooth_px of each other then share most of their error, so the mean of n of them is
    no better than that of n / (3.5 smooth_px).  It leaves out what a parabola cannot follow.

    Parameters
    ----------
    stripe : Stripe, px
    smooth_px : float, px, standard deviation of the Gaussian weight along the line; 0 changes
        nothing

    References
    ----------
    Cleveland, J. Am. Stat. Assoc. 74, 829 (1979).
    """
    if smooth_px == 0 or not has_value(stripe.status).any():
        return stripe
    reach = min(int(np.ceil(_REACH * smooth_px)), len(stripe.centre_px) - 1)
    step = np.arange(-reach, reach + 1)
    inside, near = neighbours(pieces(stripe), step)
    fitted = np.flatnonzero(near.sum(axis=1) >= _FEWEST)
    near, inside = near[fitted], inside[fitted]
    centre = np.where(near, stripe.centre_px[inside], 0.0)
    sigma = np.where(near, stripe.sigma_px[inside], 1.0)
    weight = np.where(near, np.exp(-0.5 * (step / smooth_px) ** 2), 0.0) / sigma**2
    place, spread = _local_parabola(step / smooth_px, centre, sigma, weight, near)
    centre_px, sigma_px = stripe.centre_px.copy(), stripe.sigma_px.copy()
    centre_px[fitted], sigma_px[fitted] = place, spread
    return replace(stripe, centre_px=centre_px, sigma_px=sigma_px)


def _local_parabola(
    step: Floats, centre: Floats, sigma: Floats, weight: Floats, near: Mask
) -> tuple[Floats, Floats]:
    """Value and standard uncertainty, (K,) each in px, of K parabolas in their middles.

    step: (n,) distance of the neighbours.  centre, sigma, weight: (K, n), px, px and px^-2.
    near: (K, n) mask of the neighbours there are.
    """
    powers = step[:, None] ** np.arange(3)
    robust = np.ones_like(weight)
    for _ in range(_ROUNDS):
        weighted = (weight * robust)[..., None] * powers  # (K, n, 3)
        normal = np.einsum("kni,nj->kij", weighted, powers)
        # How each neighbour moves the value in the middle, which is the first coefficient.
        influence = np.einsum("kni,ki->kn", weighted, np.linalg.pinv(normal)[:, 0])
        curve = np.einsum("kni,kn->ki", weighted, centre)
        fit = np.einsum("kij,kj,ni->kn", np.linalg.pinv(normal), curve, powers)
        pull = (centre - fit) / sigma
        scale = _MAD * np.nanmedian(np.where(near, np.abs(pull), np.nan), axis=1, keepdims=True)
        # Scatter below the stated sigma is chance: it must not make outliers.
        ratio = pull / (_TUKEY * np.maximum(scale, 1.0))
        robust = np.square(np.maximum(1 - ratio**2, 0.0))
    value = (influence * centre).sum(axis=1)
    # Where columns scatter by more than they say, it is their scatter that is carried on.
    variance = np.square(influence * sigma).sum(axis=1) * np.maximum(scale[:, 0], 1.0) ** 2
    return value, np.sqrt(variance)
