"""What the tank's water does to light: refractive index, absorption, scattering, phase function.

Every constant stands beside its source and range; a value outside the range is refused.

The index used throughout is that of Quan & Fry, which is relative to air.  With catalogue
glass, also relative to air, and air = 1 it makes one consistent set; an absolute index
(IAPWS) mixed in would be wrong by 3.7e-4.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lscan.errors import InputError
from lscan.records import Floats
from sim.scene import Water

TEMPERATURE_C = (0.0, 30.0)  # ranges of Quan & Fry 1995, at atmospheric pressure
SALINITY_PSU = (0.0, 35.0)
INDEX_NM = (400.0, 700.0)
AIR_NM = (300.0, 1690.0)  # range of Ciddor 1996

# Pure water absorption, 1/m, at 22 C: Pope & Fry 1997.
ABSORPTION_NM, ABSORPTION_PER_M = np.array(
    [
        (450, 0.00922), (500, 0.0204), (550, 0.0565), (600, 0.2224), (620, 0.2755),
        (630, 0.2916), (640, 0.3108), (645, 0.325), (650, 0.340), (655, 0.371),
        (660, 0.410), (670, 0.439), (680, 0.465), (700, 0.624),
    ]
).T  # fmt: skip
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
DEPOLARISATION = 0.039

# Four Henyey-Greenstein lobes fitted to Petzold's average particle (physics.md section 3):
# within .91 to 1.13 of his table from 0.1 to 180 degrees.  One lobe fails in backscatter,
# where many rigs look.
PARTICLE_WEIGHTS = np.array([0.11984, 0.37028, 0.50780, 0.00208])
PARTICLE_G = np.array([0.99723, 0.98081, 0.87094, -0.59262])


@dataclass(frozen=True)
class Optics:
    """The water at one wavelength.

    index: refractive index relative to air.
    absorption_per_mm, scattering_per_mm: of water and particles together.
    hg_weights, hg_g: (K,) weight (they add up to 1) and asymmetry of the particles' lobes.
    molecular_weight: the molecules' share of scattering_per_mm.
    """

    index: float
    absorption_per_mm: float
    scattering_per_mm: float
    hg_weights: Floats
    hg_g: Floats
    molecular_weight: float

    @property
    def extinction_per_mm(self) -> float:
        """Beam attenuation, 1/mm: absorption and scattering."""
        return self.absorption_per_mm + self.scattering_per_mm

    def phase(self, cos_psi: Floats) -> Floats:
        """Phase function, 1/sr, at the cosine of the scattering angle (1 is forward).

        Same shape as ``cos_psi``; its integral over the sphere is 1.
        """
        cosine = np.asarray(cos_psi, dtype=float)[..., np.newaxis]
        lobes = henyey_greenstein(cosine, self.hg_g)
        particles = np.sum(self.hg_weights * lobes, axis=-1)
        share = self.molecular_weight
        return (1 - share) * particles + share * molecular_phase(cosine[..., 0])


def water_optics(water: Water, wavelength_nm: float) -> Optics:
    """The optics of a scene's water at ``wavelength_nm`` (450 to 700); else InputError."""
    molecular = molecular_scattering_per_m(water.salinity_psu, wavelength_nm)
    scattering = molecular + (water.particle_scattering_per_m or 0.0)
    absorption = (water.particle_absorption_per_m or 0.0) + absorption_per_m(
        water.temperature_c, water.salinity_psu, wavelength_nm
    )
    return Optics(
        index=refractive_index(water.temperature_c, water.salinity_psu, wavelength_nm),
        absorption_per_mm=absorption / 1000,
        scattering_per_mm=scattering / 1000,
        hg_weights=PARTICLE_WEIGHTS / PARTICLE_WEIGHTS.sum(),
        hg_g=PARTICLE_G,
        molecular_weight=molecular / scattering,
    )


def refractive_index(temperature_c: float, salinity_psu: float, wavelength_nm: float) -> float:
    """Index of water relative to air: Quan & Fry 1995 (0-30 C, 0-35 psu, 400-700 nm)."""
    _within("temperature_c", temperature_c, TEMPERATURE_C)
    _within("salinity_psu", salinity_psu, SALINITY_PSU)
    _within("wavelength_nm", wavelength_nm, INDEX_NM)
    t, s, nm = temperature_c, salinity_psu, wavelength_nm
    return (
        1.31405
        + (1.779e-4 - 1.05e-6 * t + 1.6e-8 * t**2) * s
        - 2.02e-6 * t**2
        + (15.868 + 0.01155 * s - 0.00423 * t) / nm
        - 4382.0 / nm**2
        + 1.1455e6 / nm**3
    )


def air_index(wavelength_nm: float) -> float:
    """Absolute index of standard air (15 C, 101325 Pa): Ciddor 1996 (300-1690 nm)."""
    _within("wavelength_nm", wavelength_nm, AIR_NM)
    wavenumber2 = (1000 / wavelength_nm) ** 2
    return 1 + 1e-8 * (5792105 / (238.0185 - wavenumber2) + 167917 / (57.362 - wavenumber2))


def absolute_index(temperature_c: float, salinity_psu: float, wavelength_nm: float) -> float:
    """Index of water relative to vacuum, to be compared with IAPWS; ranges as Quan & Fry."""
    relative = refractive_index(temperature_c, salinity_psu, wavelength_nm)
    return relative * air_index(wavelength_nm)


def absorption_per_m(temperature_c: float, salinity_psu: float, wavelength_nm: float) -> float:
    """Absorption of pure (sea) water, 1/m: Pope & Fry 1997, linear between 450 and 700 nm.

    Temperature and salinity count only within 5 nm of 650 nm, where their slopes are known;
    elsewhere the value is that of pure water at 22 C.
    """
    _within("temperature_c", temperature_c, TEMPERATURE_C)
    _within("salinity_psu", salinity_psu, SALINITY_PSU)
    _within("wavelength_nm", wavelength_nm, (ABSORPTION_NM[0], ABSORPTION_NM[-1]))
    pure = float(np.interp(wavelength_nm, ABSORPTION_NM, ABSORPTION_PER_M))
    if abs(wavelength_nm - SLOPES_AT_NM) > SLOPES_WITHIN_NM:
        return pure
    warming = ABSORPTION_PER_M_C * (temperature_c - ABSORPTION_AT_C)
    return pure + warming + ABSORPTION_PER_M_PSU * salinity_psu


def molecular_scattering_per_m(salinity_psu: float, wavelength_nm: float) -> float:
    """Scattering of pure (sea) water, 1/m: a power law through Zhang, Hu & He 2009, 20 C.

    Linear in salinity.  Fitted at 532 to 660 nm; carried on to 450 and 700 nm, where Morel's
    exponent (-4.32 against the fit's -4.15) would differ by 3 %.
    """
    _within("salinity_psu", salinity_psu, SALINITY_PSU)
    _within("wavelength_nm", wavelength_nm, (ABSORPTION_NM[0], ABSORPTION_NM[-1]))
    fresh, sea = (
        np.exp(np.polyval(np.polyfit(np.log(MOLECULAR_NM), np.log(b), 1), np.log(wavelength_nm)))
        for b in (MOLECULAR_FRESH_PER_M, MOLECULAR_SEA_PER_M)
    )
    return float(fresh + (sea - fresh) * salinity_psu / SEA_PSU)


def molecular_phase(cos_psi: Floats) -> Floats:
    """Phase function of molecular scattering, 1/sr: 1 + cos2 (1 - d)/(1 + d), normalised."""
    anisotropy = (1 - DEPOLARISATION) / (1 + DEPOLARISATION)
    return (1 + anisotropy * cos_psi**2) / (4 * np.pi * (1 + anisotropy / 3))


def henyey_greenstein(cos_psi: Floats, g: Floats) -> Floats:
    """Henyey & Greenstein's phase function, 1/sr, of asymmetry ``g``; arguments broadcast."""
    distance2 = (1 - g) ** 2 + 2 * g * (1 - cos_psi)  # 1 + g2 - 2 g cos, exact near forward
    return (1 - g**2) / (4 * np.pi * distance2**1.5)


def _within(name: str, value: float, allowed: tuple[float, float]) -> None:
    low, high = allowed
    if not low <= value <= high:
        raise InputError(name, where="water", value=value, allowed=f"{low:g} to {high:g}")
