"""The index of the water with which a physical map fits a new picture of the board best."""

from dataclasses import dataclass

import numpy as np

from lscan.calibration.motion import fit_similarity
from lscan.calibration.physical import PhysicalMap
from lscan.camera.posedboards import LIMITS, WATER
from lscan.records import Floats

INDEX_STEP = 1e-4  # for differences by the index: 0.1 px, of which the second order is 1e-5 px
ROUNDS = 3  # the map is nearly linear in the index: 0.01 of it is off by 1 % after the first


@dataclass(frozen=True)
class FoundIndex:
    """The index of the water, everything else being where the calibration has it.

    Attributes
    ----------
    index, sigma : float, relative to air, and its standard uncertainty
    chi_square : float, of the residuals that it leaves
    """

    index: float
    sigma: float
    chi_square: float


def find_index(
    plane_map: PhysicalMap, nominal_mm: Floats, image_px: Floats, sigma_px: Floats
) -> FoundIndex:
    """The index by generalised least squares, with a shift and a turn of the board beside it.

    It is sought within the camera's LIMITS.

    Parameters
    ----------
    plane_map : PhysicalMap, behind a flat port
    nominal_mm : (N, 2) array, mm, of the marks on the board
    image_px : (N, 2) array, px, of (u, v), where the new picture has them
    sigma_px : (N,) array, px, standard uncertainties of those
    """
    index, sigma, chi_square = float(plane_map.geometry.theta[WATER]), np.inf, np.inf
    least, most = LIMITS["water_index"]
    for _ in range(ROUNDS):
        index = float(np.clip(index, least + INDEX_STEP, most - INDEX_STEP))
        points = plane_map.in_water((index, 0.0)).to_plane(image_px, sigma_px)
        above, below = (
            plane_map.in_water((index + step, 0.0)).locate(image_px)
            for step in (INDEX_STEP, -INDEX_STEP)
        )
        missed = (below - above) / (2 * INDEX_STEP)  # where the index is a unit more than taken
        fit = fit_similarity(nominal_mm, points.xz_mm, points.sigma_mm, points.modes_mm, missed)
        index, sigma = index + fit.scale, float(np.sqrt(fit.covariance[3, 3]))
        chi_square = fit.chi_square
    return FoundIndex(float(np.clip(index, least, most)), sigma, chi_square)
