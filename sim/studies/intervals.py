"""95 % confidence intervals from the scatter of a design's independent sets of points.

The jackknife takes one set away at a time.  Its pseudo-values are nearly independent values of
the figure itself, free of its bias of first order: their mean is the figure, their scatter gives
Student's interval.  A figure that cannot be negative, and is not near zero, gets it on a
logarithmic scale, where its distribution is more nearly symmetrical.

References
----------
Tukey 1958, Annals of Mathematical Statistics 29, 614; Efron & Stein 1981, Annals of Statistics 9.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from lscan.records import Floats
from sim.studies.sampling import SETS

CONFIDENCE = 0.95


@dataclass(frozen=True)
class Bounded:
    """A figure with its 95 % confidence interval; NaN where there is none."""

    value: float
    low: float
    high: float

    @property
    def half_width(self) -> float:
        """Half of the interval's width."""
        return (self.high - self.low) / 2


def set_sums(samples: Floats) -> Floats:
    """(SETS, q) sums of (N, q) samples over those of each set.

    Parameters
    ----------
    samples : (N, q) array, in the order of a design's block; zero where left out
    """
    sums: Floats = samples.reshape(-1, SETS, samples.shape[-1]).sum(axis=0)
    return sums


def pseudo_values(sums: Floats, figure: Callable[[Floats], Floats]) -> Floats:
    """(SETS,) pseudo-values of a figure; NaN of a set that has no samples.

    Parameters
    ----------
    sums : (SETS, q) array, sums over samples, the first of them their number
    figure : callable, from (..., q) sums to the figure, (...)
    """
    filled = sums[:, 0] > 0
    sets, total = int(filled.sum()), sums.sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        values = sets * figure(total) - (sets - 1) * figure(total - sums)
    return np.where(filled, values, np.nan)


def interval(pseudo: Floats, positive: bool = False) -> Bounded:
    """The figure and its interval.

    Parameters
    ----------
    pseudo : (SETS,) array, pseudo-values, NaN of an empty set
    positive : bool, the figure cannot be negative
    """
    pseudo = pseudo[np.isfinite(pseudo)]
    if len(pseudo) < 2:
        return Bounded(np.nan, np.nan, np.nan)
    value = float(pseudo.mean())
    error = float(pseudo.std(ddof=1)) / len(pseudo) ** 0.5
    reach = float(student.ppf(0.5 + CONFIDENCE / 2, len(pseudo) - 1)) * error
    if positive and value > reach:
        factor = float(np.exp(reach / value))
        return Bounded(value, value / factor, value * factor)
    return Bounded(value, value - reach, value + reach)
