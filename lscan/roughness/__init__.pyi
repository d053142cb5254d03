# The public names of lscan.roughness; __init__.py offers what is named here.

from lscan.roughness.analysis import Roughness as Roughness, roughness_of as roughness_of
from lscan.roughness.instrument import (
    LineReading as LineReading,
    ScannerResponse as ScannerResponse,
    corrected_spectrum as corrected_spectrum,
    cutoff_per_cm as cutoff_per_cm,
    line_reading as line_reading,
    noise_density as noise_density,
    response_of as response_of,
)
from lscan.roughness.patch import (
    MM_PER_CM as MM_PER_CM,
    Patch as Patch,
    patch_of as patch_of,
    patch_of_cells as patch_of_cells,
    patch_of_profiles as patch_of_profiles,
)
from lscan.roughness.ripples import (
    RippleSpread as RippleSpread,
    RippleTrain as RippleTrain,
    find_ripples as find_ripples,
    fit_waves as fit_waves,
    ripple_spread as ripple_spread,
    without_ripples as without_ripples,
)
from lscan.roughness.scattering import (
    SEDIMENTS as SEDIMENTS,
    Backscatter as Backscatter,
    Sediment as Sediment,
    backscattering_strength as backscattering_strength,
    bragg_per_cm as bragg_per_cm,
    of_grain_size as of_grain_size,
    predicted_backscatter as predicted_backscatter,
    reflection as reflection,
    sediment as sediment,
    structure_constant as structure_constant,
)
from lscan.roughness.spectra import (
    PatchSpectrum as PatchSpectrum,
    PowerLaw as PowerLaw,
    ProfileSpectrum as ProfileSpectrum,
    RingSpectrum as RingSpectrum,
    RoughnessMoments as RoughnessMoments,
    StructureFunction as StructureFunction,
    by_rings as by_rings,
    capon_spectrum as capon_spectrum,
    from_profiles as from_profiles,
    moments as moments,
    patch_spectrum as patch_spectrum,
    profile_spectrum as profile_spectrum,
    structure_function as structure_function,
)
from lscan.roughness.whittle import (
    Band as Band,
    PowerLawFit as PowerLawFit,
    fit_power_law as fit_power_law,
    most_likely_law as most_likely_law,
    usable_band as usable_band,
)
