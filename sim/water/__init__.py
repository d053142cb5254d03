"""What the tank's water does to light: refractive index, absorption, scattering, phase function.

Every constant stands beside its source and range; a value outside the range is refused.
``density`` and ``index``: water under pressure, air.  ``glass``: ports.  ``inherent``:
absorption and scattering.  ``phase``, ``petzold``, ``fournier``: phase functions.  ``optics``:
all of it for a scene's water.
"""

from sim.water.density import fresh_water_density
from sim.water.fournier import FournierForand
from sim.water.glass import glass_index
from sim.water.index import absolute_index, air_index, iapws_index, refractive_index
from sim.water.inherent import absorption_per_m, molecular_scattering_per_m
from sim.water.optics import Optics, water_optics
from sim.water.petzold import PetzoldTable
from sim.water.phase import (
    DEPOLARISATION,
    HenyeyGreensteinMixture,
    PhaseFunction,
    henyey_greenstein,
    molecular_phase,
)

__all__ = [
    "DEPOLARISATION",
    "FournierForand",
    "HenyeyGreensteinMixture",
    "Optics",
    "PetzoldTable",
    "PhaseFunction",
    "absolute_index",
    "absorption_per_m",
    "air_index",
    "fresh_water_density",
    "glass_index",
    "henyey_greenstein",
    "iapws_index",
    "molecular_phase",
    "molecular_scattering_per_m",
    "refractive_index",
    "water_optics",
]
