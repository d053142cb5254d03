"""Fournier and Forand's phase function: spheres of one index, sizes after a power law.

Fournier & Forand 1994 with the form of Fournier & Jonasz 1999, as printed in Mobley, Sundman &
Boss 2002.  With the index n and the Junge slope mu of the sizes,

    nu = (3 - mu) / 2,   delta = 4 sin2(angle / 2) / (3 (n - 1)2).
"""

from dataclasses import dataclass

import numpy as np

from lscan.config.documents import check
from lscan.records import Floats
from sim.scene.matter import Water

SERIES_WITHIN = 0.05  # of delta = 1; the closed form loses its digits there
SERIES_TERMS = 14  # 0.05 to this power is below double precision
SMALLEST_RAD = 1e-100  # below, the density is held: it is infinite at 0


@dataclass(frozen=True)
class FournierForand:
    """The phase function of particles of a relative ``index`` and a ``junge_slope`` of sizes.

    (1.10, 3.5835) scatters back as much as Petzold's particle does.

    Attributes
    ----------
    index : float, refractive index relative to the water, above 1, to 1.5
    junge_slope : float, exponent of the sizes' power law, between 3 and 5

    Raises
    ------
    InputError
        A value lies outside its range.

    References
    ----------
    Fournier & Forand 1994; Fournier & Jonasz 1999; Mobley, Sundman & Boss 2002.
    """

    index: float
    junge_slope: float

    def __post_init__(self) -> None:
        """Refuse what a scene's water refuses: the formula was not made for it."""
        values = {"particle_index": self.index, "junge_slope": self.junge_slope}
        check(Water, values, where="water")

    @property
    def nu(self) -> float:
        """The exponent (3 - mu) / 2, between -1 and 0."""
        return (3 - self.junge_slope) / 2

    def density(self, angle: Floats) -> Floats:
        """Phase function, 1/sr; same shape as ``angle``.

        Parameters
        ----------
        angle : array, scattering angle in rad; 0 is forward
        """
        angle = np.maximum(np.asarray(angle, dtype=float), SMALLEST_RAD)
        sin2 = np.sin(angle / 2) ** 2
        delta = self._delta(sin2)
        near = np.abs(delta - 1) < SERIES_WITHIN
        core = np.where(near, self._series(delta, sin2), self._closed(delta, sin2))
        wide = self._backward() * (3 * np.cos(angle) ** 2 - 1) / (16 * np.pi)
        return core / (4 * np.pi * delta**self.nu) + wide

    def _delta(self, sin2: Floats) -> Floats:
        """delta at the sine squared of half the angle."""
        return 4 * sin2 / (3 * (self.index - 1) ** 2)

    def _backward(self) -> Floats:
        """(1 - d^nu) / ((d - 1) d^nu) with delta at 180 degrees: the size of the second part.

        delta is 5 there at least, for indices up to 1.5.
        """
        delta = self._delta(np.array(1.0))
        return -np.expm1(self.nu * np.log(delta)) / (delta - 1) / delta**self.nu

    def _closed(self, delta: Floats, sin2: Floats) -> Floats:
        """The first part of p times 4 pi delta^nu, away from delta = 1."""
        less = 1 - delta
        drop = -np.expm1(self.nu * np.log(delta))  # 1 - delta^nu
        numerator = self.nu * less - drop + (delta * drop - self.nu * less) / sin2
        return np.divide(numerator, less**2, out=np.zeros_like(delta), where=less != 0)

    def _series(self, delta: Floats, sin2: Floats) -> Floats:
        """The same near delta = 1: binomial series of both numerators, divided by (delta - 1)2."""
        epsilon = np.clip(delta - 1, -SERIES_WITHIN, SERIES_WITHIN)
        first, second = (
            np.polynomial.polynomial.polyval(epsilon, _binomials(exponent)[2:])
            for exponent in (self.nu, self.nu + 1)
        )
        return first - second / sin2


def _binomials(exponent: float) -> Floats:
    """(SERIES_TERMS + 2,) coefficients of (1 + x)^exponent, rising powers."""
    k = np.arange(1, SERIES_TERMS + 2)
    return np.concatenate([[1.0], np.cumprod((exponent - k + 1) / k)])
