"""Steger's detector: the line as a ridge of the picture smoothed in both directions.

Unlike the extractors that look at one column at a time it knows the line's direction, so it
smooths along the line as well as across it, and a steep line is smoothed across its own normal
and not along the column.
"""

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d
from scipy.special import ndtr

from lscan.config.rig import StripeSection
from lscan.records import Floats, GreyValues, Ints, Mask, Status, Stripe
from lscan.stripe.api import along_the_line, on_integers
from lscan.stripe.loops.centre import ridge_crossings
from lscan.stripe.peaks import crests, line_width, medians, pieces, windows
from lscan.stripe.picture import line_noise, stated_noise

_REACH = 4  # standard deviations at which the Gaussian kernels end
_FINEST_PX = 1.0  # a Gaussian less wide lets the pixels' raster through


@along_the_line
@on_integers
def steger(image: GreyValues, settings: StripeSection, clipped: Mask) -> Stripe:
    """The line where the ridge of the smoothed picture crosses each column.

    The ridge is where the derivative across the line vanishes; across is the direction in
    which the picture bends down most, the eigenvector of its Hessian (Steger's eq. 11).
    The Gaussian is as wide as the line (peaks.py), which is the matched filter for a Gaussian
    line in white noise, and integrated over the pixels as in Steger's sec. 2.3.  Between two
    rows the derivative, divided by the picture itself, is interpolated linearly: for a
    Gaussian line that is exact, where Steger's parabola errs by a tenth of a pixel.  Within
    four line widths of an end, beyond which there is nothing to smooth with, a sloping ridge
    is drawn aside: there each column is smoothed by itself.

    NO_PEAK and AT_BORDER as the paper's extractors have them, the latter also within two line
    widths of the edge; NO_PEAK too where the line runs along the column.

    sigma_px is the pixels' noise carried through the derivative of the crossing: reading
    noise, photons and speckle of ``settings.noise``, or what picture.py estimates.
    Neighbouring columns share their noise over about a line's width.  What smoothing does where the
    line bends, or slopes and changes its brightness, ``extract_stripe`` adds (scatter.py).

    Parameters
    ----------
    image : (H, W) array, DN, grey values
    settings : StripeSection, threshold, span and noise
    clipped : (H, W) mask, not looked at: the flat top of a clipped line becomes round by the
        smoothing

    References
    ----------
    C. Steger, "An unbiased detector of curvilinear structures", IEEE Trans. Pattern Anal. Mach.
    Intell. 20, 113 (1998).
    """
    columns = np.require(image.T, None, ["C", "W"])  # see likelihood.py
    base = medians(columns)
    peak = columns.max(axis=1) - base
    status = np.where(peak > settings.threshold_dn, int(Status.OK), int(Status.NO_PEAK))
    empty = np.full(len(columns), np.nan)
    stripe = Stripe("columns", empty, empty.copy(), peak, status)
    lit = np.flatnonzero(status == Status.OK)
    if len(lit) == 0:
        return stripe
    crest = crests(columns)[lit]
    width = line_width(columns, lit, crest, settings.line_width_px)
    scale = max(width, _FINEST_PX)
    room = 2 * int(np.ceil(_REACH * scale)) + 4  # for the kernels beyond the line
    rows = slice(max(int(crest.min()) - room, 0), int(crest.max()) + room + 1)
    reach = int(np.ceil(2 * width))
    at_crest = windows(columns, lit, crest, reach) - base[lit, None]
    light = columns[:, rows] - base[:, None]
    if settings.noise is None:
        noise = line_noise(columns, at_crest, lit)
    else:
        noise = stated_noise(settings.noise, float(medians(columns.reshape(1, -1))[0]))
    terms = np.array([noise.constant, noise.per_dn, noise.speckle])
    bells = _kernels(scale)
    _place(stripe, ridge_crossings(light, terms, lit, settings.threshold_dn, bells, bells), lit)
    ends = _near_ends(stripe, lit, scale)
    if len(ends):
        alone = np.array([[1.0], [0.0], [0.0]])  # each column is smoothed by itself
        crossings = ridge_crossings(light, terms, ends, settings.threshold_dn, alone, bells)
        _place(stripe, crossings, ends)
    stripe.centre_px[:] += rows.start
    row, border_px = np.rint(stripe.centre_px[lit]), max(settings.span_px, reach)
    cut = lit[(row < border_px) | (row >= columns.shape[1] - border_px)]
    stripe.status[cut] = Status.AT_BORDER
    stripe.centre_px[cut] = stripe.sigma_px[cut] = np.nan
    return stripe


def _kernels(scale: float) -> Floats:
    """(3, n) of the Gaussian and its first two derivatives, each integrated over every pixel."""
    reach = int(np.ceil(_REACH * scale)) + 1
    edges = np.arange(-reach, reach + 2) - 0.5
    density = np.exp(-((edges / scale) ** 2) / 2) / (np.sqrt(2 * np.pi) * scale)
    smoothing = np.diff(ndtr(edges / scale))
    # The filter correlates, which turns the sign of the odd one.
    return np.array([smoothing, -np.diff(density), np.diff(-edges / scale**2 * density)])


def _place(stripe: Stripe, crossings: tuple[Floats, Floats], lit: Ints) -> None:
    """Write the crossings of K columns into the stripe; NO_PEAK where there is none."""
    stripe.centre_px[lit], stripe.sigma_px[lit] = crossings
    found = np.isfinite(crossings[0])
    stripe.status[lit] = np.where(found, int(Status.OK), int(Status.NO_PEAK))


def _near_ends(stripe: Stripe, lit: Ints, scale: float) -> Ints:
    """The lit columns so near to an end of their piece that the kernel reaches beyond it."""
    label = pieces(stripe)
    size = 2 * int(np.ceil(_REACH * scale)) + 1
    low = minimum_filter1d(label, size, mode="constant", cval=-1)  # nothing beyond the picture
    high = maximum_filter1d(label, size, mode="constant", cval=-1)
    return lit[(low != high)[lit]]
