"""The stripe extractors of the paper: brightest pixel, centroid, centroid of relative values.

All three start from the nominal peak of each column, the first maximum from the top, and
look at the window of ``span_px`` pixels on either side of it (Sec. V.B).  They differ only in
how far from the nominal peak they put the centre of the line:

- ``maximum``: at the nominal peak itself;
- ``centroid``: eq. (8) with the grey values as weights;
- ``centroid_relative``: eq. (8) with the smallest grey value of the window subtracted first.

None of them takes account of which pixels are clipped.
"""

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from lscan.config.rig import StripeSection
from lscan.records import Floats, GreyValues, Ints, Mask, Stripe
from lscan.stripe.api import Picture, Several, on_integers, together
from lscan.stripe.noise.model import line_noise
from lscan.stripe.peaks import centred, nominal_peaks, windows_beside
from lscan.stripe.sidebyside import in_one, parted

Centring = Callable[[Floats], tuple[Floats, Floats]]
"""From windows (K, n) of grey values to the line's offset (K,) from the middle pixel, in px,
and the derivative (K, n) of that offset by each grey value, in px/DN."""


def _by(centring: Centring, guesses_background: bool = False) -> Several:
    """The extractor of a rule, of pictures side by side where they are alike."""
    work = partial(_alike, centring=centring, guesses_background=guesses_background)
    return partial(in_one, work, kind=lambda picture: (picture[1], picture[0].shape))


def _alike(
    pictures: Sequence[Picture], centring: Centring, guesses_background: bool
) -> list[Stripe]:
    """The stripes of pictures of one size with the same settings.

    A column has a line where its highest value exceeds its median by more than
    ``threshold_dn``: NO_PEAK otherwise, AT_BORDER where the window does not fit the picture.

    sigma_px combines the noise of the pixels (noise/model.py), carried through the derivative of
    the centre; the choice of the nominal peak; and, where the rule ``guesses_background``
    from the window, that guess.  For a Gaussian line the last two are the size of what the
    window cuts off; a line wider than the span, whose crest is flat, has sigma_px too large.
    Fast where ``image.T`` is contiguous in memory.
    """
    columns = [np.ascontiguousarray(image.T) for image, _, _ in pictures]
    settings = pictures[0][1]
    stripe, peaks = nominal_peaks(columns, settings)
    if len(peaks.columns) == 0:
        return parted(stripe, len(pictures))
    # One pixel wider than the window on either side, to try the neighbour as nominal peak.
    wide = windows_beside(columns, peaks.columns, peaks.rows, settings.span_px + 1)
    window = wide[:, 1:-1]
    light = window - peaks.base[:, None]
    variance = _variance(columns, light, peaks.columns)
    offset, slope = centring(window)
    variance_px = (slope**2 * variance).sum(axis=1)
    variance_px += _choice_variance(wide, offset, variance, centring)
    if guesses_background:
        variance_px += _background_variance(light, offset)

    # Only grey values that are negative can throw the centroid out of its window.
    kept = np.abs(offset) <= settings.span_px
    found = centred(stripe, peaks, offset, np.sqrt(variance_px), kept)
    return parted(found, len(pictures))


def _variance(pictures: Sequence[GreyValues], light: Floats, at: Ints) -> Floats:
    """Variance (K, n) in DN² of the light, by the noise of the picture that it was found in."""
    begin = np.searchsorted(at, np.arange(1, len(pictures)) * len(pictures[0]))
    known = zip(pictures, np.split(light, begin), np.split(at, begin), strict=True)
    return np.concatenate([line_noise(one, seen, to).variance(seen) for one, seen, to in known])


def _no_offset(window: Floats) -> tuple[Floats, Floats]:
    return np.zeros(len(window)), np.zeros_like(window)


def _centroid_offset(window: Floats) -> tuple[Floats, Floats]:
    """Eq. (8) about the middle pixel; NaN where the weights have no positive sum."""
    reach = window.shape[1] // 2
    steps = np.arange(-reach, reach + 1, dtype=float)
    total = window.sum(axis=1)
    total = np.where(total > 0, total, np.nan)
    offset = (window * steps).sum(axis=1) / total
    return offset, (steps - offset[:, None]) / total[:, None]


def _relative_offset(window: Floats) -> tuple[Floats, Floats]:
    each, lowest = np.arange(len(window)), window.argmin(axis=1)
    offset, slope = _centroid_offset(window - window[each, lowest][:, None])
    # The lowest pixel is taken off all weights, so it moves the centroid through all of them.
    slope[each, lowest] -= slope.sum(axis=1)
    return offset, slope


_maximum, _centroid = _by(_no_offset), _by(_centroid_offset)
_centroid_relative = _by(_relative_offset, guesses_background=True)


@on_integers
@together(_maximum)
def maximum(image: GreyValues, settings: StripeSection, clipped: Mask) -> Stripe:
    """The line at the brightest pixel of each column, the first from the top of several equal ones.

    Parameters
    ----------
    image : (H, W) array, DN, grey values
    settings : StripeSection, threshold and span; see :func:`_alike`
    clipped : (H, W) mask, not used by the rule

    References
    ----------
    Sec. V.B of the paper: the nominal peak.
    """
    return _maximum([(image, settings, clipped)])[0]


@on_integers
@together(_centroid)
def centroid(image: GreyValues, settings: StripeSection, clipped: Mask) -> Stripe:
    """The line at the centroid of the grey values about each column's nominal peak.

    A background within the window draws it to the nominal peak.

    Parameters
    ----------
    image : (H, W) array, DN, grey values
    settings : StripeSection, threshold and span; see :func:`_alike`
    clipped : (H, W) mask, not used by the rule

    References
    ----------
    Sec. V.B and eq. (8) of the paper.
    """
    return _centroid([(image, settings, clipped)])[0]


@on_integers
@together(_centroid_relative)
def centroid_relative(image: GreyValues, settings: StripeSection, clipped: Mask) -> Stripe:
    """The line at the centroid of the grey values above the smallest one in the window.

    Parameters
    ----------
    image : (H, W) array, DN, grey values
    settings : StripeSection, threshold and span; see :func:`_alike`
    clipped : (H, W) mask, not used by the rule

    References
    ----------
    Sec. V.B of the paper: eq. (8) with the relative intensities.
    """
    return _centroid_relative([(image, settings, clipped)])[0]


def _choice_variance(wide: Floats, offset: Floats, variance: Floats, centring: Centring) -> Floats:
    """Variance in px² (K,) that comes from the choice of the nominal peak.

    The paper notes that the result is sensitive to this choice.  It is measured: by how much
    the centre would move with the brighter neighbour as nominal peak (a whole pixel at
    most), times the number of pixels within two standard deviations of the peak, which might
    have been chosen as well.  That is the width of a uniform distribution.  For ``maximum``
    and a clear peak it is the width of a pixel; for a centroid whose window holds the whole
    line it vanishes; between them it accounts for the tails that the window cuts off.

    wide: (K, n + 2) windows with one more pixel on either side.  variance: (K, n) in DN².
    """
    middle = wide.shape[1] // 2
    below = wide[:, middle + 1] >= wide[:, middle - 1]
    neighbour = np.where(below[:, None], wide[:, 2:], wide[:, :-2])
    moved = np.where(below, 1.0, -1.0) + centring(neighbour)[0]
    step = np.fmin(np.abs(moved - offset), 1.0)  # a whole pixel too where it is NaN
    near = wide[:, [middle]] - 2 * np.sqrt(variance[:, [middle - 1]])
    candidates = (wide[:, 1:-1] >= near).sum(axis=1)
    width: Floats = candidates * step
    return width**2 / 12


def _background_variance(light: Floats, offset: Floats) -> Floats:
    """Variance in px² (K,) of a centre that took the window's smallest value for background.

    That value may be the line's own tail; the column's median is the guess that cannot be.
    The truth lies between the two centroids, rather near the one found than near the other:
    a triangular distribution, whose mean square about its high end is a sixth of its width's.

    light: (K, n) grey values above the column's median in DN.  offset: (K,) as found, in px.
    """
    other, _ = _centroid_offset(light)
    width: Floats = np.fmin(np.abs(other - offset), 1.0)
    return width**2 / 6
