"""What all plane maps share: which pixels get a value, and the uncertainty stated with it."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from lscan.calibration.readings import found_marks
from lscan.calibration.region import Region
from lscan.errors import InputError
from lscan.records import BoardReading, Floats, Mask, PlanePoints, Status


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


def propagated(xz_mm: Floats, slope: Floats, modes_mm: Floats, variance_px2: Floats) -> Estimate:
    """The estimate of a map whose parameters give its modes; NaN where the variance is.

    Parameters
    ----------
    xz_mm : (N, 2) array, mm, plane frame
    slope : (N, 2, 2) array, mm per px, the last axis by u and by v
    modes_mm : (N, 2, M) array, mm
    variance_px2 : (N,) array, px², of the pixels
    """
    variance = variance_px2[:, None] * (slope**2).sum(axis=2) + (modes_mm**2).sum(axis=2)
    return Estimate(np.where(np.isfinite(variance), xz_mm, np.nan), variance, modes_mm)


class Estimator(Protocol):
    """The part of a plane map that knows its formula."""

    @property
    def region(self) -> Region:
        """Where the map holds."""
        ...

    @property
    def lack_of_fit_mm(self) -> Floats:
        """(2,) standard uncertainty of x and z that noise does not account for."""
        ...

    def estimate(self, image_px: Floats, variance_px2: Floats) -> Estimate:
        """The points of pixels that the region covers.

        Parameters
        ----------
        image_px : (N, 2) array, px, of (u, v)
        variance_px2 : (N,) array, px², of either pixel coordinate
        """
        ...


def to_points(estimator: Estimator, image_px: Floats, sigma_px: Floats | None) -> PlanePoints:
    """The points of all pixels, as ``PlaneMap.to_plane`` promises them.

    Parameters
    ----------
    estimator : Estimator, the part of a map that knows its formula
    image_px : (N, 2) array, px, of (u, v); NaN has the status NO_DATA
    sigma_px : (N,) array or None, px; 0 where None

    Raises
    ------
    InputError
        For arrays of wrong shape, and for a sigma_px that is negative or NaN beside a pixel that is
        neither.
    """
    image_px = np.asarray(image_px, dtype=float)
    if image_px.ndim != 2 or image_px.shape[1] != 2:
        raise InputError("bad shape", where="image_px", value=image_px.shape, allowed="(N, 2)")
    sigma = _checked_sigma(image_px, sigma_px)
    finite = np.isfinite(image_px[:, 0]) & np.isfinite(image_px[:, 1])
    covered = np.zeros(len(image_px), dtype=bool)
    covered[finite] = estimator.region.covers(image_px[finite])
    xz, variance = np.full((2, len(image_px), 2), np.nan)
    estimate = estimator.estimate(image_px[covered], sigma[covered] ** 2)
    xz[covered] = estimate.xz_mm
    variance[covered] = estimate.variance_mm2 + estimator.lack_of_fit_mm**2
    valued = np.isfinite(xz).all(axis=1)
    missing = np.isnan(image_px).any(axis=1)
    status = np.where(valued, Status.OK, np.where(missing, Status.NO_DATA, Status.OUT_OF_BOARD))
    xz[~valued], variance[~valued] = np.nan, np.nan
    modes = _modes(estimate, covered, valued)
    return PlanePoints(xz, np.sqrt(variance), status.astype(np.int64), modes)


def _modes(estimate: Estimate, covered: Mask, valued: Mask) -> Floats | None:
    """(N, 2, M) the modes of the covered pixels among all, NaN where there is no value."""
    if estimate.modes_mm is None:
        return None
    modes = np.full((len(covered), *estimate.modes_mm.shape[1:]), np.nan)
    modes[covered] = estimate.modes_mm
    modes[~valued] = np.nan
    return modes


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


def _checked_sigma(image_px: Floats, sigma_px: Floats | None) -> Floats:
    if sigma_px is None:
        return np.zeros(len(image_px))
    sigma = np.asarray(sigma_px, dtype=float)
    if sigma.shape != image_px.shape[:1]:
        raise InputError(
            "bad shape", where="sigma_px", value=sigma.shape, allowed=f"({len(image_px)},)"
        )
    bad = np.isfinite(image_px).all(axis=1) & ~((sigma >= 0) & np.isfinite(sigma))
    if bad.any():
        first = int(np.flatnonzero(bad)[0])
        raise InputError(
            "bad uncertainty",
            where=f"sigma_px[{first}]",
            value=float(sigma[first]),
            allowed="a finite number not below 0",
        )
    return sigma


def lack_of_fit_mm(estimator: Estimator, reading: BoardReading) -> Floats:
    """(2,) what the map's form, not noise, adds to the uncertainty of x and of z, in mm rms.

    The map is applied to the marks of the board; the mean square of the residuals less the
    mean square that the marks' and the map's noise explain, never below 0.  The control
    points check both coordinates.  A ruler checks the one that is fixed on it, which no map
    reads from it: the marks of the vertical rulers, half-way between control points, check
    x.  Without rulers only the fit to the control points themselves can be judged, and what
    happens between them stays unseen.

    Parameters
    ----------
    estimator : Estimator, of the map
    reading : BoardReading, px and mm, the map was solved from
    """
    return np.array([_excess_mm(estimator, reading, 0), _excess_mm(estimator, reading, 1)])


def _excess_mm(estimator: Estimator, reading: BoardReading, coordinate: int) -> float:
    direction = ("vertical", "horizontal")[coordinate]
    rulers = [ruler.marks for ruler in reading.rulers if ruler.direction == direction]
    known, image, sigma = found_marks([reading.grid, *rulers])
    covered = estimator.region.covers(image)
    estimate = estimator.estimate(image[covered], sigma[covered] ** 2)
    residual = estimate.xz_mm[:, coordinate] - known[covered, coordinate]
    valued = np.isfinite(residual)
    if not valued.any():
        return 0.0
    explained = estimate.variance_mm2[valued, coordinate]
    return float(np.sqrt(max(0.0, np.mean(residual[valued] ** 2) - np.mean(explained))))
