"""What the instrument does to a spectrum: what it passes, what it adds, and where that ends.

A scanner averages the seabed over the laser sheet's thickness along the track, over a pixel along
the line, and over a cell of the grid both ways; its points scatter.  The share of the power that is
passed is divided out where the signal is above the noise; beyond the cutoff it is the instrument
that is measured.
"""

from dataclasses import dataclass

import numpy as np

from lscan.errors import InputError
from lscan.records import Floats
from lscan.roughness.model import PowerLaw
from lscan.roughness.patch import Patch

FARTHEST_DB = 1.0  # that a spectrum may be off at its cutoff
RESPONSE_KNOWN = 0.2  # of the decibels that the response takes away, its standard uncertainty


@dataclass(frozen=True)
class ScannerResponse:
    """The lengths that a scanner averages over.

    Attributes
    ----------
    sheet_cm : float, cm, along y: standard deviation of the light across the sheet, where it meets
        the seabed
    pixel_cm : float, cm, along x: width of a pixel on the seabed
    cell_cm : float, cm, side of the grid's cells, both ways
    """

    sheet_cm: float = 0.0
    pixel_cm: float = 0.0
    cell_cm: float = 0.0

    def __post_init__(self) -> None:
        """Raise InputError where a length is negative."""
        for name, length in vars(self).items():
            if not length >= 0:
                raise InputError(name, value=length, allowed="0 cm or more")

    def __call__(self, along_y: Floats | float, along_x: Floats | float) -> Floats:
        """Share of the power at wavenumbers that is passed.

        A Gaussian across the sheet, a box for a pixel, and for a cell the middle of the quadratic
        that grid_cells fits to it.

        Parameters
        ----------
        along_y, along_x : array or float, rad/cm
        """
        passed = np.exp(-((np.asarray(along_y) * self.sheet_cm) ** 2))
        passed = passed * np.sinc(np.asarray(along_x) * self.pixel_cm / (2 * np.pi)) ** 2
        halves = (np.asarray(along) * self.cell_cm / 2 for along in (along_y, along_x))
        return np.asarray(passed * _of_quadratic(*halves) ** 2)


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


def cutoff_per_cm(law: PowerLaw, patch: Patch, response: ScannerResponse) -> float:
    """rad/cm, the wavenumber beyond which the instrument is measured, not the seabed.

    Where noise is a quarter of what is passed, so that it alone would lift the spectrum by 1 dB, or
    where a fifth of what the response takes away is 1 dB: the more the response has to be divided
    out, the better it would have to be known.  Up to Nyquist's wavenumber, along the worse axis.

    Parameters
    ----------
    law : PowerLaw, of the seabed
    patch : Patch, its noise and its cells
    response : ScannerResponse
    """
    size = np.geomspace(1e-3, 1.0, 2000) * patch.nyquist_per_cm
    lowest = patch.nyquist_per_cm
    for along_y, along_x in ((size, 0 * size), (0 * size, size)):
        passed = response(along_y, along_x)
        added_db = 10 * np.log10(
            1 + noise_density(patch) / (law.density(along_y, along_x) * passed)
        )
        taken_db = -10 * np.log10(passed) * RESPONSE_KNOWN
        beyond = np.flatnonzero(np.hypot(added_db, taken_db) > FARTHEST_DB)
        if len(beyond):
            lowest = min(lowest, float(size[beyond[0]]))
    return lowest
