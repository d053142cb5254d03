"""Roughness of the seabed: spectrum, power law, ripples, moments, and where the instrument ends."""

from lscan.roughness.analysis import Roughness, roughness_of
from lscan.roughness.differences import Band
from lscan.roughness.instrument import (
    ScannerResponse,
    corrected_spectrum,
    cutoff_per_cm,
    noise_density,
)
from lscan.roughness.linereading import LineReading, line_reading
from lscan.roughness.model import PowerLaw, from_profiles
from lscan.roughness.moments import (
    RoughnessMoments,
    StructureFunction,
    moments,
    structure_function,
)
from lscan.roughness.patch import MM_PER_CM, Patch, patch_of, patch_of_cells
from lscan.roughness.profiles import patch_of_profiles
from lscan.roughness.profilewaves import ProfileWaves, profile_waves
from lscan.roughness.ripples import RippleTrain, find_ripples, fit_waves, without_ripples
from lscan.roughness.scanner import response_of
from lscan.roughness.scattering import (
    Backscatter,
    backscattering_strength,
    bragg_per_cm,
    predicted_backscatter,
    reflection,
    structure_constant,
)
from lscan.roughness.sediments import SEDIMENTS, Sediment, of_grain_size, sediment
from lscan.roughness.spectra import (
    PatchSpectrum,
    ProfileSpectrum,
    RingSpectrum,
    by_rings,
    capon_spectrum,
    patch_spectrum,
    profile_spectrum,
)
from lscan.roughness.spread import RippleSpread, ripple_spread
from lscan.roughness.whittle import PowerLawFit, fit_power_law, most_likely_law, usable_band

__all__ = [
    "MM_PER_CM",
    "SEDIMENTS",
    "Backscatter",
    "Band",
    "LineReading",
    "Patch",
    "PatchSpectrum",
    "PowerLaw",
    "PowerLawFit",
    "ProfileSpectrum",
    "ProfileWaves",
    "RingSpectrum",
    "RippleSpread",
    "RippleTrain",
    "Roughness",
    "RoughnessMoments",
    "ScannerResponse",
    "Sediment",
    "StructureFunction",
    "backscattering_strength",
    "bragg_per_cm",
    "by_rings",
    "capon_spectrum",
    "corrected_spectrum",
    "cutoff_per_cm",
    "find_ripples",
    "fit_power_law",
    "fit_waves",
    "from_profiles",
    "line_reading",
    "moments",
    "most_likely_law",
    "noise_density",
    "of_grain_size",
    "patch_of",
    "patch_of_cells",
    "patch_of_profiles",
    "patch_spectrum",
    "predicted_backscatter",
    "profile_spectrum",
    "profile_waves",
    "reflection",
    "response_of",
    "ripple_spread",
    "roughness_of",
    "sediment",
    "structure_constant",
    "structure_function",
    "usable_band",
    "without_ripples",
]
