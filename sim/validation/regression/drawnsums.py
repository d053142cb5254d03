"""Sums of cases drawn from their law, as an extractor of normal errors would have them."""

import numpy as np

from lscan.benchmark.against import LOG_Z
from lscan.benchmark.judging import CaseSums

MISSED = 0.02


def drawn_sums(
    rng: np.random.Generator, cases: int, columns: int, factor: float = 1.0
) -> dict[str, CaseSums]:
    """Cases of normal errors, of scatters over two decades.

    A sum of squares has the law of chi squared; of ln |z| the mean is -(gamma + ln 2) / 2 and the
    variance pi² / 8, and a sum of many is nearly normal.

    Parameters
    ----------
    rng : Generator
    cases : int
    columns : int, of each case
    factor : float, by which errors are larger than the sigmas stated
    """
    square = (factor * np.geomspace(0.01, 1.0, cases)) ** 2 * rng.chisquare(columns, cases)
    mean = np.log(factor) + LOG_Z
    log_z = rng.normal(columns * mean, np.pi * (columns / 8) ** 0.5, cases)
    missed = rng.binomial(columns, MISSED, cases)
    return {
        str(n): CaseSums(
            missed=missed[n], core=columns, square=square[n], log_z=log_z[n], sure=missed[n]
        )
        for n in range(cases)
    }
