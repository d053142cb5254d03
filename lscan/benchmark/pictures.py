"""Pictures of a laser line drawn from closed forms: the line's true centre is known exactly.

Across the line the light is a Gaussian integrated over each pixel, on the skirt that small-angle
scattering puts beside it: ``skirt / (|d| + 1.5 px)`` of the line's peak, d px from its centre.
The skirts were read off the tank's groove scene with each of its waters (the light of all
orders, median over the columns clear of edges); the form fits them to a fifth from the core to
40 px.  Then come speckle, shot noise, reading noise, the end of the range, and 8 bits.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import erf

from lscan.config.rig import NoiseSection
from lscan.records import Bytes, Floats

SHAPE = (96, 320)  # rows, columns
SKIRT_PX = 1.5
SKIRTS: Mapping[str, float] = {"tap": 0.0, "clear": 0.026, "coastal": 0.072, "harbor": 1.0}
"""The skirt of each water, px: its height at 1 px distance is skirt / 2.5 of the peak."""

BACKGROUND_DN = 4.0  # black level and what light there is
FULL_SCALE_DN = 255.0
SLOPE = 0.0471  # px a column: 320 columns see every sub-pixel phase many times over


@dataclass(frozen=True)
class LineCase:
    """One kind of picture.

    Attributes
    ----------
    water : str, a key of SKIRTS
    sigma_px : float, px, standard deviation of the line's cross-section
    peak_dn : float, DN, its height, without the skirt, before the range ends at 255 DN
    noise : NoiseSection, of the sensor
    """

    water: str
    sigma_px: float
    peak_dn: float
    noise: NoiseSection

    @property
    def saturated(self) -> bool:
        """Whether the crest, on its skirt and the background, is clipped."""
        crest = self.peak_dn * (1 + SKIRTS[self.water] / SKIRT_PX)
        return crest + BACKGROUND_DN > FULL_SCALE_DN


def centres(phase_px: float) -> Floats:
    """The true centre of the line in each column.

    Parameters
    ----------
    phase_px : float
        By which the line is shifted.

    Returns
    -------
    (W,) array
        Rows, px.
    """
    along: Floats = np.arange(float(SHAPE[1])) - SHAPE[1] / 2
    return SHAPE[0] / 2 + phase_px + SLOPE * along


def mean_picture(case: LineCase, centre_px: Floats) -> Floats:
    """(H, W) expected grey values in DN, before noise and the end of the range."""
    light: Floats = _line(case, centre_px) + _skirt(case, centre_px)
    return BACKGROUND_DN + case.peak_dn * light


def draw(case: LineCase, centre_px: Floats, generator: np.random.Generator) -> Bytes:
    """One picture of the line with all its noise.

    Parameters
    ----------
    case : LineCase
        Water, width and brightness of the line, and the noise.
    centre_px : (W,) array
        The line's true centre in each column, as :func:`centres` gives it.
    generator : numpy.random.Generator
        Of the noise.

    Returns
    -------
    (H, W) uint8 array
        Grey values, DN.

    Notes
    -----
    Speckle, gamma distributed with the contrast given (Goodman's law for integrated speckle),
    is of the light that the target reflects; the skirt comes from particles that drift.
    """
    noise = case.noise
    line = case.peak_dn * _line(case, centre_px)
    if noise.speckle > 0:
        degrees = 1 / noise.speckle**2
        line = line * generator.standard_gamma(degrees, SHAPE) / degrees
    mean: Floats = BACKGROUND_DN + case.peak_dn * _skirt(case, centre_px) + line
    if noise.dn_per_electron > 0:
        electrons = generator.poisson(mean / noise.dn_per_electron)
        mean = noise.dn_per_electron * electrons.astype(float)
    # read_dn includes the rounding to whole DN, which is made below.
    reading = max(noise.read_dn**2 - 1 / 12, 0.0) ** 0.5
    read = mean + reading * generator.standard_normal(SHAPE)
    return np.clip(np.rint(read), 0, FULL_SCALE_DN).astype(np.uint8)


def _line(case: LineCase, centre_px: Floats) -> Floats:
    """(H, W) the Gaussian of height 1, its mean over each pixel."""
    edges = np.arange(SHAPE[0] + 1)[:, None] - 0.5 - centre_px
    area: Floats = np.diff(erf(edges / (np.sqrt(2) * case.sigma_px)), axis=0) / 2
    line: Floats = np.sqrt(2 * np.pi) * case.sigma_px * area
    return line


def _skirt(case: LineCase, centre_px: Floats) -> Floats:
    distance = np.abs(np.arange(SHAPE[0])[:, None] - centre_px)
    skirt: Floats = SKIRTS[case.water] / (distance + SKIRT_PX)
    return skirt
