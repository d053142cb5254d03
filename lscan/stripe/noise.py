"""The noise of a picture, estimated from that picture alone.

Two terms make up the variance of a pixel: one that is the same everywhere (reading noise and
rounding), seen in the pixels away from the line, and one that grows in proportion to the
light of the line, seen in how much the line's brightness jumps from one column to the next.
Photon noise follows the second law exactly.  Speckle and the target's own texture, whose
deviation (not variance) is proportional to the light, are stated too large by it: their
weight is at the line's crest, where a pixel hardly moves the centroid.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lscan.records import Floats, Ints

ROUNDING_VARIANCE = 1 / 12
"""Variance of rounding to whole digital numbers, DN²: a uniform distribution one DN wide."""

_SECOND_DIFFERENCE_GAIN = 6.0
"""Variance of I[i-1] - 2 I[i] + I[i+1] over that of I, for independent pixels: 1 + 4 + 1."""

_COLUMNS_SAMPLED = 64
_FEWEST_TRIPLES = 16


@dataclass(frozen=True)
class Noise:
    """Variance of a pixel: ``constant + per_dn · light``.

    constant: DN², at least that of rounding.
    per_dn: DN² of variance for each DN of light above the background.
    """

    constant: float
    per_dn: float

    def variance(self, light: Floats) -> Floats:
        """Variance in DN², same shape as ``light``, the grey values above the background."""
        return self.constant + self.per_dn * np.maximum(light, 0.0)


def constant_variance(columns: Floats) -> float:
    """Variance in DN² of the pixels away from the line.

    columns: (W, H) grey values in DN, one column of the picture a row.  Second differences
    along the columns cancel the background and its slope; the line's own are outliers and
    are cut off.  Neighbouring pixels must have independent noise: a picture that was
    smoothed or strongly compressed states too little.
    """
    step = max(1, len(columns) // _COLUMNS_SAMPLED)
    differences = np.diff(columns[::step], n=2, axis=1)
    return max(_robust_variance(differences) / _SECOND_DIFFERENCE_GAIN, ROUNDING_VARIANCE)


def line_variance_per_dn(light: Floats, at: Ints, constant: float) -> float:
    """Variance per DN of light on the line, in DN, from the scatter between columns.

    light: (K, n) grey values above the background in the window of each column that has a
        line.  at: (K,) the columns' indices, rising.  constant: as in :class:`Noise`.
    0 where fewer than 16 triples of neighbouring columns have a line.  Columns that are
    clipped scatter less than the light does.
    """
    together = (at[2:] - at[:-2]) == 2
    if np.count_nonzero(together) < _FEWEST_TRIPLES:
        return 0.0
    sums = light.sum(axis=1)
    scatter = _robust_variance(np.diff(sums, n=2)[together]) / _SECOND_DIFFERENCE_GAIN
    return max(scatter - light.shape[1] * constant, 0.0) / float(np.median(sums))


def _robust_variance(values: Floats) -> float:
    """Variance about zero of the normal core of ``values``, what lies outside 3 sigma cut off.

    Starts from the median absolute deviation and cuts thrice; a normal distribution cut at
    3 sigma keeps 0.97334 of its variance (1 - 6 phi(3) / (2 Phi(3) - 1)).
    """
    if values.size == 0:
        return 0.0
    sizes = np.abs(values).ravel()
    start = 1.4826 * float(np.median(sizes))
    variance = max(start**2, _SECOND_DIFFERENCE_GAIN * ROUNDING_VARIANCE)
    for _ in range(3):
        core = sizes[sizes <= 3 * np.sqrt(variance)]
        if core.size == 0:
            break
        variance = float(np.square(core).mean()) / 0.97334
    return variance
