"""Phase functions: what a scattering function is, molecules, Henyey and Greenstein's lobes.

Every function takes the scattering angle in rad (0 is forward), not its cosine, from which a
forward angle cannot be had back: 1 - cos is 2 sin2 of the half angle.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from lscan.errors import InputError
from lscan.records import Floats

DEPOLARISATION = 0.039  # of water's molecules: Zhang, Hu & He 2009

# Four Henyey-Greenstein lobes fitted to Petzold's average particle (docs/explanation/physics.md,
# section 3):
# within .91 to 1.13 of his table from 0.1 to 180 degrees.  One lobe fails in backscatter,
# where many rigs look.
PARTICLE_WEIGHTS = (0.11984, 0.37028, 0.50780, 0.00208)
PARTICLE_G = (0.99723, 0.98081, 0.87094, -0.59262)
WEIGHTS_ADD_UP_WITHIN = 1e-9


class PhaseFunction(Protocol):
    """The angles into which particles scatter."""

    def density(self, angle: Floats) -> Floats:
        """Share scattered per solid angle, 1/sr, at angles in rad, 0 to pi; same shape.

        Its integral over the sphere is 1.
        """
        ...


@dataclass(frozen=True)
class HenyeyGreensteinMixture:
    """A sum of Henyey and Greenstein's lobes; left out, the four of Petzold's particle.

    Attributes
    ----------
    weights : (K,) share of each lobe, none negative, together 1
    g : (K,) mean cosines of the lobes, between -1 and 1

    Raises
    ------
    InputError
        The lobes are no density.

    References
    ----------
    Henyey & Greenstein 1941; docs/explanation/physics.md, section 3.
    """

    weights: tuple[float, ...] = PARTICLE_WEIGHTS
    g: tuple[float, ...] = PARTICLE_G

    def __post_init__(self) -> None:
        """Refuse lobes that are no density."""
        if not 0 < len(self.g) == len(self.weights):
            raise InputError("one weight and one g a lobe", where="lobes", value=len(self.g))
        if not (min(self.weights) >= 0 and abs(sum(self.weights) - 1) <= WEIGHTS_ADD_UP_WITHIN):
            allowed = "none negative, together 1"
            raise InputError("weights", where="lobes", value=self.weights, allowed=allowed)
        if not np.all(np.abs(self.g) < 1):
            raise InputError("g", where="lobes", value=self.g, allowed="between -1 and 1")

    def density(self, angle: Floats) -> Floats:
        """Phase function, 1/sr; same shape as ``angle``.

        Parameters
        ----------
        angle : array, scattering angle in rad; 0 is forward
        """
        lobes = henyey_greenstein(np.asarray(angle, dtype=float)[..., np.newaxis], self.g)
        return np.sum(self.weights * lobes, axis=-1)


def henyey_greenstein(angle: Floats, g: Floats | tuple[float, ...] | float) -> Floats:
    """Henyey & Greenstein's phase function, 1/sr; the arguments broadcast.

    Parameters
    ----------
    angle : array, scattering angle in rad; 0 is forward
    g : array or float, mean cosine, between -1 and 1

    References
    ----------
    Henyey & Greenstein 1941.
    """
    half, lean = np.asarray(angle, dtype=float) / 2, np.asarray(g, dtype=float)
    # 1 + g2 - 2 g cos, as a sum of squares whichever way the lobe points.
    aside = np.where(lean >= 0, np.sin(half), np.cos(half))
    distance2 = (1 - np.abs(lean)) ** 2 + 4 * np.abs(lean) * aside**2
    return (1 - lean**2) / (4 * np.pi * distance2**1.5)


def molecular_phase(angle: Floats) -> Floats:
    """Phase function of molecules, 1/sr: 1 + cos2 (1 - d)/(1 + d), normalised; shape of ``angle``.

    d is the depolarisation ratio, 0.039.

    Parameters
    ----------
    angle : array, scattering angle in rad; 0 is forward

    References
    ----------
    Zhang, Hu & He 2009.
    """
    anisotropy = (1 - DEPOLARISATION) / (1 + DEPOLARISATION)
    return (1 + anisotropy * np.cos(angle) ** 2) / (4 * np.pi * (1 + anisotropy / 3))
