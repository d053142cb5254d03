"""Steger's detector: the line as a ridge of the picture smoothed in both directions.

C. Steger, "An unbiased detector of curvilinear structures", IEEE Trans. Pattern Anal. Mach.
Intell. 20, 113 (1998).  Unlike the extractors that look at one column at a time it knows the
line's direction, so it smooths along the line as well as across it, and a steep line is
smoothed across its own normal and not along the column.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d
from scipy.special import ndtr

from lscan.config.rig import StripeSection
from lscan.records import Floats, GreyValues, Ints, Mask, Status, Stripe
from lscan.stripe.api import along_the_line, on_integers
from lscan.stripe.peaks import crests, line_width, medians, pieces, windows
from lscan.stripe.picture import line_noise, stated_noise

_REACH = 4  # standard deviations at which the Gaussian kernels end
_FINEST_PX = 1.0  # a Gaussian less wide lets the pixels' raster through
_DARK = 1e-9  # DN; what is not brighter has no ridge
_STEEPEST = 0.1
"""Least share of the line's normal that lies along the column: steeper than 84 degrees, the
line has no one crossing with it."""


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
    Neighbouring columns share their noise over about a line's width.  What is smoothed away where
    the line bends within its own width is no part of sigma_px.

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
    columns = np.ascontiguousarray(image.T)
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
    variance = noise.variance(light)
    smoothed = _both_ways(light, variance, scale)
    _place(stripe, smoothed, _crest(smoothed, light, lit, settings.threshold_dn), lit)
    ends = _near_ends(stripe, lit, scale)
    if len(ends):
        alone = _along_columns(light, variance, scale)
        _place(stripe, alone, _crest(alone, light, ends, settings.threshold_dn), ends)
    stripe.centre_px[:] += rows.start
    row, border_px = np.rint(stripe.centre_px[lit]), max(settings.span_px, reach)
    cut = lit[(row < border_px) | (row >= columns.shape[1] - border_px)]
    stripe.status[cut] = Status.AT_BORDER
    stripe.centre_px[cut] = stripe.sigma_px[cut] = np.nan
    return stripe


@dataclass(frozen=True)
class _Smoothed:
    """The smoothed picture, (W, H) each, one column of the picture a row.

    value: DN.  slope: its derivative across the line, DN/px, positive towards lower rows.
    variance: of the slope, DN²/px².  bend: second derivative across the line, DN/px², negative
    on a bright line.  across: the normal's part along the columns, 0 to 1.
    """

    value: Floats
    slope: Floats
    variance: Floats
    bend: Floats
    across: Floats


def _both_ways(light: Floats, variance: Floats, scale: float) -> _Smoothed:
    """The picture (W, H) in DN smoothed by a Gaussian of ``scale`` px, its ridges' direction free.

    variance: (W, H) of the pixels in DN², each pixel's noise its own.
    """
    g0, g1, g2 = _kernels(scale)
    by_u, by_v = _convolve(light, g1, g0), _convolve(light, g0, g1)
    uu, uv, vv = _convolve(light, g2, g0), _convolve(light, g1, g1), _convolve(light, g0, g2)
    bend = (uu + vv) / 2 - np.hypot((uu - vv) / 2, uv)
    # The eigenvector to the smaller eigenvalue is square to that to the larger one; its angle
    # lies between 0 and pi, so that ``across`` is never negative.
    angle = np.arctan2(2 * uv, uu - vv) / 2 + np.pi / 2
    along, across = np.cos(angle), np.sin(angle)
    slope = along * by_u + across * by_v
    spread: Floats = along**2 * _convolve(variance, g1**2, g0**2)
    spread += across**2 * _convolve(variance, g0**2, g1**2)
    spread += 2 * along * across * _convolve(variance, g0 * g1, g0 * g1)
    return _Smoothed(_convolve(light, g0, g0), slope, spread, bend, across)


def _along_columns(light: Floats, variance: Floats, scale: float) -> _Smoothed:
    """The same with each column smoothed by itself, the line taken to run square to it."""
    g0, g1, g2 = _kernels(scale)
    one = np.ones(1)
    bend, across = _convolve(light, one, g2), np.ones_like(light)
    spread = _convolve(variance, one, g1**2)
    return _Smoothed(_convolve(light, one, g0), _convolve(light, one, g1), spread, bend, across)


def _kernels(scale: float) -> tuple[Floats, Floats, Floats]:
    """The Gaussian and its first two derivatives, each integrated over every pixel."""
    reach = int(np.ceil(_REACH * scale)) + 1
    edges = np.arange(-reach, reach + 2) - 0.5
    density = np.exp(-((edges / scale) ** 2) / 2) / (np.sqrt(2 * np.pi) * scale)
    smoothing = np.diff(ndtr(edges / scale))
    # The filter correlates, which turns the sign of the odd one.
    return smoothing, -np.diff(density), np.diff(-edges / scale**2 * density)


def _convolve(picture: Floats, along: Floats, across: Floats) -> Floats:
    """(W, H) of the picture filtered along u and along v; beyond its edges there is no light."""
    border = cv2.BORDER_CONSTANT
    return np.asarray(cv2.sepFilter2D(picture, cv2.CV_64F, across, along, borderType=border), float)


def _crest(smoothed: _Smoothed, light: Floats, lit: Ints, threshold_dn: float) -> Ints:
    """(K,) row where the picture bends most, across the line, in each lit column.

    Only rows whose own light or a neighbour's is above the threshold count: a stronger line
    that ends beside the column is smoothed into it.
    """
    near = cv2.dilate((light[lit] > threshold_dn).astype(np.uint8), np.ones((1, 3), np.uint8))
    return np.where(near > 0, smoothed.bend[lit], np.inf).argmin(axis=1)


def _place(stripe: Stripe, smoothed: _Smoothed, row: Ints, lit: Ints) -> None:
    """Write the crossings of K columns with the ridge near ``row`` into the stripe.

    The derivative must change its sign within two rows, else no ridge passes there: NO_PEAK.
    """
    height = smoothed.value.shape[1]
    above = np.clip(row[:, None] + np.arange(-2, 2), 0, height - 2)  # (K, 4), each with the next
    upper, lower = (
        smoothed.slope[lit[:, None], rows] / np.maximum(smoothed.value[lit[:, None], rows], _DARK)
        for rows in (above, above + 1)
    )
    falls = (upper > 0) & (lower <= 0)
    nearest = np.where(falls, np.abs(above + 0.5 - row[:, None]), np.inf).argmin(axis=1)
    each = np.arange(len(lit))
    upper, lower = upper[each, nearest], lower[each, nearest]
    found = falls[each, nearest] & (smoothed.across[lit, row] >= _STEEPEST)
    change = np.where(found, lower - upper, np.nan)  # of the slope over the value, in px^-2
    centre = above[each, nearest] - upper / change
    stripe.centre_px[lit] = centre
    error = np.sqrt(smoothed.variance[lit, row]) / np.maximum(smoothed.value[lit, row], _DARK)
    stripe.sigma_px[lit] = error / np.abs(change)
    stripe.status[lit] = np.where(found, int(Status.OK), int(Status.NO_PEAK))


def _near_ends(stripe: Stripe, lit: Ints, scale: float) -> Ints:
    """The lit columns so near to an end of their piece that the kernel reaches beyond it."""
    label = pieces(stripe)
    size = 2 * int(np.ceil(_REACH * scale)) + 1
    low = minimum_filter1d(label, size, mode="constant", cval=-1)  # nothing beyond the picture
    high = maximum_filter1d(label, size, mode="constant", cval=-1)
    return lit[(low != high)[lit]]
