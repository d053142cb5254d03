"""The extractor that makes the most of the pixels: maximum likelihood of a Gaussian line."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.ndimage import median_filter

from lscan.config.rig import StripeSection
from lscan.records import Floats, GreyValues, Ints, Mask, Status, Stripe
from lscan.stripe.api import Picture, on_integers, together
from lscan.stripe.extractors.survey import Survey, surveys, weak_precision
from lscan.stripe.fit import CENTRE, LN_WIDTH, TILT, LineFit, LinePrior, LineSearch, fit_lines
from lscan.stripe.noise import robust_variance
from lscan.stripe.peaks import centred, clipped_near

_NEIGHBOURS = 31
_FEWEST_TRIPLES = 16
_FOREIGN = 3.0
"""Misfit of a column beyond which something other than noise is in it: chi-square over its
degrees of freedom, a dozen at least, passes 3 by chance once in a thousand times."""
_CREST = 1.5  # widths from its brightest pixel, where a line has a third of its height
_SURE = 1e6  # precision in px²/DN² of a slope that so few pixels do not tell


def _several(pictures: Sequence[Picture]) -> list[Stripe]:
    """:func:`maximum_likelihood` of several pictures, whose lines are fitted together."""
    seen = surveys(pictures)
    each = zip(seen, pictures, strict=True)
    known = [(one, picture[1]) for one, picture in each if isinstance(one, Survey)]
    surveyed = [one for one, _ in known]
    searches = [_search(one) for one in surveyed]
    fits = fit_lines(searches) if searches else []
    at = [_foreign(one, fit, of) for one, fit, (_, of) in zip(searches, fits, known, strict=True)]
    crests = _crests(surveyed, searches, at)
    found = map(_stripe, surveyed, fits, crests)
    return [
        _marked(next(found), *picture) if isinstance(one, Survey) else one
        for one, picture in zip(seen, pictures, strict=True)
    ]


def _search(seen: Survey) -> LineSearch:
    """What the lines of a picture are fitted to, their width and ground held to the neighbours'."""
    precision = weak_precision(seen.start)
    precision[:, LN_WIDTH] = 1 / seen.ln_width.spread**2
    precision[:, TILT] = 1 / seen.tilt.spread**2
    return LineSearch(seen.view, seen.start, seen.noise, LinePrior(seen.start, precision))


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
    Where that is a column's own and the noise is stated, as beside light that ends at the line, it
    also grows by as far as the line's crest alone lies from the whole line.
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


def _crests(
    seen: Sequence[Survey], searches: Sequence[LineSearch], at: Sequence[Ints]
) -> list[Floats]:
    """(K,) centre in px from the peak by each line's crest alone, NaN where the whole line will do.

    at: numbers of the lines with something beside them, as light of a surface that begins there,
    or the line of another surface where the target has a step.
    """
    parts = [_crest(*one) for one in zip(seen, searches, at, strict=True) if len(one[-1])]
    found = iter(fit_lines(parts) if parts else [])
    crests = [np.full(len(search.start), np.nan) for search in searches]
    for crest, chosen in zip(crests, at, strict=True):
        if len(chosen):
            fit = next(found)
            crest[chosen] = np.where(fit.settled, fit.parameters[:, CENTRE], np.nan)
    return crests


def _foreign(search: LineSearch, fit: LineFit, settings: StripeSection) -> Ints:
    """Numbers of the fitted lines with something beside them that their neighbours do not have.

    None of them is clipped.  There are none where the noise is not known: it is then taken from
    pixels beside lines as well, and on a lit target texture would count for more than lines.
    """
    if settings.noise is None:
        return np.zeros(0, dtype=np.int64)
    clipped = (search.view.clipped & search.view.used).any(axis=1)
    unlike = fit.misfit > _FOREIGN * np.maximum(_common(fit), 1.0)
    return np.flatnonzero(fit.settled & unlike & ~clipped)


def _common(fit: LineFit) -> Floats:
    """(K,) misfit that a column has in common with its neighbours."""
    return np.asarray(median_filter(fit.misfit, _NEIGHBOURS, mode="nearest"))


def _crest(seen: Survey, search: LineSearch, at: Ints) -> LineSearch:
    """The search for some lines in the pixels about the brightest one, on a slope that is known."""
    part = search.of(at)
    view, aside = part.view, np.abs(part.view.steps)
    within = view.used & (aside <= seen.reach_px[at][:, None])
    middle = view.steps[np.where(within, view.grey, -np.inf).argmax(axis=1)][:, None]
    reach = np.ceil(_CREST * seen.width_px[at])[:, None]
    start, precision = part.start.copy(), part.prior.precision.copy()
    start[:, [CENTRE]] = middle
    precision[:, TILT] = _SURE
    view = replace(view, used=view.used & (np.abs(view.steps - middle) <= reach))
    return LineSearch(view, start, part.noise, LinePrior(start, precision))


def _stripe(seen: Survey, fit: LineFit, crest: Floats) -> Stripe:
    """The survey's stripe with the centres of the fit, which may lie as far off as crests do."""
    offset = fit.parameters[:, CENTRE]
    own = np.where(fit.misfit > _FOREIGN, fit.misfit, 1.0)
    excess = np.maximum(np.maximum(_common(fit), own), 1.0)
    misfit = (fit.gain**2 * (seen.misfit * fit.light) ** 2).sum(axis=1)
    doubt = np.where(np.isnan(crest), 0.0, crest - offset) ** 2 / 3  # a uniform distribution's
    sigma = np.sqrt(fit.covariance[:, CENTRE, CENTRE] * excess + misfit + doubt)
    kept = fit.settled & seen.is_near(offset, sigma)
    return centred(seen.stripe, seen.peaks, offset, sigma, kept)
