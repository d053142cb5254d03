"""Phase functions: what a scattering function is, molecules, Henyey and Greenstein's lobes.

Every function takes the scattering angle in rad (0 is forward), not its cosine, from which a
forward angle cannot be had back: 1 - cos is 2 sin2 of the half angle.
"""

from dataclasses import dataclass
from functools import cache
from typing import Protocol

import numpy as np

from lscan.config.documents import check
from lscan.errors import InputError
from lscan.files.disk import packaged_table
from lscan.records import Floats
from sim.scene.matter import Water

DEPOLARISATION = 0.039  # of water's molecules: Zhang, Hu & He 2009

# Four Henyey-Greenstein lobes fitted to Petzold's average particle (docs/explanation/physics.md,
# section 3): within .91 to 1.13 of his table from 0.1 to 180 degrees.  One lobe fails in
# backscatter, where many rigs look.
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


# Fournier and Forand's phase function: spheres of one index, sizes after a power law.
#
# Fournier & Forand 1994 with the form of Fournier & Jonasz 1999, as printed in Mobley, Sundman &
# Boss 2002.  With the index n and the Junge slope mu of the sizes,
#
#     nu = (3 - mu) / 2,   delta = 4 sin2(angle / 2) / (3 (n - 1)2).


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
        core = np.where(near, self._series(delta, sin2), self._closed_form(delta, sin2))
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

    def _closed_form(self, delta: Floats, sin2: Floats) -> Floats:
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


# Petzold's average particle: the phase function measured in natural waters, from its table.


TABLE_DEG, TABLE_PER_SR = np.array(packaged_table("sim.water", "tables.toml")["petzold"]).T
TABLE_RAD = np.radians(TABLE_DEG)
FORWARD_SLOPE = -1.346  # of log p over log angle below 0.1 degrees
NODES_A_CELL = 16  # of Gauss and Legendre; 8 give the integral to 1e-13 as well


@dataclass(frozen=True)
class PetzoldTable:
    """Petzold's table, interpolated in the logarithms of value and angle.

    Straight lines there keep what the table's author had of it: before the normalisation to 1
    done here the integral is 0.999935 (published: 0.99994), then the mean cosine is 0.92397 and
    the backscattered share 0.018295, as published.  Curves (a monotone cubic, a spline) round
    the corners but make the integral 1.0014 to 1.0016 and the share 0.01825.
    """

    def density(self, angle: Floats) -> Floats:
        """Phase function, 1/sr; same shape as ``angle``.

        Parameters
        ----------
        angle : array, scattering angle in rad; 0 is forward
        """
        return table_density(angle) / table_integral()


def table_density(angle: Floats) -> Floats:
    """The table's own value, 1/sr, at angles in rad; not normalised."""
    log_angle = np.log(np.maximum(angle, SMALLEST_RAD))
    log_first = np.log(TABLE_RAD[0])
    inside = np.interp(log_angle, np.log(TABLE_RAD), np.log(TABLE_PER_SR))
    return np.exp(inside + FORWARD_SLOPE * np.minimum(log_angle - log_first, 0))


@cache
def table_integral() -> float:
    """Integral of the table over the sphere: Gauss and Legendre's rule in each of its cells.

    Below 0.1 degrees the power law is integrated in closed form, where the angle is its sine
    to 5e-7.
    """
    node, weight = np.polynomial.legendre.leggauss(NODES_A_CELL)
    low, high = np.log(TABLE_RAD[:-1, np.newaxis]), np.log(TABLE_RAD[1:, np.newaxis])
    angle = np.exp((low + high) / 2 + (high - low) / 2 * node)
    rings = 2 * np.pi * np.sin(angle) * angle * table_density(angle)
    forward = 2 * np.pi * TABLE_PER_SR[0] * TABLE_RAD[0] ** 2 / (2 + FORWARD_SLOPE)
    return float(forward + np.sum((high - low) / 2 * weight * rings))
