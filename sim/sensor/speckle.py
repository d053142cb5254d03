"""Speckle of the laser's light: how strong a pixel sees it, and a pattern of it.

Speckle is formed at the sensor, where light from all over the pupil meets, so it comes after
the point spread of the lens, and before electrons are drawn.  Only light of the laser that a
surface reflects shows it: what the water scatters comes from particles that drift through
many wavelengths in an exposure, and its speckle averages out.
"""

from math import ceil, sqrt
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import j1, roots_legendre

# Gauss-Legendre nodes: enough for a constant integrand, and more for every grain in a pixel.
NODES, NODES_PER_GRAIN = 32, 8


def speckle_contrast(
    pixel_um: float,
    f_number: float,
    wavelength_nm: float,
    light: Literal["polarised", "depolarised"],
) -> float:
    """Standard deviation over mean of the laser light that a pixel collects.

    C = 1/sqrt(M), where M is the number of grains a pixel averages: 1/M is the mean over all pairs
    of places in the pixel of |mu|^2, the squared coherence between them.  For a square pixel of
    side D

        1/M = 4/D^4 int_0^D int_0^D (D - x)(D - y) |mu(x, y)|^2 dx dy

    and for a circular pupil |mu|^2 = (2 J1(q)/q)^2, q = pi r/(lambda N), r^2 = x^2 + y^2.
    N is the f-number for a far object: the magnification of a webcam a metre away, half a
    percent, is left out as it is in the camera equation.

    Parameters
    ----------
    pixel_um : float, side D of a pixel, um
    f_number : float, N
    wavelength_nm : float, lambda, nm
    light : str, depolarised light is the sum of two independent patterns of equal strength: M
        doubles

    References
    ----------
    Goodman, Speckle Phenomena in Optics, sec. 4.6.

    Examples
    --------
    >>> round(speckle_contrast(6.0, 2.8, 650.0, "polarised"), 3)
    0.291
    """
    grains = pixel_um / (wavelength_nm * 1e-3 * f_number)
    nodes, weights = roots_legendre(NODES + ceil(NODES_PER_GRAIN * grains))
    place, weight = (nodes + 1) / 2, weights / 2  # x/D in 0 to 1
    overlap = 2 * weight * (1 - place)
    q = np.pi * grains * np.hypot(place[:, None], place[None, :])
    coherence = (2 * j1(q) / q) ** 2
    mean = float(overlap @ coherence @ overlap)
    return sqrt(mean / 2 if light == "depolarised" else mean)


def speckled(
    light: NDArray[np.float32], contrast: float, generator: np.random.Generator
) -> NDArray[np.float32]:
    """The light of surfaces as the pixels see it, one pattern over it; the same shape and unit."""
    seen = light.copy()
    lit = np.flatnonzero(light > 0)
    seen.reshape(-1)[lit] *= speckle_pattern(lit.shape, contrast, generator)
    return seen


def speckle_pattern(
    shape: tuple[int, ...], contrast: float, generator: np.random.Generator
) -> NDArray[np.float32]:
    """Factors of unit mean, each pixel's on its own, gamma distributed; of the given shape.

    The gamma law of M = 1/contrast^2 degrees is Goodman's approximation for integrated
    speckle (sec. 4.6), exact where M equal grains are summed.
    """
    degrees = np.float32(1 / contrast**2)
    drawn = generator.standard_gamma(degrees, size=shape, dtype=np.float32)
    return drawn / degrees
