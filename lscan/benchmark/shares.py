"""The share of errors within a limit."""

from __future__ import annotations

import numpy as np

from lscan.records import Floats


def share_within(limit: float, errors: Floats) -> float:
    """Share of the errors, magnitudes of any shape, up to ``limit``; NaN where one is NaN."""
    return float(np.mean(np.where(np.isnan(errors), np.nan, errors <= limit)))
