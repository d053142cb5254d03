"""A measured length with the parts of its uncertainty, and the mean of it over pictures."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lscan.records import Floats

OUTLIER = 5.0
"""Values farther from the median than this many of their own standard uncertainties, and of the
robust scatter of all, are left out of a mean."""

TINY = 1e-6  # mm; lengths without any noise weigh alike


@dataclass(frozen=True)
class LengthBudget:
    """A length with the parts of its uncertainty (the budget of the GUM).

    Attributes
    ----------
    value_mm : float, mm
    own_mm : float, mm, standard uncertainty from noise, another in every picture
    common_mm : float, mm, what errs alike in all pictures of one place and is not among the modes
    modes_mm : (M,) array or None, mm, how each mode of the calibration changes the length; None
        where none are known
    """

    value_mm: float
    own_mm: float
    common_mm: float
    modes_mm: Floats | None = None

    @property
    def sigma_mm(self) -> float:
        """Standard uncertainty, all parts together."""
        modes = 0.0 if self.modes_mm is None else float(np.linalg.norm(self.modes_mm))
        return float(np.linalg.norm([self.own_mm, self.common_mm, modes]))


def mean_length(lengths: Sequence[LengthBudget]) -> LengthBudget:
    """The mean of a length over several pictures, weighted by what they know of it.

    Outliers (see OUTLIER) are left out.  The mean's own_mm is that of its weights, enlarged where
    the values scatter more than their own noise says; what is common does not average out.

    Parameters
    ----------
    lengths : sequence of LengthBudget, mm, one a picture
    """
    value = np.array([length.value_mm for length in lengths])
    own = np.array([length.own_mm for length in lengths])
    common = np.array([length.common_mm for length in lengths])
    off = np.abs(value - np.median(value))
    kept = off <= OUTLIER * np.maximum(np.hypot(own, common), 1.4826 * np.median(off)) + 1e-9
    weight = kept / (own**2 + common**2 + TINY**2)
    weight = weight / weight.sum()
    mean = float(weight @ value)
    spread = float(np.linalg.norm(weight * own))
    if kept.sum() > 1:
        scatter = float(weight @ (value - mean) ** 2) / (int(kept.sum()) - 1)
        spread = max(spread, float(np.sqrt(scatter)))
    modes = [length.modes_mm for length in lengths]
    known = [mode for mode in modes if mode is not None]
    return LengthBudget(
        value_mm=mean,
        own_mm=spread,
        common_mm=float(np.sqrt(weight @ common**2)),
        modes_mm=weight @ np.array(known) if len(known) == len(modes) else None,
    )
