"""Pictures of Gaussian lines under a camera's noise, with their true centres."""

import numpy as np
from scipy.special import ndtr

from lscan.config.rig import NoiseSection, StripeSection
from lscan.stripe.picture import ROUNDING_VARIANCE

HEIGHT, WIDTH = 120, 640


def light_of(centre, width, height, rows=HEIGHT):
    """(rows, W) noise-free light of a line, averaged over each pixel."""
    row = np.arange(rows)[:, None]
    low, high = ((row + half - centre) / width for half in (-0.5, 0.5))
    return height * width * np.sqrt(2 * np.pi) * (ndtr(high) - ndtr(low))


def noisy(rng, light, ground=20.0, read=0.0, gain=0.0, speckle=0.0):
    """Rounded grey values: gamma speckle on the light, Poisson electrons, normal reading."""
    if speckle > 0:
        light = light * rng.gamma(speckle**-2, speckle**2, light.shape)
    seen = light + ground
    if gain > 0:
        seen = rng.poisson(seen / gain) * gain
    return np.rint(seen + rng.normal(0, read, seen.shape) if read > 0 else seen)


def centres_of(rng, columns=WIDTH):
    """ScanPlaces of a sloping line that passes every phase of the pixel."""
    return HEIGHT / 2 + rng.uniform(-3, 3) + np.linspace(0, 9, columns)


def settings_for(read, gain=0.0, speckle=0.0, threshold=30.0, span=2):
    """Settings that state the noise of :func:`noisy`."""
    read = float(np.hypot(read, np.sqrt(ROUNDING_VARIANCE)))
    noise = NoiseSection(read_dn=read, dn_per_electron=gain, speckle=speckle)
    return StripeSection(threshold_dn=threshold, span_px=span, noise=noise)


def nothing_clipped(image):
    """(H, W) mask of no pixel."""
    return np.zeros(image.shape, dtype=bool)
