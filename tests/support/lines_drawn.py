"""Gaussian lines drawn into pictures, each pixel the integral of the light over it."""

import numpy as np
from scipy.special import ndtr
from scipy.stats import norm


def psi(t):
    """Integral of the normal distribution function."""
    return t * norm.cdf(t) + norm.pdf(t)


def drawn(centre, width_px, height, amplitude=100.0):
    """(H, W) DN of a line at rows ``centre`` (W,) that is ``amplitude`` (number or (W,)) high."""
    edges = np.arange(height + 1)[:, None] - 0.5
    return (
        amplitude
        * width_px
        * np.sqrt(2 * np.pi)
        * np.diff(ndtr((edges - centre) / width_px), axis=0)
    )


def lit_share(width, start, end, blur_px):
    """(W,) share of light of each column of a line from ``start`` to ``end``, blurred."""
    column = np.arange(width)

    def below(place):
        near, far = (place - column + 0.5) / blur_px, (place - column - 0.5) / blur_px
        return blur_px * (psi(near) - psi(far))

    return below(end) - below(start)


def speckled(light, contrast, rng, read_dn=1.5, ground_dn=10.0):
    """The picture as a camera without clipping gives it: speckle, reading noise, rounding."""
    pattern = rng.gamma(contrast**-2, contrast**2, light.shape) if contrast else 1.0
    return np.rint(light * pattern + ground_dn + rng.normal(0, read_dn, light.shape))
