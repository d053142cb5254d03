"""What the water scatters of a surface's light into a camera's pixel: a sum of Gaussians.

By reciprocity a pixel receives from an element of a surface what a pencil beam along the pixel's
ray would bring to it (sim.water.spread).  The element lies on a plane, tilted against the line of
sight, on which the beam ends too.  About the element that light is a function of the angle q
between ray and element and of the azimuth chi of the tilt, R0(q) + R1(q) cos chi; what is left,
of cos 2 chi, is 1 % of R0 within 10 degrees and 4 % within 60.  Both are fitted by Gaussians
whose widths double from one to the next: a power law is a sum of such to 0.2 %, and a picture
convolved with a Gaussian costs the less the wider it is.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from lscan.records import Floats
from sim.water.spread import LogAxis, Spread

RANGE_AXIS = LogAxis(100.0, 3000.0, 14)
COSINE_AXIS = LogAxis(0.1, 1.0, 8)  # of incidence; flatter surfaces count as the last
HARMONICS, AZIMUTHS = 2, 8
WIDEST_RAD = 0.6  # the widest Gaussian: as wide as a camera's view
# The sum is fitted within FARTHEST of the widest deviations: beyond, it only falls off, and what
# lies nearer would suffer.  ANGLES_A_LEVEL, to each doubling.
FARTHEST = 1.5
ANGLES_A_LEVEL = 6
RIDGE = 1e-4  # of a coefficient's own size, as the fit's prior
SHIFT = 1.1  # of all angles, by which the steepness is found


@dataclass(frozen=True)
class ScatterKernel:
    """Coefficients of the Gaussians.

    Attributes
    ----------
    sigmas : (L,) standard deviations, rad, each twice the one before
    weights : (R, C, L, HARMONICS), 1/mm2, at the nodes of RANGE_AXIS and COSINE_AXIS, of
        exp(-x2 / 2) and x exp(-x2 / 2) cos chi, with x = q / sigma
    steepness : (L,) the power of a change of scale that the first weights go with
    """

    sigmas: Floats
    weights: Floats
    steepness: Floats


@lru_cache(maxsize=4)
def scatter_kernel(spread: Spread, extinction_per_mm: float, smallest_rad: float) -> ScatterKernel:
    """The coefficients for a water.

    Parameters
    ----------
    spread : Spread, of the water
    extinction_per_mm : float, its attenuation
    smallest_rad : float, which the least standard deviation is no larger than
    """
    levels = int(np.ceil(np.log2(WIDEST_RAD / smallest_rad))) + 1
    sigmas = WIDEST_RAD / np.exp2(np.arange(levels, dtype=float))[::-1]
    angle = np.geomspace(sigmas[0], FARTHEST * WIDEST_RAD, ANGLES_A_LEVEL * levels)
    light = _received(spread, extinction_per_mm, angle)
    moved = _received(spread, extinction_per_mm, angle * SHIFT)
    weights, other = _fitted(angle, sigmas, light), _fitted(angle, sigmas, moved)
    ratio = np.median(other[..., 0] / weights[..., 0], axis=(0, 1))
    return ScatterKernel(sigmas, weights, np.log(np.maximum(ratio, 1e-3)) / np.log(SHIFT))


def _received(spread: Spread, extinction: float, angle: Floats) -> Floats:
    """(R, C, Q, HARMONICS) irradiance of planes by a beam of unit power, 1/mm2."""
    azimuth = np.pi * (np.arange(AZIMUTHS) + 0.5) / AZIMUTHS
    ranges, cosine, theta, chi = np.meshgrid(
        RANGE_AXIS.nodes(), COSINE_AXIS.nodes(), angle, azimuth, indexing="ij", sparse=True
    )
    aside = np.sqrt(1 - cosine**2) * np.cos(chi)
    towards = cosine * np.cos(theta) + aside * np.sin(theta)
    end = ranges * np.where(towards > 0, cosine / np.maximum(towards, 1e-2), 100.0)
    light = extinction**2 * spread.irradiance(
        theta, extinction * ranges, cosine, aside, extinction * end
    )
    return np.stack([light.mean(axis=-1), 2 * (light * np.cos(chi)).mean(axis=-1)], axis=-1)


def _fitted(angle: Floats, sigmas: Floats, light: Floats) -> Floats:
    """(R, C, L, HARMONICS) coefficients; errors count relative to the light's mean."""
    x = angle[:, np.newaxis] / sigmas
    weights = []
    for harmonic in range(HARMONICS):
        basis = x**harmonic * np.exp(-0.5 * x**2)  # (Q, L)
        design = basis / light[..., 0, np.newaxis]
        # A Gaussian's own size is that of the light where it is highest.
        size = np.sqrt((design**2).sum(axis=-2))
        scaled = design / size[..., np.newaxis, :]
        matrix = np.swapaxes(scaled, -1, -2) @ scaled
        matrix += RIDGE**2 * np.eye(len(sigmas))
        right = np.einsum("...ql,...q->...l", scaled, light[..., harmonic] / light[..., 0])
        weights.append(np.linalg.solve(matrix, right[..., np.newaxis])[..., 0] / size)
    return np.stack(weights, axis=-1)
