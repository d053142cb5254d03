"""Gaussian lines drawn into pictures, each pixel the integral of the light over it."""

import numpy as np
from scipy.special import ndtr
from scipy.stats import norm

from lscan.records import Floats


def psi(t: Floats) -> Floats:
    """Integral of the normal distribution function."""
    return np.asarray(t * norm.cdf(t) + norm.pdf(t))


def drawn(
    centre: Floats | float, width_px: float, height: int, amplitude: Floats | float = 100.0
) -> Floats:
    """(H, W) DN of a line at rows ``centre`` (W,) that is ``amplitude`` (number or (W,)) high."""
    edges = np.arange(height + 1)[:, None] - 0.5
    line = np.diff(ndtr((edges - centre) / width_px), axis=0)
    return np.asarray(amplitude * width_px * np.sqrt(2 * np.pi) * line)


def lit_share(width: int, start: float, end: float, blur_px: float) -> Floats:
    """(W,) share of light of each column of a line from ``start`` to ``end``, blurred."""
    column = np.arange(width, dtype=float)

    def below(place: float) -> Floats:
        near, far = (place - column + 0.5) / blur_px, (place - column - 0.5) / blur_px
        return blur_px * (psi(near) - psi(far))

    return below(end) - below(start)


def speckled(
    light: Floats,
    contrast: float,
    rng: np.random.Generator,
    read_dn: float = 1.5,
    ground_dn: float = 10.0,
) -> Floats:
    """The picture as a camera without clipping gives it: speckle, reading noise, rounding."""
    pattern = rng.gamma(contrast**-2, contrast**2, light.shape) if contrast else 1.0
    return np.rint(light * pattern + ground_dn + rng.normal(0, read_dn, light.shape))
