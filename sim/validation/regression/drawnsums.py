"""Sums of cases drawn from their law, as an extractor of normal errors would have them."""

import numpy as np

from lscan.benchmark.judging import CaseSums, normal_score

MISSED = 0.02


def drawn_sums(
    rng: np.random.Generator, cases: int, columns: int, factor: float = 1.0
) -> dict[str, CaseSums]:
    """Cases of normal errors, of scatters over two decades.

    Parameters
    ----------
    rng : Generator
    cases : int
    columns : int, of each case
    factor : float, by which errors are larger than the sigmas stated
    """
    sigma = np.geomspace(0.01, 1.0, cases)
    z = factor * rng.standard_normal((cases, columns))
    square, log_z = sigma**2 * (z**2).sum(axis=1), np.log(np.abs(z)).sum(axis=1)
    score = sigma * normal_score(z).sum(axis=1)
    missed = rng.binomial(columns, MISSED, cases)
    return {
        str(n): CaseSums(
            missed=missed[n], core=columns, square=square[n], log_z=log_z[n], score=score[n],
            sure=missed[n],
        )
        for n in range(cases)
    }  # fmt: skip
