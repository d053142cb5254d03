"""Smooth positive fields from counts in cells.

The counts are quasi-Poisson, and second differences of the field's logarithm have a Gaussian
prior (Whittaker 1923), as in ``sim.water.spread``.
"""

from functools import lru_cache
from math import exp

import numpy as np
from scipy.linalg import solveh_banded
from scipy.sparse import csc_array, dia_array, diags_array, eye_array, kron

from lscan.records import Floats, Mask

# Standard deviation a priori of the logarithm's second difference over cells, and of one across an
# edge, beside which light falls by several times within a cell.
CURVATURE, BROKEN = 0.1, 3.0
RIDGE = 1e-4  # for the plane that the prior leaves free, where nothing was counted
ITERATIONS, FARTHEST, CLOSE = 30, 2.0, 1e-3  # of Newton's method, and its steps
FEWEST = 1e-6  # counts


def smoothed(light: Floats, squared: Floats, lit: Mask) -> Floats:
    """The field in the cells; same shape as ``light``.

    Parameters
    ----------
    light : (H, W) array, sums in each cell
    squared : (H, W) array, sums of the squares of what was summed
    lit : (H, W) array of bool, on either side of an edge
    """
    if light.sum() <= 0:
        return np.zeros_like(light)
    unit = squared.sum() / light.sum()  # of counts that scatter as much as these sums
    counts = light.ravel() / unit
    prior = _prior(lit.tobytes(), lit.shape)
    mean = np.log(counts.mean())
    log_rate = np.zeros(counts.shape)  # above the mean
    for _ in range(ITERATIONS):
        rate = np.maximum(exp(mean) * np.exp(np.clip(log_rate, -50, 50)), FEWEST)
        wanted = log_rate + counts / rate - 1
        inverse = prior.copy()
        inverse[0] += rate
        step = solveh_banded(inverse, rate * wanted, overwrite_ab=True, lower=True) - log_rate
        log_rate += np.clip(step, -FARTHEST, FARTHEST)
        if np.abs(step).max() < CLOSE:
            break
    return np.reshape(unit * np.exp(mean + log_rate), light.shape)


@lru_cache(maxsize=4)  # the same for all layers of a table
def _prior(lit: bytes, shape: tuple[int, int]) -> Floats:
    """Inverse covariance a priori of the cells' logarithms: its diagonal and those beneath it."""
    cells = np.frombuffer(lit, dtype=bool)
    inverse = csc_array(RIDGE * eye_array(cells.size))
    second = [csc_array(np.diff(np.eye(size), 2, axis=0)) for size in shape]
    rows, columns = (eye_array(size) for size in shape)
    for difference in (csc_array(kron(second[0], columns)), csc_array(kron(rows, second[1]))):
        beside = abs(difference).sign() @ cells.astype(float)  # of the three cells
        spread = np.where((beside > 0) & (beside < 3), BROKEN, CURVATURE)
        inverse = csc_array(inverse + difference.T @ diags_array(spread**-2.0) @ difference)
    diagonals = dia_array(inverse)
    banded = np.zeros((1 - diagonals.offsets.min(), cells.size))
    for offset, values in zip(diagonals.offsets, diagonals.data, strict=True):
        if offset <= 0:
            banded[-offset, : values.size] = values
    return banded
