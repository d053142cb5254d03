"""A calibration that errs in four known ways, and what that does to the points of a scan."""

import numpy as np

from lscan.records import Floats, Surface

COUNT = 4
SCALES_MM = np.array([0.05, 0.04, 0.08, 0.06])


def errors(xz: Floats) -> Floats:
    """(..., 2, 4) displacement of points (..., 2) by each parameter of one standard deviation.

    A shift of x that grows with z, a height that bends along x, a turn of the sheet and a
    stretch of z: smooth, as errors of lens and port are, and of the sizes in SCALES_MM at 100 mm.
    """
    x, z = xz[..., 0] / 100, xz[..., 1] / 100
    nought = np.zeros_like(x)
    fields = [(z, nought), (nought, x**2 - 0.5), (-z, x), (nought, z + 0.3 * x**3)]
    modes = np.stack([np.stack(field, axis=-1) for field in fields], axis=-1)
    return modes * SCALES_MM


def surface_modes(surface: Surface) -> np.ndarray:
    """(F, N, 3, 4) of a surface in the head frame, single precision."""
    displaced = errors(surface.xyz_mm[..., [0, 2]])
    modes = np.zeros((*surface.status.shape, 3, COUNT), dtype=np.float32)
    modes[:, :, [0, 2]] = displaced
    modes[np.isnan(surface.xyz_mm[..., 0])] = np.nan
    return modes
