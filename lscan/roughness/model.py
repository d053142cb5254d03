"""Models of a roughness spectrum: a power law, the same in all directions or stretched.

A spectrum W2(K) is the density of mean square height over the plane of the wavenumber vector K,
rad/cm: its integral over all of the plane is the mean square height.  It is in cm^4.
"""

from dataclasses import dataclass
from math import atan2, exp, gamma, hypot, pi, sqrt

import numpy as np

from lscan.records import Floats

REFERENCE_CM = 1.0
"""Length h0 that makes K dimensionless in a power law (APL-UW TR 9407, sec. IV)."""


@dataclass(frozen=True)
class PowerLaw:
    """W2(K) = w2 / (h0 k)^gamma2, where k² = K' M K and M stretches the plane without its area.

    M is the exponential of [[a, b], [b, -a]]: for a = b = 0 the law is the same in all directions.

    Attributes
    ----------
    gamma2 : float, spectral exponent
    w2_cm4 : float, cm^4, spectral strength: W2 at k = 1 rad/cm
    stretch : (float, float), a and b

    References
    ----------
    Applied Physics Laboratory, APL-UW TR 9407 (1994), sec. IV; Jackson & Richardson, High-Frequency
    Seafloor Acoustics (Springer 2007), ch. 6.

    Examples
    --------
    >>> float(PowerLaw(3.0, 0.004).density(0.0, 2.0))
    0.0005
    """

    gamma2: float
    w2_cm4: float
    stretch: tuple[float, float] = (0.0, 0.0)

    def density(self, along_y: Floats | float, along_x: Floats | float) -> Floats:
        """W2 in cm^4 at wavenumbers; 0 at K = 0, where a power law has none.

        Parameters
        ----------
        along_y, along_x : array or float, rad/cm, components of K
        """
        a, b = self.stretch
        size = hypot(a, b)
        steep = np.sinh(size) / size if size else 1.0
        square = np.cosh(size) * (np.square(along_x) + np.square(along_y))
        square = square + steep * (
            a * (np.square(along_x) - np.square(along_y)) + 2 * b * np.multiply(along_x, along_y)
        )
        with np.errstate(divide="ignore"):
            found = self.w2_cm4 * (REFERENCE_CM**2 * square) ** (-self.gamma2 / 2)
        return np.where(square > 0, found, 0.0)[()]

    @property
    def ratio(self) -> float:
        """How many times longer features are across the heading than along it."""
        return exp(hypot(*self.stretch))

    @property
    def heading_deg(self) -> float:
        """From x towards y, degrees of 0 to 180: the direction in which the surface is roughest."""
        a, b = self.stretch
        return float(np.degrees(atan2(-b, -a) / 2) % 180)

    @property
    def one_dimensional(self) -> tuple[float, float]:
        """gamma1 and w1 in cm³ of profiles: W1(k) = w1 / (h0 k)^gamma1, -inf < k < inf.

        Of the law that is the same in all directions: the integral of W2 over the other component.

        References
        ----------
        Jackson & Richardson (2007), ch. 6: W1 and W2 of an isotropic surface.
        """
        share = sqrt(pi) * gamma((self.gamma2 - 1) / 2) / gamma(self.gamma2 / 2)
        return self.gamma2 - 1, self.w2_cm4 * share / REFERENCE_CM


def from_profiles(gamma1: float, w1_cm3: float) -> PowerLaw:
    """The law, the same in all directions, whose profiles have a spectrum w1 / (h0 k)^gamma1.

    Parameters
    ----------
    gamma1 : float, above 0
    w1_cm3 : float, cm³, of the two-sided spectrum of a profile

    Examples
    --------
    >>> law = from_profiles(*PowerLaw(3.2, 0.01).one_dimensional)
    >>> round(law.gamma2, 12), round(law.w2_cm4, 12)
    (3.2, 0.01)
    """
    _, unit = PowerLaw(gamma1 + 1, 1.0).one_dimensional
    return PowerLaw(gamma1 + 1, w1_cm3 / unit)
