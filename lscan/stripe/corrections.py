"""Corrections of an extracted stripe: blur and smoothing.

The lens spreads light along the line as well as across it, so that a column of the picture
holds light of its neighbours.  Light found in column u comes from a column u0 that is spread
about u.  With a Gaussian point spread of variance s² and F(u) the light found in column u,
the mean and the mean square of its origin are (Tweedie's formula: H. Robbins, An empirical
Bayes approach to statistics, 1956)

    E[u0 - u]    = s² F'/F
    E[(u0 - u)²] = s² (1 + s² F''/F)

and the centroid of a line v(u) is found displaced by

    v' E[u0 - u] + v''/2 E[(u0 - u)²] = s² (v' F'/F + v''/2) + s⁴ (v''/2) F''/F.

The first term follows slope times change of brightness: where a line folds away from the
camera it darkens and bends at once.  The second follows concavity.  Both are exact for a
line without noise up to the second derivative of v.  What the line's own thickness adds
across it has no part in them: a centroid is linear in the light.
"""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from lscan.config.rig import StripeSection
from lscan.errors import InputError
from lscan.records import Floats, GreyValues, Ints, Mask, Stripe, has_value
from lscan.stripe.peaks import medians, neighbours, pieces, windows

# Correcting for what the camera's blur does to a line that is curved or unevenly bright.

PIXEL_VARIANCE = 1 / 12
"""Variance in px² of the pixel's own width, which spreads light as the lens does."""

REACH_PX = 4
"""Derivatives are those of quadratics over this many columns on either side: noise of 1 px in
the centre becomes one of 0.13 s² px of the correction for each unit of F'/F, and 0.057 s² px
for the curvature."""

FEWEST_COLUMNS = 5
"""Fewest columns a quadratic is fitted to, so that something is left to judge its fit by."""

FLUX_REACH_PX = 8
"""Light this far from the centre counts as the line's."""


def correct_blur(stripe: Stripe, settings: StripeSection, light: GreyValues) -> Stripe:
    """The stripe as a camera without blur along the line would have shown it.

    Derivatives are taken from quadratics over REACH_PX columns to either side, never across a
    gap or a jump.  sigma_px grows by the noise of the correction, by the term in s⁴, whose
    v'' is too noisy to correct for, and, where a line is too short for derivatives,
    by ``blur_px``: the shift of a line at 45 degrees that ends there.

    Parameters
    ----------
    stripe : Stripe, px, as extracted, before any smoothing along the line
    settings : StripeSection, whose ``blur_px`` is the standard deviation of the lens's point
        spread; the stripe is returned as it is where that is None
    light : (N, L) array, DN, row i being the column (or row) of the picture that entry i of the
        stripe was found in; a picture with the laser off may have been subtracted

    Raises
    ------
    InputError
        Where light and stripe differ in length.

    References
    ----------
    H. Robbins, An empirical Bayes approach to statistics (1956), for the origin of the light; the
    correction is derived in this module's text.
    """
    if settings.blur_px is None:
        return stripe
    if light.ndim != 2 or len(light) != len(stripe.status):
        what, allowed = "is not of the stripe's length", f"({len(stripe.status)}, L)"
        raise InputError(what, where="light", value=light.shape, allowed=allowed)
    if (pieces(stripe) < 0).all():
        return stripe
    parts, sigma = _shift(stripe, light, settings.blur_px**2 + PIXEL_VARIANCE)
    shift = parts.sum(axis=0)
    sigma = np.where(np.isfinite(shift), sigma, settings.blur_px)
    moved = stripe.centre_px - np.where(np.isfinite(shift), shift, 0.0)
    return replace(stripe, centre_px=moved, sigma_px=np.hypot(stripe.sigma_px, sigma))


def smoothing_doubt(stripe: Stripe, light: GreyValues, spread: float) -> Floats:
    """(N,) px, standard uncertainty of centres for what smoothing along the line does to them.

    The two parts of the shift add up or cancel, by how the line is read: a centroid moves by
    s² (v''/2 + v' F'/F), a ridge, whose normal leans where its light rises, by
    s² (v''/2 - v' F'/F).  They count as independent.  Their squares, of noisy derivatives, are too
    large by the square of what these are uncertain by, on average, which is taken off; 0 where
    nothing is left, and where the line is too short for either.

    Parameters
    ----------
    stripe, light : as of ``correct_blur``
    spread : float, px², variance of the smoothing
    """
    parts, sigma = _shift(stripe, light, spread)
    squares = (parts**2).sum(axis=0) - sigma**2
    return np.sqrt(np.maximum(np.nan_to_num(squares), 0.0))


def correction_gain(wave_rad_per_px: Floats | float, blur_px: float) -> Floats:
    """Gain of ``correct_blur`` on waves of small slope of an evenly bright line without a gap.

    1 - s² q(w), where q is what the local quadratics take for half of the curvature of cos(w u):
    -w²/2 of long waves, to which the blur's own gain of 1 - s² w²/2 is the inverse; of waves
    shorter than the quadratics' reach it is less.

    Parameters
    ----------
    wave_rad_per_px : array or float, rad/px, along the line
    blur_px : float, px, that the line was corrected for
    """
    powers, inverses = _quadratics()
    steps, weights = powers[:, 1], powers @ inverses[-1][2]
    half_curvature = np.cos(np.asarray(wave_rad_per_px)[..., np.newaxis] * steps) @ weights
    return np.asarray(1 - (blur_px**2 + PIXEL_VARIANCE) * half_curvature)


def line_flux(stripe: Stripe, light: GreyValues) -> Floats:
    """(N,) light within FLUX_REACH_PX of the line in each column, DN; NaN where there is none.

    Parameters
    ----------
    stripe : Stripe, px, of N entries
    light : (N, L) array, DN, as in ``correct_blur``; a column's background is its median
    """
    valued = np.flatnonzero(has_value(stripe.status))
    steps = np.arange(-FLUX_REACH_PX, FLUX_REACH_PX + 1)
    rows = np.rint(stripe.centre_px[valued]).astype(int)
    place = rows[:, None] + steps
    inside = (place >= 0) & (place < light.shape[1])  # beyond the picture there is no light
    above = windows(light, valued, rows, steps) - medians(light[valued])[:, None]
    total = (above * inside).sum(axis=1)
    flux = np.full(len(stripe.status), np.nan)
    flux[valued] = np.where(total > 0, total, np.nan)
    return flux


def _derivatives(values: Floats, sigma: Floats, run: Ints) -> tuple[Floats, Floats]:
    """(N, 3) value, first and half second derivative by column, and their covariances (N, 3, 3).

    They are those of the local quadratics through (N,) values of standard uncertainty ``sigma``,
    which are taken to scatter by no less than they do about the quadratic; NaN where the line is
    too short.
    """
    steps = np.arange(-REACH_PX, REACH_PX + 1)
    powers, inverses = _quadratics()
    inside, used = neighbours(run, steps)
    used &= np.isfinite(values)[inside]
    count = used.sum(axis=1)
    inverse = inverses[used @ (1 << np.arange(len(steps)))]
    window = np.where(used, values[inside], 0.0)
    fitted = np.einsum("nij,nj->ni", inverse, window @ powers)
    residual = np.where(used, window - fitted @ powers.T, 0.0)
    scatter = (residual**2).sum(axis=1) / np.maximum(count - 3, 1)
    stated = np.where(used, sigma[inside] ** 2, 0.0).sum(axis=1) / np.maximum(count, 1)
    covariance = inverse * np.maximum(scatter, stated)[:, None, None]
    return fitted, covariance


@lru_cache(maxsize=1)
def _quadratics() -> tuple[Floats, Floats]:
    """(n, 3) powers of the steps, and (2^n, 3, 3) inverse normal matrices of their subsets.

    Bit k of a subset's number says whether step k is used.  NaN: fewer than FEWEST_COLUMNS are.
    """
    steps = np.arange(-REACH_PX, REACH_PX + 1)
    powers = np.stack([steps**power for power in range(3)], axis=-1).astype(float)
    used = np.arange(1 << len(steps))[:, None] >> np.arange(len(steps)) & 1
    good = used.sum(axis=1) >= FEWEST_COLUMNS
    inverses = np.full((len(used), 3, 3), np.nan)
    inverses[good] = np.linalg.inv(np.einsum("sk,ki,kj->sij", used[good], powers, powers))
    return powers, inverses


def _shift(stripe: Stripe, light: GreyValues, spread: float) -> tuple[Floats, Floats]:
    """(2, N) displacement of the line by a blur of variance ``spread``, px, and its uncertainty.

    By slope times change of brightness, and by concavity; NaN where the line is too short.
    """
    run, flux = pieces(stripe), line_flux(stripe, light)
    of_centre, centre_covariance = _derivatives(stripe.centre_px, stripe.sigma_px, run)
    of_flux, flux_covariance = _derivatives(flux, np.zeros_like(flux), run)
    _, slope, half_curvature = of_centre.T
    level, rise, half_bend = of_flux.T
    level = np.where(level > 0, level, np.nan)
    relative = rise / level
    by_centre = np.stack([np.zeros_like(slope), relative, np.ones_like(slope)], axis=-1)
    by_flux = np.stack([-slope * relative, slope, np.zeros_like(slope)], axis=-1) / level[:, None]
    variance = np.einsum("ni,nij,nj->n", by_centre, centre_covariance, by_centre)
    variance += np.einsum("ni,nij,nj->n", by_flux, flux_covariance, by_flux)
    next_term = spread**2 * half_curvature * 2 * half_bend / level
    parts = spread * np.array([slope * relative, half_curvature])
    return parts, np.sqrt(spread**2 * variance + next_term**2)


# Robust smoothing along the line, for those who want less scatter than resolution.


_REACH = 3  # standard deviations of the weight at which neighbours are left out
_TUKEY = 4.685
"""Residual, in robust standard deviations, beyond which a column has no weight: Tukey's
biweight with 95 % efficiency for normal errors (Holland & Welsch, Commun. Stat. A 6, 813,
1977)."""
_ROUNDS = 5
_FEWEST = 6  # neighbours, itself included: twice the three unknowns of a parabola
_MAD = 1.4826  # of the median absolute deviation, for the standard deviation of a normal


def smooth(stripe: Stripe, smooth_px: float, shared_columns: int = 1) -> Stripe:
    """The stripe with each centre replaced by that of a parabola fitted to its neighbours.

    Every column has its own local quadratic regression, weighted by the distance, the columns' own
    sigma_px and Tukey's biweight of the residuals.  Neighbours beyond a gap or a jump (peaks.py)
    have no part in it, and a column with fewer than six stays as it is.

    sigma_px is that of the regression, for columns whose errors are alike the less the farther
    apart they are, and independent from ``shared_columns`` on.  Neighbours within some smooth_px
    of each other then share most of their error, so the mean of n of them is no better than that
    of n / (3.5 smooth_px).  It leaves out what a parabola cannot follow.

    Parameters
    ----------
    stripe : Stripe, px
    smooth_px : float, px, standard deviation of the Gaussian weight along the line; 0 changes
        nothing
    shared_columns : int, 1: each column has errors of its own

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
    alike = np.maximum(1 - np.abs(step - step[:, None]) / shared_columns, 0.0)
    place, spread = _local_parabola(step / smooth_px, centre, sigma, weight, near, alike)
    centre_px, sigma_px = stripe.centre_px.copy(), stripe.sigma_px.copy()
    centre_px[fitted], sigma_px[fitted] = place, spread
    return replace(stripe, centre_px=centre_px, sigma_px=sigma_px)


def _local_parabola(
    step: Floats, centre: Floats, sigma: Floats, weight: Floats, near: Mask, alike: Floats
) -> tuple[Floats, Floats]:
    """Value and standard uncertainty, (K,) each in px, of K parabolas in their middles.

    step: (n,) distance of the neighbours.  centre, sigma, weight: (K, n), px, px and px^-2.
    near: (K, n) mask of the neighbours there are.  alike: (n, n) correlation of their errors.
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
    pulled = influence * sigma
    variance = (pulled @ alike * pulled).sum(axis=1) * np.maximum(scale[:, 0], 1.0) ** 2
    return value, np.sqrt(variance)
