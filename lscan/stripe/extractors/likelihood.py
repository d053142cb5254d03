"""The extractor that makes the most of the pixels: maximum likelihood of a Gaussian line."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.ndimage import median_filter

from lscan.config.rig import StripeSection
from lscan.records import GreyValues, Ints, Mask, Status, Stripe
from lscan.stripe.api import Picture, on_integers, together
from lscan.stripe.crosssection import CENTRE, LN_WIDTH, TILT
from lscan.stripe.extractors.survey import Survey, surveys, weak_precision
from lscan.stripe.fit import LineFit, fit_lines
from lscan.stripe.noise.model import robust_variance
from lscan.stripe.peaks import centred, clipped_near
from lscan.stripe.scoring import LinePrior, LineSearch

_NEIGHBOURS = 31
_FEWEST_TRIPLES = 16
_FOREIGN = 3.0
"""Misfit of a column beyond which something other than noise is in it: chi-square over its
degrees of freedom, a dozen at least, passes 3 by chance once in a thousand times."""


def _several(pictures: Sequence[Picture]) -> list[Stripe]:
    """:func:`maximum_likelihood` of several pictures, whose lines are fitted together."""
    seen = surveys(pictures)
    searches = []
    for one in seen:
        if isinstance(one, Survey):
            precision = weak_precision(one.start)
            precision[:, LN_WIDTH] = 1 / one.ln_width.spread**2
            precision[:, TILT] = 1 / one.tilt.spread**2
            prior = LinePrior(one.start, precision)
            searches.append(LineSearch(one.view, one.start, one.noise, prior))
    fits = iter(fit_lines(searches) if searches else [])
    return [
        _marked(_stripe(one, next(fits)), *picture) if isinstance(one, Survey) else one
        for one, picture in zip(seen, pictures, strict=True)
    ]


@on_integers
@together(_several)
def maximum_likelihood(image: GreyValues, settings: StripeSection, clipped: Mask) -> Stripe:
    """The line by maximum likelihood in each column of a picture.

    A Gaussian averaged over each pixel on a sloping ground (crosssection.py) under reading noise,
    shot noise and speckle; a clipped pixel says "at least this".  Width and slope are free, but
    held to the median of the neighbouring columns as far as those agree with one another: where a
    column alone does not determine them, they do.

    sigma_px follows from Fisher's information, and from what the line differs from a Gaussian
    alike in neighbouring columns (noise/scatter.py), carried through the fit.  Where the pixels
    scatter about the line more than the noise explains it grows by the root of that ratio
    (Birge 1932): the neighbours' median of it, and the column's own where beyond chance.
    SATURATED columns have been allowed for.  Too few of their pixels are left to estimate the
    noise by: unless that is stated, their sigma_px is at least what their centres scatter
    from one column to the next.  NO_PEAK also where no line can be fitted.

    Parameters
    ----------
    image : (H, W) array, DN, grey values
    settings : StripeSection, threshold, span and noise
    clipped : (H, W) mask, of the pixels at the end of the camera's range

    References
    ----------
    The bound that it approaches: docs/explanation/physics.md, section 4.
    """
    return _several([(image, settings, clipped)])[0]


def _marked(stripe: Stripe, image: GreyValues, settings: StripeSection, clipped: Mask) -> Stripe:
    """The stripe with its clipped columns SATURATED."""
    saturated = clipped_near(stripe, clipped.T, settings.span_px)
    status, sigma_px = stripe.status.copy(), stripe.sigma_px.copy()
    status[saturated] = Status.SATURATED
    if settings.noise is None:
        sigma_px[saturated] *= _scatter(stripe, saturated)
    return replace(stripe, status=status, sigma_px=sigma_px)


def _scatter(stripe: Stripe, at: Ints) -> float:
    """Scatter of the centres of the columns ``at`` over that by sigma_px, 1 at least.

    By second differences, which take out the line's slope.  1 for fewer than 16 triples.
    """
    first = at[:-2][(at[2:] - at[:-2]) == 2]
    if len(first) < _FEWEST_TRIPLES:
        return 1.0
    weights = np.array([1.0, -2.0, 1.0])
    triples = first[:, None] + np.arange(3)
    stated = np.sqrt((stripe.sigma_px[triples] ** 2) @ weights**2)
    return max(float(np.sqrt(robust_variance(stripe.centre_px[triples] @ weights / stated))), 1.0)


def _stripe(seen: Survey, fit: LineFit) -> Stripe:
    """The survey's stripe with the centres of the fit."""
    offset = fit.parameters[:, CENTRE]
    common = median_filter(fit.misfit, _NEIGHBOURS, mode="nearest")
    own = np.where(fit.misfit > _FOREIGN, fit.misfit, 1.0)
    excess = np.maximum(np.maximum(common, own), 1.0)
    misfit = (fit.gain**2 * (seen.misfit * fit.light) ** 2).sum(axis=1)
    sigma = np.sqrt(fit.covariance[:, CENTRE, CENTRE] * excess + misfit)
    kept = fit.settled & seen.is_near(offset, sigma)
    return centred(seen.stripe, seen.peaks, offset, sigma, kept)
