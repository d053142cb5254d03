"""Moments of a patch: rms height and slope, skewness, structure function, correlation length."""

from dataclasses import dataclass

import numpy as np
from scipy.signal import correlate

from lscan.errors import MeasurementError
from lscan.records import Floats, Ints
from lscan.roughness.patch import Patch
from lscan.roughness.spectra import detrended


@dataclass(frozen=True)
class RoughnessMoments:
    """Moments of a patch less its plane; what its noise adds to a mean square is taken off.

    Attributes
    ----------
    rms_height_cm : float, cm
    rms_slope_y, rms_slope_x : float, of differences of neighbouring cells
    skewness : float, of the heights; that of their noise is none
    correlation_length_cm : float, cm, at which the autocovariance has fallen to 1/e of the mean
        square; NaN where it does not within half of the patch
    """

    rms_height_cm: float
    rms_slope_y: float
    rms_slope_x: float
    skewness: float
    correlation_length_cm: float


@dataclass(frozen=True)
class StructureFunction:
    """Mean squared difference of heights against their distance along an axis.

    Attributes
    ----------
    distance_cm : (L,) array, cm
    difference_cm2 : (L,) array, cm²; what the points' noise adds is taken off
    pairs : (L,) array, of measured cells that far apart
    """

    distance_cm: Floats
    difference_cm2: Floats
    pairs: Ints


def moments(patch: Patch) -> RoughnessMoments:
    """The moments of a patch.

    Parameters
    ----------
    patch : Patch

    Raises
    ------
    MeasurementError
        The noise is as large as the roughness.
    """
    z = detrended(patch)
    heights = z[patch.seen]
    square = float((heights**2).mean()) - patch.points_noise_cm2
    if square <= 0:
        raise MeasurementError(
            f"roughness: the heights' rms of {np.sqrt((heights**2).mean()):.3g} cm is no more than "
            f"their noise, {np.sqrt(patch.points_noise_cm2):.3g} cm"
        )
    structures = [structure_function(patch, axis) for axis in (0, 1)]
    slopes = [np.sqrt(max(one.difference_cm2[0], 0.0)) / patch.cell_cm for one in structures]
    return RoughnessMoments(
        rms_height_cm=float(np.sqrt(square)),
        rms_slope_y=float(slopes[0]),
        rms_slope_x=float(slopes[1]),
        skewness=float((heights**3).mean() / square**1.5),
        correlation_length_cm=_correlation_length(structures, square),
    )


def structure_function(patch: Patch, axis: int) -> StructureFunction:
    """Of a patch less its plane, up to half of its length; pairs with a hole do not count.

    Parameters
    ----------
    patch : Patch
    axis : int, 0: along y, 1: along x
    """
    z, seen = detrended(patch), patch.seen.astype(float)
    if axis == 0:
        z, seen = z.T, seen.T
    count = z.shape[1]
    reach = slice(count, count + count // 2)  # lags from 1
    total, pairs = np.zeros(count // 2), np.zeros(count // 2)
    for heights, mask in zip(z, seen, strict=True):
        squares = correlate(heights**2, mask) + correlate(mask, heights**2)
        total += (squares - 2 * correlate(heights, heights))[reach]
        pairs += np.rint(correlate(mask, mask))[reach]
    known = pairs > 0
    distance = patch.cell_cm * np.arange(1, count // 2 + 1)
    # Cells between the same two points have part of their noise in common.
    apart = np.arange(1, count // 2 + 1) / (patch.points_cells if axis == 1 else 1.0)
    noise = 2 * patch.points_noise_cm2 * np.minimum(apart, 1.0)
    mean = np.maximum(total[known], 0.0) / pairs[known] - noise[known]
    return StructureFunction(distance[known], mean, pairs[known].astype(np.int64))


def _correlation_length(structures: list[StructureFunction], square_cm2: float) -> float:
    """cm, the mean over both axes of where the structure function reaches 2 (1 - 1/e) squares."""
    found = []
    for one in structures:
        beyond = np.flatnonzero(one.difference_cm2 >= 2 * (1 - np.exp(-1)) * square_cm2)
        if not len(beyond):
            return float("nan")
        k = int(beyond[0])
        steps = np.r_[0.0, one.difference_cm2[: k + 1]][-2:]
        places = np.r_[0.0, one.distance_cm[: k + 1]][-2:]
        found.append(np.interp(2 * (1 - np.exp(-1)) * square_cm2, steps, places))
    return float(np.mean(found))
