"""The density of fresh water under pressure: region 1 of the industrial formulation IAPWS-IF97.

The specific volume is v = R T / p* times the derivative of a dimensionless Gibbs energy with
respect to pressure (IAPWS R7-97, equation 7 and table 2; its terms without pressure fall out).
"""

import numpy as np

from lscan.files.disk import packaged_table
from lscan.water.limits import require

ATMOSPHERE_MPA = 0.101325
TEMPERATURE_C = (0.0, 90.0)  # liquid at every pressure allowed; the release goes to 350 C
PRESSURE_MPA = (0.1, 100.0)
ZERO_C_IN_K = 273.15

GAS_CONSTANT = 461.526  # J/(kg K)
PRESSURE_SCALE_MPA, TEMPERATURE_SCALE_K = 16.53, 1386.0
PRESSURE_SHIFT, TEMPERATURE_SHIFT = 7.1, 1.222
TERMS = np.array(packaged_table("lscan.water", "tables.toml")["density_terms"])


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
    require("temperature_c", temperature_c, TEMPERATURE_C)
    require("pressure_mpa", pressure_mpa, PRESSURE_MPA)
    kelvin = temperature_c + ZERO_C_IN_K
    of_pressure, of_temperature, coefficient = TERMS.T
    less = PRESSURE_SHIFT - pressure_mpa / PRESSURE_SCALE_MPA
    warm = TEMPERATURE_SCALE_K / kelvin - TEMPERATURE_SHIFT
    powers = less ** (of_pressure - 1) * warm**of_temperature
    slope = -np.sum(coefficient * of_pressure * powers)
    return float(1e6 * PRESSURE_SCALE_MPA / (GAS_CONSTANT * kelvin * slope))
