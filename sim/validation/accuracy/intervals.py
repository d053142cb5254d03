"""How often 95 % intervals contain the truth."""

import numpy as np

from lscan.records import Floats

COVER = 1.959964  # standard deviations on either side that hold 95 % of a normal distribution


def share_inside(error: Floats, sigma: Floats) -> float:
    """Share of the errors, any shape, that lie within 1.96 of their sigmas."""
    return float(np.mean(np.abs(error) <= COVER * sigma))


def band_miss_percent(share: float) -> float:
    """How far a share is from 95 %, in percentage points: at most 2 is asked for."""
    return 100 * abs(share - 0.95)
