"""The refractive index of water and air, and the density of water, in their formulas' ranges."""

from functools import lru_cache
from math import sqrt

import numpy as np

from lscan.errors import InputError
from lscan.files.disk import packaged_table

# The refusal of values for which a published formula was not made.

Limits = tuple[float, float]


def require(name: str, value: float, allowed: Limits, where: str = "water") -> None:
    """Refuse a value that does not lie within its limits, ends included; NaN does not.

    Parameters
    ----------
    name : str, of the value, for the message
    value : float, in the unit of the limits
    allowed : tuple of float, least and largest
    where : str, what the value belongs to, for the message

    Raises
    ------
    InputError
        Names the value and its limits.
    """
    low, high = allowed
    if not low <= value <= high:
        raise InputError(name, where=where, value=value, allowed=f"{low:g} to {high:g}")


# The density of fresh water under pressure: region 1 of the industrial formulation IAPWS-IF97.
#
# The specific volume is v = R T / p* times the derivative of a dimensionless Gibbs energy with
# respect to pressure (IAPWS R7-97, equation 7 and table 2; its terms without pressure fall out).


ATMOSPHERE_MPA = 0.101325
LIQUID_C = (0.0, 90.0)  # liquid at every pressure allowed; the release goes to 350 C
PRESSURE_MPA = (0.1, 100.0)
ZERO_C_IN_K = 273.15

GAS_CONSTANT = 461.526  # J/(kg K)
PRESSURE_SCALE_MPA, TEMPERATURE_SCALE_K = 16.53, 1386.0
PRESSURE_SHIFT, TEMPERATURE_SHIFT = 7.1, 1.222
TERMS = np.array(packaged_table("lscan", "water.toml")["density_terms"])


def fresh_water_density(temperature_c: float, pressure_mpa: float = ATMOSPHERE_MPA) -> float:
    """Density of fresh water, kg/m3.

    Between 0 and 30 C it is within 0.02 kg/m3 of the scientific formulation IAPWS-95, which is 6e-6
    of the index.

    Parameters
    ----------
    temperature_c : float, C, 0 to 90
    pressure_mpa : float, absolute pressure, MPa, 0.1 to 100

    Raises
    ------
    InputError
        A value lies outside its range.

    References
    ----------
    IAPWS R7-97, region 1 (IAPWS-IF97): equation 7 and table 2.

    Examples
    --------
    >>> round(fresh_water_density(20.0), 2)
    998.21
    """
    require("temperature_c", temperature_c, LIQUID_C)
    require("pressure_mpa", pressure_mpa, PRESSURE_MPA)
    kelvin = temperature_c + ZERO_C_IN_K
    of_pressure, of_temperature, coefficient = TERMS.T
    less = PRESSURE_SHIFT - pressure_mpa / PRESSURE_SCALE_MPA
    warm = TEMPERATURE_SCALE_K / kelvin - TEMPERATURE_SHIFT
    powers = less ** (of_pressure - 1) * warm**of_temperature
    slope = -np.sum(coefficient * of_pressure * powers)
    return float(1e6 * PRESSURE_SCALE_MPA / (GAS_CONSTANT * kelvin * slope))


# The refractive index of water and of air.
#
# The index used throughout is that of Quan & Fry, which is relative to air.  With catalogue glass,
# also relative to air, and air = 1 it makes one consistent set; an absolute index (IAPWS) mixed in
# would be wrong by 3.7e-4.


# Ranges of Quan & Fry 1995, at atmospheric pressure.
TEMPERATURE_C = (0.0, 30.0)
SALINITY_PSU = (0.0, 35.0)
INDEX_NM = (400.0, 700.0)
AIR_NM = (300.0, 1690.0)  # range of Ciddor 1996
# Ranges of IAPWS R9-97: 261.15 to 773.15 K, 0.2 to 1.1 um.
IAPWS_KG_M3 = (0.0, 1060.0)
IAPWS_C = (-12.0, 500.0)
IAPWS_NM = (200.0, 1100.0)


def refractive_index(
    temperature_c: float,
    salinity_psu: float,
    wavelength_nm: float,
    pressure_mpa: float = ATMOSPHERE_MPA,
) -> float:
    """Index of water relative to air.

    The rise with pressure is that of fresh water (IAPWS index of the IAPWS-IF97 density) and is 0
    at 0.101325 MPa; sea water yields less, by 4 to 6 % of the rise (EOS-80).

    Parameters
    ----------
    temperature_c : float, C, 0 to 30
    salinity_psu : float, psu, 0 to 35
    wavelength_nm : float, nm, 400 to 700
    pressure_mpa : float, absolute pressure, MPa, 0.1 to 100

    Raises
    ------
    InputError
        A value lies outside its range.

    References
    ----------
    Quan & Fry 1995; docs/explanation/physics.md, section 1.

    Examples
    --------
    >>> round(refractive_index(20.0, 0.0, 650.0), 5)
    1.33132
    """
    require("temperature_c", temperature_c, TEMPERATURE_C)
    require("salinity_psu", salinity_psu, SALINITY_PSU)
    require("wavelength_nm", wavelength_nm, INDEX_NM)
    require("pressure_mpa", pressure_mpa, PRESSURE_MPA)
    t, s, nm = temperature_c, salinity_psu, wavelength_nm
    at_atmosphere = (
        1.31405
        + (1.779e-4 - 1.05e-6 * t + 1.6e-8 * t**2) * s
        - 2.02e-6 * t**2
        + (15.868 + 0.01155 * s - 0.00423 * t) / nm
        - 4382.0 / nm**2
        + 1.1455e6 / nm**3
    )
    return at_atmosphere + _pressure_rise(t, nm, pressure_mpa)


@lru_cache(maxsize=256)  # a study asks for one water's index thousands of times
def _pressure_rise(temperature_c: float, wavelength_nm: float, pressure_mpa: float) -> float:
    """What the index, relative to air, gains from atmospheric pressure to ``pressure_mpa``."""
    pressed, at_atmosphere = (
        iapws_index(fresh_water_density(temperature_c, mpa), temperature_c, wavelength_nm)
        for mpa in (pressure_mpa, ATMOSPHERE_MPA)
    )
    return (pressed - at_atmosphere) / air_index(wavelength_nm)


def air_index(wavelength_nm: float) -> float:
    """Absolute index of standard air (15 C, 101325 Pa).

    Parameters
    ----------
    wavelength_nm : float, nm, 300 to 1690

    Raises
    ------
    InputError
        The wavelength lies outside the range.

    References
    ----------
    Ciddor 1996.
    """
    require("wavelength_nm", wavelength_nm, AIR_NM)
    wavenumber2 = (1000 / wavelength_nm) ** 2
    return 1 + 1e-8 * (5792105 / (238.0185 - wavenumber2) + 167917 / (57.362 - wavenumber2))


def iapws_index(density_kg_m3: float, temperature_c: float, wavelength_nm: float) -> float:
    """Index of pure water relative to vacuum.

    Parameters
    ----------
    density_kg_m3 : float, kg/m3, 0 to 1060
    temperature_c : float, C, -12 to 500
    wavelength_nm : float, nm, 200 to 1100

    Raises
    ------
    InputError
        A value lies outside its range.

    References
    ----------
    IAPWS R9-97; Harvey, Gallagher & Sengers 1998.
    """
    require("density_kg_m3", density_kg_m3, IAPWS_KG_M3)
    require("temperature_c", temperature_c, IAPWS_C)
    require("wavelength_nm", wavelength_nm, IAPWS_NM)
    rho = density_kg_m3 / 1000
    t = (temperature_c + ZERO_C_IN_K) / ZERO_C_IN_K
    lam2 = (wavelength_nm / 589) ** 2
    refraction = rho * (  # Lorentz and Lorenz: (n2 - 1) / (n2 + 2)
        0.244257733
        + 0.974634476e-2 * rho
        - 0.373234996e-2 * t
        + 0.268678472e-3 * lam2 * t
        + 0.158920570e-2 / lam2
        + 0.245934259e-2 / (lam2 - 0.229202**2)
        + 0.900704920 / (lam2 - 5.432937**2)
        - 0.166626219e-1 * rho**2
    )
    return sqrt((1 + 2 * refraction) / (1 - refraction))
