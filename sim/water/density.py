"""The density of fresh water under pressure: region 1 of the industrial formulation IAPWS-IF97.

The specific volume is v = R T / p* times the derivative of a dimensionless Gibbs energy with
respect to pressure (IAPWS R7-97, equation 7 and table 2; its terms without pressure fall out).
"""

import numpy as np

from sim.water.limits import require

ATMOSPHERE_MPA = 0.101325
TEMPERATURE_C = (0.0, 90.0)  # liquid at every pressure allowed; the release goes to 350 C
PRESSURE_MPA = (0.1, 100.0)
ZERO_C_IN_K = 273.15

GAS_CONSTANT = 461.526  # J/(kg K)
PRESSURE_SCALE_MPA, TEMPERATURE_SCALE_K = 16.53, 1386.0
PRESSURE_SHIFT, TEMPERATURE_SHIFT = 7.1, 1.222
# Powers of (7.1 - p / p*) and of (T* / T - 1.222), and the coefficient.
TERMS = np.array(
    [
        (1, -9, 0.28319080123804e-3), (1, -7, -0.60706301565874e-3),
        (1, -1, -0.18990068218419e-1), (1, 0, -0.32529748770505e-1),
        (1, 1, -0.21841717175414e-1), (1, 3, -0.52838357969930e-4),
        (2, -3, -0.47184321073267e-3), (2, 0, -0.30001780793026e-3),
        (2, 1, 0.47661393906987e-4), (2, 3, -0.44141845330846e-5),
        (2, 17, -0.72694996297594e-15), (3, -4, -0.31679644845054e-4),
        (3, 0, -0.28270797985312e-5), (3, 6, -0.85205128120103e-9),
        (4, -5, -0.22425281908000e-5), (4, -2, -0.65171222895601e-6),
        (4, 10, -0.14341729937924e-12), (5, -8, -0.40516996860117e-6),
        (8, -11, -0.12734301741641e-8), (8, -6, -0.17424871230634e-9),
        (21, -29, -0.68762131295531e-18), (23, -31, 0.14478307828521e-19),
        (29, -38, 0.26335781662795e-22), (30, -39, -0.11947622640071e-22),
        (31, -40, 0.18228094581404e-23), (32, -41, -0.93537087292458e-25),
    ]
)  # fmt: skip


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
