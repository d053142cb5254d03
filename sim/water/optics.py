"""All that the tank asks of its water at one wavelength: phase functions, coefficients, indices."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from math import exp, log, log1p, sqrt
from typing import Protocol

import numpy as np

from lscan.config.documents import check
from lscan.errors import InputError
from lscan.files.disk import packaged_table
from lscan.records import Floats
from lscan.water import SALINITY_PSU, TEMPERATURE_C, Limits, refractive_index, require
from sim.scene.matter import Water

# Phase functions: what a scattering function is, molecules, Henyey and Greenstein's lobes.
#
# Every function takes the scattering angle in rad (0 is forward), not its cosine, from which a
# forward angle cannot be had back: 1 - cos is 2 sin2 of the half angle.

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


# Absorption and scattering: of pure water, of waters with a name, and of a scene's water.


TABLES = packaged_table("sim.water", "tables.toml")
ABSORPTION_NM, ABSORPTION_PER_M = np.array(TABLES["pure_absorption"]).T
WATER_NM = (450.0, 700.0)
ABSORPTION_AT_C = 22.0
# Its change with temperature and salinity, known here at 650 nm; used within SLOPES_WITHIN_NM.
SLOPES_AT_NM, SLOPES_WITHIN_NM = 650.0, 5.0
ABSORPTION_PER_M_C = -3.62e-4
ABSORPTION_PER_M_PSU = 2.15e-5

# Scattering of pure water and of sea water at 35 psu, 1/m, 20 C: Zhang, Hu & He 2009.
MOLECULAR_NM = np.array([532.0, 650.0, 660.0])
MOLECULAR_FRESH_PER_M = np.array([1.511e-3, 6.582e-4, 6.180e-4])
MOLECULAR_SEA_PER_M = np.array([1.963e-3, 8.506e-4, 7.984e-4])
SEA_PSU = 35.0


@dataclass(frozen=True)
class Coefficients:
    """Of a water at one wavelength, 1/m: absorption, scattering and the molecules' part of it."""

    absorption_per_m: float
    scattering_per_m: float
    molecular_per_m: float


@dataclass(frozen=True)
class SeaWater:
    """Absorption and scattering of a natural sea water in all, where they were printed.

    Attributes
    ----------
    wavelength_nm : float, nm
    absorption_per_m, scattering_per_m : float, 1/m
    missing_per_m : float, 1/m, by how much the printed absorption is too low
    """

    wavelength_nm: float
    absorption_per_m: float
    scattering_per_m: float
    missing_per_m: float = 0.0


SEA_WATERS = {name: SeaWater(**printed) for name, printed in TABLES["sea"].items()}
# Turbid waters, roughly: what an NTU is depends on the instrument.  Only scattering is added;
# how much the particles of a tank absorb is not to be had from a turbidity.
SCATTERING_PER_M_NTU = 1.0


def coefficients(water: Water, wavelength_nm: float) -> Coefficients:
    """The absorption and scattering of a scene's water.

    Where a and b are given in all, the molecules have the part of b that they have in pure
    water, all of it where b is less.  Else pure water's and the particles' add up.  Air has
    neither.

    Parameters
    ----------
    water : Water, the scene's
    wavelength_nm : float, nm, 450 to 700

    Raises
    ------
    InputError
        The wavelength lies outside the range.
    """
    if water.kind == "air":
        require("wavelength_nm", wavelength_nm, WATER_NM)
        return Coefficients(0.0, 0.0, 0.0)
    molecular = molecular_scattering_per_m(water.salinity_psu, wavelength_nm)
    if water.absorption_per_m is not None and water.scattering_per_m is not None:
        total = water.scattering_per_m
        return Coefficients(water.absorption_per_m, total, min(molecular, total))
    added_absorption, added_scattering = _particles(water)
    pure = absorption_per_m(water.temperature_c, water.salinity_psu, wavelength_nm)
    return Coefficients(pure + added_absorption, molecular + added_scattering, molecular)


def _particles(water: Water) -> tuple[float, float]:
    """Absorption and scattering, 1/m, that the water's particles add to pure water's."""
    if water.kind in SEA_WATERS:
        return particles_of(SEA_WATERS[water.kind])
    if water.turbidity_ntu is not None:
        return 0.0, SCATTERING_PER_M_NTU * water.turbidity_ntu
    return water.particle_absorption_per_m or 0.0, water.particle_scattering_per_m or 0.0


def particles_of(sea: SeaWater) -> tuple[float, float]:
    """Absorption and scattering, 1/m, of what a sea water holds besides water and salt.

    What pure sea water (22 C, 35 psu) has of the printed values is taken off where they were
    printed, down to nothing.  The rest is used at every wavelength: particles as large as the
    sea's scatter nearly alike at all, and of how they absorb elsewhere nothing was printed.

    Parameters
    ----------
    sea : SeaWater, the water as printed

    Returns
    -------
    Absorption, scattering, 1/m; neither negative.

    References
    ----------
    docs/explanation/physics.md, section 2.
    """
    pure = absorption_per_m(ABSORPTION_AT_C, 0.0, sea.wavelength_nm)
    molecular = molecular_scattering_per_m(SEA_PSU, sea.wavelength_nm)
    absorption = sea.absorption_per_m + sea.missing_per_m
    return max(absorption - pure, 0.0), max(sea.scattering_per_m - molecular, 0.0)


def absorption_per_m(temperature_c: float, salinity_psu: float, wavelength_nm: float) -> float:
    """Absorption of pure (sea) water, 1/m; linear between the table's wavelengths.

    Temperature and salinity count only within 5 nm of 650 nm, where their slopes are known;
    elsewhere the value is that of pure water at 22 C.

    Parameters
    ----------
    temperature_c : float, C, 0 to 30
    salinity_psu : float, psu, 0 to 35
    wavelength_nm : float, nm, 450 to 700

    Raises
    ------
    InputError
        A value lies outside its range.

    References
    ----------
    Pope & Fry 1997; docs/explanation/physics.md, section 2.

    Examples
    --------
    >>> round(absorption_per_m(22.0, 0.0, 650.0), 3)
    0.34
    """
    require("temperature_c", temperature_c, TEMPERATURE_C)
    require("salinity_psu", salinity_psu, SALINITY_PSU)
    require("wavelength_nm", wavelength_nm, WATER_NM)
    pure = float(np.interp(wavelength_nm, ABSORPTION_NM, ABSORPTION_PER_M))
    if abs(wavelength_nm - SLOPES_AT_NM) > SLOPES_WITHIN_NM:
        return pure
    warming = ABSORPTION_PER_M_C * (temperature_c - ABSORPTION_AT_C)
    return pure + warming + ABSORPTION_PER_M_PSU * salinity_psu


def molecular_scattering_per_m(salinity_psu: float, wavelength_nm: float) -> float:
    """Scattering of pure (sea) water at 20 C, 1/m.

    It is a power law of the wavelength and linear in salinity, fitted at 532 to 660 nm; carried on
    to 450 and 700 nm, where Morel's exponent (-4.32 against the fit's -4.15) would differ by 3 %.

    Parameters
    ----------
    salinity_psu : float, psu, 0 to 35
    wavelength_nm : float, nm, 450 to 700

    Raises
    ------
    InputError
        A value lies outside its range.

    References
    ----------
    Zhang, Hu & He 2009.
    """
    require("salinity_psu", salinity_psu, SALINITY_PSU)
    require("wavelength_nm", wavelength_nm, WATER_NM)
    fresh, sea = (
        np.exp(np.polyval(np.polyfit(np.log(MOLECULAR_NM), np.log(b), 1), np.log(wavelength_nm)))
        for b in (MOLECULAR_FRESH_PER_M, MOLECULAR_SEA_PER_M)
    )
    return float(fresh + (sea - fresh) * salinity_psu / SEA_PSU)


# All that the tank asks of its water at one wavelength, in one record.


MM_PER_M = 1000.0


@dataclass(frozen=True)
class Optics:
    """The water at one wavelength.

    Attributes
    ----------
    index : float, refractive index relative to air
    absorption_per_mm, scattering_per_mm : float, 1/mm, of water and particles together
    particles : PhaseFunction, the phase function of the particles
    molecular_weight : float, the molecules' share of scattering_per_mm, 0 to 1
    """

    index: float
    absorption_per_mm: float
    scattering_per_mm: float
    particles: PhaseFunction
    molecular_weight: float

    @property
    def extinction_per_mm(self) -> float:
        """Beam attenuation, 1/mm: absorption and scattering."""
        return self.absorption_per_mm + self.scattering_per_mm

    def phase(self, angle: Floats) -> Floats:
        """Phase function, 1/sr; same shape as ``angle``.  Its integral over the sphere is 1.

        Parameters
        ----------
        angle : array, scattering angle in rad; 0 is forward
        """
        share = self.molecular_weight
        return (1 - share) * self.particles.density(angle) + share * molecular_phase(angle)

    def rounded(self, step: float) -> "Optics":
        """The water with its coefficients and its molecules' share at multiples of 1 + step.

        At most half a step off; many waters that differ by a little are a few then.

        Parameters
        ----------
        step : float, relative; 0 for the water itself

        Examples
        --------
        >>> from sim.scene import load_scene
        >>> from sim.water import water_optics
        >>> water = water_optics(load_scene("paper/groove").tank.water, 650.0)
        >>> abs(water.rounded(0.02).absorption_per_mm / water.absorption_per_mm - 1) <= 0.01
        True
        """
        if step == 0:
            return self
        width = log1p(step)

        def nearest(value: float) -> float:
            return exp(width * round(log(value) / width)) if value > 0 else value

        return replace(
            self,
            absorption_per_mm=nearest(self.absorption_per_mm),
            scattering_per_mm=nearest(self.scattering_per_mm),
            molecular_weight=min(nearest(self.molecular_weight), 1.0),
        )


def water_optics(water: Water, wavelength_nm: float) -> Optics:
    """The optics of a scene's water at one wavelength.

    Parameters
    ----------
    water : Water, the scene's
    wavelength_nm : float, nm, 450 to 700

    Raises
    ------
    InputError
        The wavelength lies outside the range.

    References
    ----------
    docs/explanation/physics.md, sections 1 to 3.
    """
    found = coefficients(water, wavelength_nm)
    scattering = found.scattering_per_m
    return Optics(
        index=water_index(water, wavelength_nm),
        absorption_per_mm=found.absorption_per_m / MM_PER_M,
        scattering_per_mm=scattering / MM_PER_M,
        particles=particle_phase(water),
        # Where nothing scatters, the molecules' share is as good as any.
        molecular_weight=found.molecular_per_m / scattering if scattering > 0 else 1.0,
    )


def water_index(water: Water, wavelength_nm: float) -> float:
    """The index of a scene's water, relative to air: that of ``water_optics`` in less time.

    Parameters
    ----------
    water : Water, the scene's
    wavelength_nm : float, nm, 450 to 700

    Raises
    ------
    InputError
        The wavelength lies outside the range.
    """
    require("wavelength_nm", wavelength_nm, WATER_NM)
    if water.kind == "air":
        return 1.0
    return refractive_index(
        water.temperature_c, water.salinity_psu, wavelength_nm, water.pressure_mpa
    )


def particle_phase(water: Water) -> PhaseFunction:
    """The phase function that a scene names for its particles."""
    match water.phase:
        case "petzold-mixture":
            return HenyeyGreensteinMixture()
        case "petzold":
            return PetzoldTable()
        case "fournier-forand":
            return FournierForand(water.particle_index, water.junge_slope)
        case "henyey-greenstein":
            return HenyeyGreensteinMixture((1.0,), (water.asymmetry,))


# The refractive index of the materials ports are made of, relative to air.


INDEX = (1.0, 2.5)  # what a scene file may name as a number


@dataclass(frozen=True)
class Sellmeier:
    """n2 = 1 + sum of strength w2 / (w2 - pole), w the wavelength in um, pole in um2; at 20 C.

    terms: strength and pole of each.
    """

    terms: Sequence[tuple[float, float]]
    range_nm: Limits


_TABLE = packaged_table("sim.water", "tables.toml")["glass"]
GLASSES = {name: Sellmeier(**formula) for name, formula in _TABLE.items()}


def glass_index(glass: float | str, wavelength_nm: float) -> float:
    """Index, relative to air, of a port's material.

    Parameters
    ----------
    glass : float or str, name of a material in GLASSES, or an index from 1 to 2.5, which passes
        through
    wavelength_nm : float, nm

    Raises
    ------
    InputError
        The name is unknown, the number is not an index, or the wavelength lies outside the range of
        the material's formula.

    References
    ----------
    Schott, data sheet N-BK7 517642.251; Malitson 1965 (fused silica); Sultanova, Kasarova & Nikolov
    2009 (PMMA).

    Examples
    --------
    >>> round(glass_index("PMMA", 650.0), 4)
    1.4881
    """
    if not isinstance(glass, str):
        require("glass_index", glass, INDEX, where="port")
        return float(glass)
    if glass not in GLASSES:
        allowed = f"a number or one of {', '.join(GLASSES)}"
        raise InputError("glass_index", where="port", value=glass, allowed=allowed)
    formula = GLASSES[glass]
    require("wavelength_nm", wavelength_nm, formula.range_nm, where=glass)
    w2 = (wavelength_nm / 1000) ** 2
    return sqrt(1 + sum(strength * w2 / (w2 - pole) for strength, pole in formula.terms))
