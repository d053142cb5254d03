"""What the tank's water does to light: refractive index, absorption, scattering, phase function.

Every constant stands beside its source and range, the tables in ``tables.toml``; a value outside
the range is refused.  The index of water itself is the instrument's too: ``lscan.water``.
``glass``: ports.
``inherent``: absorption and scattering.  ``phase``, ``petzold``, ``fournier``: phase functions.
``optics``: all of it for a scene's water.
``spread``: tables of the light that a beam scatters, of ``single`` scattering by quadrature and
of more by photons counted in ``rings``.  ``tablecache`` keeps them.
"""

from lscan.water import refractive_index
from sim.water.optics import (
    FournierForand,
    HenyeyGreensteinMixture,
    Optics,
    PetzoldTable,
    glass_index,
    water_index,
    water_optics,
)

__all__ = [
    "FournierForand", "HenyeyGreensteinMixture", "Optics", "PetzoldTable", "glass_index",
    "refractive_index", "water_index", "water_optics",
]  # fmt: skip
