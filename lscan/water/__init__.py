"""The refractive index of water by its temperature, salinity and pressure.

``density`` and ``index``: water under pressure, air; a value outside a formula's range is refused.
"""

from lscan.water.index import refractive_index

__all__ = ["refractive_index"]
