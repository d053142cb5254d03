"""What a sheet of finite thickness makes of a target's relief: the height that its line shows.

Light that falls a little before or behind the sheet's middle plane meets the target at
another height, and the camera, which looks at the sheet askew, sees it displaced even where
the target is level.  In a column of the picture, which follows the direction d = (kappa, 1)
in plan, light at the distance y from the middle plane appears in the sheet at the height

    zeta(y) = h(kappa y, y) + tau y,      kappa = r_x / r_y,  tau = -r_z / r_y

where h is the target's height about the point and r the line of sight.  A matt target lit by
a sheet of Gaussian irradiance g(y), standard deviation sigma, returns c(y) g(y), c being the
cosine of incidence, and the picture stretches it by zeta' = d zeta / dy.  The line's centroid is
that of zeta under the weight c zeta' g, of what is seen.

For a relief of small slopes the terms linear in h are left: the integral of h y² g / sigma², a
convolution along d.  A wave of wavenumber k is shown with the gain

    H(k) = (1 - q) exp(-q / 2),      q = (2 pi k sigma)²

which is 0 at 2 pi k sigma = 1 and negative beyond (both derived here).
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import spline_filter1d

from lscan.records import Floats

OFFSETS = np.arange(-4.25, 4.3, 0.25)
"""Distances from the middle plane, in sigmas, at which the light is taken: of y² g, by which the
linear terms are weighed, 4e-4 lies beyond."""


@dataclass(frozen=True)
class Sight:
    """How the camera sees, and the laser lights, R by C points of a target.

    Attributes
    ----------
    tau : (R, C) array, rise of the line of sight for each mm along d
    kappa : (C,) array, x for each mm of y along d
    to_apex : (2, R, C) array, mm, x and z from the points to where the light comes from
    """

    tau: Floats
    kappa: Floats
    to_apex: Floats


def transfer(wavenumber_per_mm: Floats, sigma_mm: float) -> Floats:
    """Gain with which waves of small slope are shown, as H above.

    Parameters
    ----------
    wavenumber_per_mm : array, 1/mm, along d
    sigma_mm : float, mm, standard deviation of the sheet's irradiance

    Examples
    --------
    >>> transfer(np.array([0.0, 1 / (2 * np.pi * 0.75)]), 0.75).round(6).tolist()
    [1.0, 0.0]
    """
    q = (2 * np.pi * wavenumber_per_mm * sigma_mm) ** 2
    return np.asarray((1 - q) * np.exp(-q / 2))


def responses(
    height_mm: Floats, row_mm: float, column_mm: float, sigma_mm: float, sight: Sight
) -> tuple[Floats, Floats]:
    """(R, C) heights that the line shows of a target, and those by the linear terms alone, mm.

    Parameters
    ----------
    height_mm : (R, C) array, mm, without gaps; each column runs along d
    row_mm, column_mm : float, mm, from row to row in y, and from column to column in x
    sigma_mm : float, mm, standard deviation of the sheet's irradiance
    sight : Sight, of those points
    """
    away = OFFSETS * sigma_mm
    around = _around(height_mm, away / row_mm)
    slope_x = np.gradient(height_mm, column_mm, axis=1) if height_mm.shape[1] > 1 else 0.0
    seen_at = around + sight.tau * away[:, None, None]
    rise = np.gradient(seen_at, away, axis=0)
    slope_y = rise - sight.tau - sight.kappa * slope_x
    apex_x, apex_z = sight.to_apex
    cosine = (apex_z - slope_x * apex_x) / np.sqrt(1 + slope_x**2 + slope_y**2)
    in_sight = (rise > 0) & (seen_at >= np.maximum.accumulate(seen_at, axis=0) - 1e-9)
    light = np.exp(-(OFFSETS**2) / 2)[:, None, None]
    weight = np.where(in_sight & (cosine > 0), cosine * rise * light, 0.0)
    total = weight.sum(axis=0)
    shown = (weight * seen_at).sum(axis=0) / np.where(total > 0, total, 1.0)
    kernel = OFFSETS**2 * np.exp(-(OFFSETS**2) / 2)
    linear = np.tensordot(kernel / kernel.sum(), around, 1)
    return np.where(total > 0, shown, linear), linear


def _around(height: Floats, rows: Floats) -> Floats:
    """(K, R, C) heights so many rows farther on, by cubic splines along the columns.

    Beyond the ends the last height goes on.
    """
    spline = spline_filter1d(height, axis=0, mode="nearest")
    beyond = int(np.ceil(np.abs(rows).max())) + 2
    padded = np.pad(spline, ((beyond, beyond), (0, 0)), mode="edge")
    found = np.zeros((len(rows), *height.shape))
    for shifted, row in zip(found, rows, strict=True):
        whole = int(np.floor(row))
        t = row - whole
        pieces = ((1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3)
        for number, piece in enumerate(pieces, start=beyond + whole - 1):
            shifted += piece / 6 * padded[number : number + len(height)]
    return found
