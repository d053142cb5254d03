"""Blais and Rioux's peak detector: the zero crossing of a filtered derivative."""

import numpy as np

from lscan.records import Floats, Ints
from lscan.stripe.extractors.rules import LineLight, extractor


@extractor
def blais_rioux(seen: LineLight) -> tuple[Floats, Floats]:
    """The line where the derivative of each column's light crosses zero.

    The derivative is the sum of the m pixels above less that of the m below, with m nearest twice
    the line's width; between the two pixels where it changes sign it is taken as straight.
    See rules.py.

    Parameters
    ----------
    image : (H, W) array, DN, grey values
    settings : StripeSection, threshold and span
    clipped : (H, W) mask, of the pixels that may have seen more light than they say

    References
    ----------
    Blais and Rioux, Signal Processing 11, 145 (1986), who use orders 2 m of 2, 4 and 8.
    """
    taps = np.maximum(np.rint(2 * seen.width_px), 1).astype(int)
    filtered = _filtered(seen.light, taps)
    rises = (filtered[:, :-1] < 0) & (filtered[:, 1:] >= 0)
    inside = np.abs(seen.steps[:-1] + 0.5) <= np.ceil(2 * seen.width_px)[:, None] + 1
    distance = np.where(rises & inside, np.abs(seen.steps[:-1] + 0.5), np.inf)
    at = distance.argmin(axis=1)
    found = np.isfinite(distance.min(axis=1))
    every = np.arange(len(at))
    before, after = filtered[every, at], filtered[every, at + 1]
    rise = np.where(found, after - before, np.nan)
    share = -before / rise
    # d share = -[(1 - share) d before + share d after] / rise
    upper, lower = _taps(seen.steps, at, taps), _taps(seen.steps, at + 1, taps)
    derivative = -((1 - share)[:, None] * upper + share[:, None] * lower) / rise[:, None]
    return seen.steps[at] + share, derivative


def _filtered(light: Floats, taps: Ints) -> Floats:
    """(K, n) sum of the ``taps`` (K,) pixels above each one less that of those below."""
    n = light.shape[1]
    total = np.concatenate([np.zeros((len(light), 1)), light.cumsum(axis=1)], axis=1)
    place = np.arange(n)

    def up_to(end: Ints) -> Floats:
        return np.take_along_axis(total, np.clip(end, 0, n), axis=1)

    above = total[:, :-1] - up_to(place - taps[:, None])
    below = up_to(place + taps[:, None] + 1) - total[:, 1:]
    return above - below


def _taps(steps: Floats, at: Ints, taps: Ints) -> Floats:
    """Coefficients (K, n) of each pixel in the filter's output at pixel ``at`` (K,)."""
    distance = steps - steps[at][:, None]
    return np.where(np.abs(distance) <= taps[:, None], -np.sign(distance), 0.0)
