"""The log-parabola: of a Gaussian the logarithm is a parabola, whose vertex is the centre."""

from typing import cast

import numpy as np

from lscan.records import Floats
from lscan.stripe.extractors.rules import LineLight, extractor

_DYNAMIC = 10.0
"""Of the logarithm: what a parabola puts farther below the peak has no weight to speak of."""

_TRACE = 1e-10


@extractor
def gaussian(seen: LineLight) -> tuple[Floats, Floats]:
    """The line by a parabola through the logarithms of the light about each column's peak.

    Weighted least squares over the pixels within two widths, or as far beyond as there are
    clipped ones, which are left out: the logarithm of light I with the variance V has the
    variance V / I², so each pixel has the weight I² / V.  The weights come from the pixels
    first, then from the parabola found, as noisy weights prefer what noise made bright; the
    derivative holds them fixed.  Light below its own deviation counts as that: its logarithm says
    no more.  See rules.py.

    Parameters
    ----------
    image : (H, W) array, DN, grey values
    settings : StripeSection, threshold and span
    clipped : (H, W) mask, of the pixels that may have seen more light than they say

    References
    ----------
    H. Guo, IEEE Signal Processing Magazine 28(5), 134 (2011).
    """
    reach = np.maximum(1, np.rint(2 * seen.width_px)) + seen.clipped.sum(axis=1) / 2
    near = (np.abs(seen.steps) <= reach[:, None]) & ~seen.clipped
    deviation = np.sqrt(seen.noise.variance(seen.light))
    light = np.maximum(seen.light, deviation)
    x = seen.steps / seen.width_px[:, None]  # of order 1, for the sake of the inverse
    powers = x[:, None, :] ** np.arange(3)[None, :, None]
    gain = _gain(powers, near * (light / deviation) ** 2)
    most = np.log(light.max(axis=1, keepdims=True))
    parabola = (_coefficients(gain, light)[:, None] @ powers)[:, 0]
    fitted = np.exp(np.clip(parabola, most - _DYNAMIC, most))
    gain = _gain(powers, near * fitted**2 / seen.noise.variance(fitted))
    _, slope, bend = _coefficients(gain, light).T
    bend = np.where((bend < 0) & (near.sum(axis=1) >= 3), bend, np.nan)
    vertex = -slope / (2 * bend)
    by_log = -(gain[:, 1] + 2 * vertex[:, None] * gain[:, 2]) / (2 * bend[:, None])
    width = seen.width_px
    return vertex * width, by_log * width[:, None] / light


def _gain(powers: Floats, weight: Floats) -> Floats:
    """(K, 3, n) the parabola's coefficients by each logarithm, in weighted least squares."""
    weighted = powers * weight[:, None]
    normal = weighted @ powers.transpose(0, 2, 1)
    # Fewer than three pixels determine no parabola: this keeps it flat, and changes no other.
    normal += _TRACE * np.eye(3) * (1 + np.trace(normal, axis1=1, axis2=2))[:, None, None]
    return cast(Floats, np.linalg.solve(normal, weighted))


def _coefficients(gain: Floats, light: Floats) -> Floats:
    """(K, 3) coefficients of the parabola through the logarithms of ``light`` (K, n)."""
    coefficients: Floats = (gain @ np.log(light)[..., None])[..., 0]
    return coefficients
