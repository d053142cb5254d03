"""What the instrument does to a spectrum: what it passes, what it adds, and where that ends.

A scanner averages the seabed over the laser sheet's thickness along the track, over the lens's blur
and a pixel along the line, and over a cell of the grid both ways; its points scatter.  The share of
the power that is passed is divided out where the signal is above the noise; beyond the cutoff it is
the instrument that is measured.
"""

from dataclasses import dataclass, replace

import numpy as np

from lscan.errors import InputError
from lscan.records import Floats, Mask
from lscan.roughness.linereading import LineReading
from lscan.roughness.model import PowerLaw
from lscan.roughness.patch import MM_PER_CM, Patch
from lscan.roughness.spectra import PatchSpectrum
from lscan.stripe.corrections import correction_gain
from lscan.surface.sheetresponse import transfer

FARTHEST_DB = 1.0  # that a spectrum may be off at its cutoff
LENGTHS_KNOWN = 0.05  # relative standard uncertainty that the response's lengths are taken to have
LENGTHS = ("sheet_cm", "blur_cm", "pixel_cm", "cell_cm")
LEAST_PASSED = 0.05  # share of the power that is divided by


@dataclass(frozen=True)
class ScannerResponse:
    """What a scanner averages over, and what of that its extractor has given back.

    Attributes
    ----------
    sheet_cm : float, cm, along y: standard deviation of the light across the sheet, where it meets
        the seabed, of heights that are not corrected for its thickness
    blur_cm : float, cm, along x: standard deviation of the lens's blur on the seabed
    pixel_cm : float, cm, along x: width of a pixel on the seabed
    cell_cm : float, cm, side of the grid's cells, both ways
    corrected_px : float, px, the blur that lines were corrected for along themselves, as
        ``[stripe] blur_px`` has it; 0: not corrected
    aside : tuple of float, x for each mm of y along lines of sight in plan, of parts of the patch
        that are alike in size: that way a sheet averages, as ``lscan.surface.sheetresponse`` has it
    reading : LineReading or None, how the extractor reads a line on waves as fine as the sheet is
        thick; by default as the centroid of all of its light
    """

    sheet_cm: float = 0.0
    blur_cm: float = 0.0
    pixel_cm: float = 0.0
    cell_cm: float = 0.0
    corrected_px: float = 0.0
    aside: tuple[float, ...] = (0.0,)
    reading: LineReading | None = None

    def __post_init__(self) -> None:
        """Raise InputError where a length is negative, or a correction's pixels have none."""
        for name in LENGTHS:
            if not (length := getattr(self, name)) >= 0:
                raise InputError(name, value=length, allowed="0 cm or more")
        if not self.corrected_px >= 0:
            raise InputError("corrected_px", value=self.corrected_px, allowed="0 px or more")
        if self.corrected_px and not self.pixel_cm:
            raise InputError("pixel_cm", value=0.0, allowed="above 0 cm with corrected_px")

    def __call__(self, along_y: Floats | float, along_x: Floats | float) -> Floats:
        """Share of the power at wavenumbers that is passed.

        A sheet as ``lscan.surface.sheetresponse`` or the extractor's reading has it, a Gaussian for
        the blur, a box for a pixel, what the extractor's correction for blur gives back, and for a
        cell the middle of the quadratic that grid_cells fits to it.

        Parameters
        ----------
        along_y, along_x : array or float, rad/cm
        """
        along_y, along_x = np.asarray(along_y), np.asarray(along_x)
        passed = np.mean([self._of_sheet(along_y + k * along_x) ** 2 for k in self.aside], axis=0)
        passed = passed * np.exp(-((along_x * self.blur_cm) ** 2))
        passed = passed * np.sinc(along_x * self.pixel_cm / (2 * np.pi)) ** 2
        if self.corrected_px:
            passed = passed * correction_gain(along_x * self.pixel_cm, self.corrected_px) ** 2
        halves = (along * self.cell_cm / 2 for along in (along_y, along_x))
        return np.asarray(passed * _of_quadratic(*halves) ** 2)

    def _of_sheet(self, across: Floats) -> Floats:
        """Gain of the amplitude of waves of so many rad/cm across the sheet, along a sight."""
        if self.reading is not None:
            return self.reading.at(across * self.sheet_cm)
        return transfer(across / MM_PER_CM / (2 * np.pi), self.sheet_cm * MM_PER_CM)

    def known(self, along_y: Floats | float, along_x: Floats | float) -> Mask:
        """Where enough is passed, and how much is known to 1 dB though lengths be 5 % longer.

        Parameters
        ----------
        along_y, along_x : array or float, rad/cm
        """
        lengths = {name: (1 + LENGTHS_KNOWN) * getattr(self, name) for name in LENGTHS}
        longer = replace(self, **lengths)
        passed, less = self(along_y, along_x), longer(along_y, along_x)
        return np.asarray((passed >= LEAST_PASSED) & (less >= passed * 10 ** (-FARTHEST_DB / 10)))


def _of_quadratic(half_y: Floats, half_x: Floats) -> Floats:
    """What the middle of a quadratic through cos(h_y s + h_x t), over a square, keeps of it.

    It is 7/2 <f> - 15/4 (<s² f> + <t² f>), means over -1 to 1, by least squares.
    """
    (mean_y, second_y), (mean_x, second_x) = (_means_of_cosine(half) for half in (half_y, half_x))
    return 7 / 2 * mean_y * mean_x - 15 / 4 * (second_y * mean_x + mean_y * second_x)


def _means_of_cosine(half: Floats) -> tuple[Floats, Floats]:
    """Means of cos(h t) and of t² cos(h t) over -1 to 1; series where the closed form cancels."""
    small = np.abs(half) < 0.05
    h = np.where(small, 1.0, half)
    mean = np.where(small, 1 - half**2 / 6 + half**4 / 120, np.sin(h) / h)
    closed = np.sin(h) / h + 2 * np.cos(h) / h**2 - 2 * np.sin(h) / h**3
    return mean, np.where(small, 1 / 3 - half**2 / 10 + half**4 / 168, closed)


def noise_density(patch: Patch) -> float:
    """cm^4, the spectrum of the cells' own noise, which is white.

    Parameters
    ----------
    patch : Patch
    """
    return patch.noise_cm2 * patch.cell_cm**2 / (2 * np.pi) ** 2


def corrected_spectrum(
    spectrum: PatchSpectrum, patch: Patch, response: ScannerResponse
) -> PatchSpectrum:
    """A spectrum less the cells' noise, over what the response passes; NaN where that is not known.

    Parameters
    ----------
    spectrum : PatchSpectrum, as measured
    patch : Patch, it was measured on
    response : ScannerResponse
    """
    plane = spectrum.along_y_per_cm, spectrum.along_x_per_cm
    signal = spectrum.density_cm4 - noise_density(patch)
    passed = np.maximum(response(*plane), LEAST_PASSED)
    density = np.where(response.known(*plane), signal / passed, np.nan)
    return replace(spectrum, density_cm4=density)


def cutoff_per_cm(law: PowerLaw, patch: Patch, response: ScannerResponse) -> float:
    """rad/cm, the wavenumber beyond which the instrument is measured, not the seabed.

    Where noise is a quarter of what is passed, so that it alone would lift the spectrum by 1 dB,
    in the mean over the directions in which the response is known, or where it is known in none;
    up to Nyquist's wavenumber.

    Parameters
    ----------
    law : PowerLaw, of the seabed
    patch : Patch, its noise and its cells
    response : ScannerResponse
    """
    size = np.geomspace(1e-3, 1.0, 1000)[:, np.newaxis] * patch.nyquist_per_cm
    way = np.linspace(0.0, np.pi, 72, endpoint=False)
    plane = size * np.sin(way), size * np.cos(way)
    weight = np.where(response.known(*plane), law.density(*plane), 0.0)
    noise = noise_density(patch) / np.maximum(response(*plane), LEAST_PASSED)
    total = weight.sum(axis=1)
    lifted = np.where(weight > 0, noise, 0.0).sum(axis=1) > (10 ** (FARTHEST_DB / 10) - 1) * total
    beyond = np.flatnonzero(lifted | (total == 0))
    return float(size[beyond[0], 0]) if len(beyond) else patch.nyquist_per_cm
