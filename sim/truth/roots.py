"""Roots of increasing functions, many at a time."""

from collections.abc import Callable

import numpy as np

from lscan.errors import MeasurementError
from lscan.records import Floats

# A Newton step this small, relative to 1 + |x|, leaves an error at the rounding of float64.
SMALL_STEP = 1e-13
MOST_STEPS = 200


def increasing_roots(
    function: Callable[[Floats], tuple[Floats, Floats]], low: Floats, high: Floats
) -> Floats:
    """(N,) roots of N increasing functions of one variable, in float64.

    function: takes (N,) arguments, returns (N,) values and (N,) positive slopes.
    low, high: (N,) brackets of the roots.  Newton's method from ``low``; where it would leave
    the bracket, the bracket is halved.  Raises MeasurementError where it does not converge.
    """
    x = low
    for _ in range(MOST_STEPS):
        value, slope = function(x)
        low, high = np.where(value < 0, x, low), np.where(value > 0, x, high)
        newton = x - value / slope
        kept = (newton >= low) & (newton <= high)
        following = np.where(kept, newton, (low + high) / 2)
        if np.all(np.abs(following - x) <= SMALL_STEP * (1 + np.abs(x))):
            return following
        x = following
    raise MeasurementError("the truth's root search did not converge")
