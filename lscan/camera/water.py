"""The refractive index of the water as [optics] states it."""

import numpy as np

from lscan.config.rig import Known, OpticsSection
from lscan.water import refractive_index
from lscan.water.density import ATMOSPHERE_MPA
from lscan.water.index import SALINITY_PSU, TEMPERATURE_C

UNKNOWN_WATER: Known = (1.333, 0.003)
"""Fresh or sea water of 0 to 30 C at 650 nm lies within 2.1 of these standard uncertainties."""

FORMULA_SIGMA = 1.5e-5  # Quan & Fry 1995, what their formula leaves of the data
MPA_PER_M = 0.0101  # of sea water; fresh water's 3 % less changes the index by 4e-6 in 100 m


def stated_water(optics: OpticsSection) -> Known | None:
    """The index of the water relative to air and its standard uncertainty; None where not stated.

    Parameters
    ----------
    optics : OpticsSection, with ``water_index``, or ``temperature_c`` and what goes with it

    References
    ----------
    Quan & Fry 1995; docs/explanation/physics.md, section 1.

    Examples
    --------
    >>> from lscan.config.rig import OpticsSection
    >>> index, sigma = stated_water(OpticsSection(temperature_c=(20.0, 0.5)))
    >>> round(index, 5), round(sigma, 5)
    (1.33132, 5e-05)
    """
    if optics.temperature_c is None:
        return optics.water_index
    known = (optics.temperature_c, optics.salinity_psu or (0.0, 0.0), optics.depth_m or (0.0, 0.0))
    mean = np.array([value for value, _ in known])
    index = _index(mean, optics.wavelength_nm)
    variance = FORMULA_SIGMA**2
    most = (TEMPERATURE_C[1], SALINITY_PSU[1], np.inf)
    for place, (value, sigma) in enumerate(known):
        step = np.zeros(3)
        step[place] = 0.1 if value < most[place] - 0.1 else -0.1
        derivative = (_index(mean + step, optics.wavelength_nm) - index) / step[place]
        variance += (derivative * sigma) ** 2
    return index, float(np.sqrt(variance))


def _index(state: np.ndarray, wavelength_nm: float) -> float:
    temperature_c, salinity_psu, depth_m = state.tolist()
    pressure_mpa = min(ATMOSPHERE_MPA + MPA_PER_M * depth_m, 100.0)
    return refractive_index(temperature_c, salinity_psu, wavelength_nm, pressure_mpa)
