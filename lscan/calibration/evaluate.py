"""The estimate that a plane map gives for pixels, and how its uncertainty is put together."""

from dataclasses import dataclass

import numpy as np

from lscan.records import Floats


@dataclass(frozen=True)
class Estimate:
    """The points of N pixels; NaN where there is no value.

    Attributes
    ----------
    xz_mm : (N, 2) array, mm, plane frame
    variance_mm2 : (N, 2) array, mm², all noise, the pixel's and the calibration's
    modes_mm : (N, 2, M) array or None, mm, a square root of the calibration's part, as in
        PlanePoints; None where the map keeps no account of what its points have in common
    """

    xz_mm: Floats
    variance_mm2: Floats
    modes_mm: Floats | None = None


def propagated(xz_mm: Floats, jacobian: Floats, modes_mm: Floats, variance_px2: Floats) -> Estimate:
    """The estimate of a map whose parameters give its modes; NaN where the variance is.

    Parameters
    ----------
    xz_mm : (N, 2) array, mm, plane frame
    jacobian : (N, 2, 2) array, mm per px, the last axis by u and by v
    modes_mm : (N, 2, M) array, mm
    variance_px2 : (N,) array, px², of the pixels
    """
    variance = variance_px2[:, None] * (jacobian**2).sum(axis=2) + (modes_mm**2).sum(axis=2)
    return Estimate(np.where(np.isfinite(variance), xz_mm, np.nan), variance, modes_mm)


def square_root(covariance: Floats) -> Floats:
    """(K, K) L with L @ L.T the covariance, which may be singular.

    From the eigenvalues, with those that rounding took below 0 set to 0.

    Parameters
    ----------
    covariance : (K, K) array, symmetric
    """
    values, vectors = np.linalg.eigh(covariance)
    return vectors * np.sqrt(np.maximum(values, 0.0))


def separate_modes(of_x: Floats, of_z: Floats) -> Floats:
    """(N, 2, P + Q) modes of maps whose x and z have no parameter in common, mm.

    Parameters
    ----------
    of_x : (N, P) array, mm, of x alone
    of_z : (N, Q) array, mm, of z alone
    """
    modes = np.zeros((len(of_x), 2, of_x.shape[1] + of_z.shape[1]))
    modes[:, 0, : of_x.shape[1]] = of_x
    modes[:, 1, of_x.shape[1] :] = of_z
    return modes
