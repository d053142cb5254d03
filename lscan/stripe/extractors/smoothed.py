"""The peak of the smoothed column, by a parabola through three values about it."""

import numpy as np

from lscan.records import Floats
from lscan.stripe.extractors.rules import LineLight, extractor

_APART = 0.5  # the three values', in widths of the line


@extractor
def smoothed_peak(seen: LineLight) -> tuple[Floats, Floats]:
    """The line at the peak of each column smoothed with the line's own width.

    A Gaussian as wide as the line is its matched filter: of all filters it raises the peak
    most above the noise.  The smoothed column is a function of any place, not of pixels alone,
    so the three values may be closer together than pixels: half a width.  See rules.py.

    Parameters
    ----------
    image : (H, W) array, DN, grey values
    settings : StripeSection, threshold and span
    clipped : (H, W) mask, of the pixels that may have seen more light than they say
    """
    apart = _APART * seen.width_px
    middle = _highest(seen)
    kernels = _kernel(seen, (np.arange(-1, 2) + middle[:, None]) * apart[:, None])  # (K, 3, n)
    before, peak, after = (kernels @ seen.light[..., None])[..., 0].T
    bend = before - 2 * peak + after
    bend = np.where(bend < 0, bend, np.nan)
    vertex = (before - after) / (2 * bend)
    by_value = np.stack([0.5 - vertex, 2 * vertex, -0.5 - vertex], axis=1) / bend[:, None]
    derivative = (by_value[:, :, None] * kernels).sum(axis=1) * apart[:, None]
    return (middle + vertex) * apart, derivative


def _highest(seen: LineLight) -> Floats:
    """(K,) place, in steps of half a width, of the highest value near the middle pixel."""
    reach = int(np.ceil(np.max((seen.width_px + 2) / (_APART * seen.width_px))))
    places = np.arange(-reach, reach + 1, dtype=float)
    kernels = _kernel(seen, places * _APART * seen.width_px[:, None])
    smooth = (kernels @ seen.light[..., None])[..., 0]
    return places[smooth.argmax(axis=1)]


def _kernel(seen: LineLight, places: Floats) -> Floats:
    """Weights (K, P, n) of the pixels in the smoothed values at ``places`` (K, P)."""
    width = seen.width_px[:, None, None]
    distance = (seen.steps - places[:, :, None]) / width
    return np.where(np.abs(distance) <= 4, np.exp(-0.5 * distance**2), 0.0)
