"""How often 95 % intervals contain the truth."""

from collections.abc import Iterable

import numpy as np

from lscan.records import Floats, Length

COVER = 1.959964  # standard deviations on either side that hold 95 % of a normal distribution
BAND = (0.93, 0.97)


def share_inside(error: Floats, sigma: Floats) -> float:
    """Share of the errors, any shape, that lie within 1.96 of their sigmas."""
    return float(np.mean(np.abs(error) <= COVER * sigma))


def share_of_lengths(lengths: Iterable[Length]) -> float:
    """Share of measured lengths whose 95 % interval contains the nominal one."""
    every = list(lengths)
    error = np.array([length.error_mm for length in every])
    return share_inside(error, np.array([length.sigma_mm for length in every]))


def band_miss_percent(share: float) -> float:
    """How far a share is from 95 %, in percentage points: at most 2 is asked for."""
    return 100 * abs(share - 0.95)
