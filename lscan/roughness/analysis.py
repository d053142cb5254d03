"""All that is asked of a patch's roughness, in the order in which each needs the last."""

from dataclasses import asdict, dataclass
from math import log10
from typing import Any

from lscan.records import Progress
from lscan.roughness.differences import Band
from lscan.roughness.instrument import ScannerResponse, corrected_spectrum, cutoff_per_cm
from lscan.roughness.moments import RoughnessMoments, moments
from lscan.roughness.patch import Patch
from lscan.roughness.ripples import RippleTrain, find_ripples, without_ripples
from lscan.roughness.spectra import PatchSpectrum, patch_spectrum
from lscan.roughness.spread import RippleSpread, ripple_spread
from lscan.roughness.whittle import PowerLawFit, fit_power_law, most_likely_law, usable_band

RIPPLES = (
    "wavelength_cm", "heading_deg", "height_cm",
    "sigma_wavelength_cm", "sigma_heading_deg", "sigma_height_cm",
)  # fmt: skip


@dataclass(frozen=True)
class Roughness:
    """The roughness of a patch.

    Attributes
    ----------
    moments : RoughnessMoments
    ripples : RippleTrain or None, the train that stands out
    spread : RippleSpread or None, of that train
    fit : PowerLawFit, of what is left without it, up to the cutoff
    cutoff_per_cm : float, rad/cm, beyond it the instrument is measured
    spectrum : PatchSpectrum, W2 as measured, ripples included
    corrected : PatchSpectrum, the same less the noise, over what the instrument passes
    """

    moments: RoughnessMoments
    ripples: RippleTrain | None
    spread: RippleSpread | None
    fit: PowerLawFit
    cutoff_per_cm: float
    spectrum: PatchSpectrum
    corrected: PatchSpectrum

    def figures(self) -> dict[str, float]:
        """The numbers by name, units in the names; _sigma: standard uncertainty.

        low and high are the ends of a 95 % interval.
        """
        fit, law = self.fit, self.fit.law
        w2_db = 10 * log10(law.w2_cm4)
        reach, reach_db = fit.within * fit.sigma_gamma2, fit.within * fit.sigma_w2_db
        found = {
            "gamma2": law.gamma2,
            "gamma2_low": law.gamma2 - reach,
            "gamma2_high": law.gamma2 + reach,
            "w2_cm4": law.w2_cm4,
            "w2_low_cm4": 10 ** ((w2_db - reach_db) / 10),
            "w2_high_cm4": 10 ** ((w2_db + reach_db) / 10),
            "band_low_per_cm": fit.band.low_per_cm,
            "band_high_per_cm": fit.band.high_per_cm,
            "cutoff_per_cm": self.cutoff_per_cm,
            **asdict(self.moments),
        }
        if law.stretch != (0.0, 0.0):
            found |= {"stretch_ratio": law.ratio, "stretch_heading_deg": law.heading_deg}
        if self.ripples is not None:
            ripples = asdict(self.ripples)
            found |= {f"ripple_{name}": ripples[name] for name in RIPPLES}
        if self.spread is not None:
            found["ripple_spread"] = self.spread.relative
            found["ripple_spread_heading_deg"] = self.spread.heading_deg
        return found


def roughness_of(
    patch: Patch,
    response: ScannerResponse | None = None,
    *,
    stretched: bool = False,
    seed: int = 1,
    progress: Progress | None = None,
) -> Roughness:
    """Moments, ripples, power law and cutoff of a patch.

    Parameters
    ----------
    patch : Patch, cm
    response : ScannerResponse, optional; by default one that takes nothing away
    stretched : bool, whether the power law may differ between directions
    seed : int, of the simulated patches that intervals come from
    progress : Progress or None, called with (done, all) after each of those

    Raises
    ------
    MeasurementError
        The patch is too small, too noisy, or has no power law.

    Examples
    --------
    >>> import numpy as np
    >>> from lscan.roughness import Patch, roughness_of
    >>> y, x = np.mgrid[:40, :40] * 0.2
    >>> rough = np.random.default_rng(0).standard_normal(x.shape).cumsum(0).cumsum(1) * 0.005
    >>> patch = Patch(rough + 0.3 * np.cos(2 * np.pi * x / 2.0), np.full(x.shape, True), 0.2)
    >>> ripples = roughness_of(patch).ripples
    >>> round(ripples.wavelength_cm, 1), round(ripples.height_cm, 1)
    (2.0, 0.6)
    """
    response = response or ScannerResponse()
    train = find_ripples(patch, response=response)
    rest = patch if train is None else without_ripples(patch, train)
    spread = None if train is None else ripple_spread(patch, train)
    told: dict[str, Any] = {
        "stretched": stretched, "response": response, "known": response.known
    }  # fmt: skip
    cutoff = cutoff_per_cm(most_likely_law(rest, **told), rest, response)
    usable = usable_band(rest)
    band = Band(usable.low_per_cm, min(usable.high_per_cm, cutoff))
    fit = fit_power_law(rest, band=band, seed=seed, progress=progress, **told)
    spectrum = patch_spectrum(patch)
    corrected = corrected_spectrum(spectrum, patch, response)
    return Roughness(moments(patch), train, spread, fit, cutoff, spectrum, corrected)
