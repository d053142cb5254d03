"""Whether a suite notices what is done to an extractor: twenty mutations and the paired test."""

from typing import Any

import numpy as np

from lscan.benchmark.judging import CaseSums, normal_score
from lscan.benchmark.suiterun import differences, run_suite
from tests.validation.regression import mutants
from tests.validation.rows import Row, row

# Sums of cases drawn from their law, as an extractor of normal errors would have them.


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


# Whether a suite notices what is done to an extractor: twenty mutations and the paired test.


CASES, COLUMNS = 500, 300  # of a suite like quick
CHANGE = 0.03


def mutation_rows(suite: str) -> list[Row]:
    """How many of the mutations a suite notices.

    Parameters
    ----------
    suite : str, its name or path
    """
    names = {name: f"{mutants.__name__}:{name}" for name in mutants.MUTANTS}
    bases = sorted(set(mutants.MUTANTS.values()))
    run = run_suite(suite, {"extractor": [*bases, *names.values()]})
    unnoticed = [
        name
        for name, base in mutants.MUTANTS.items()
        if not any(one.worse for one in differences(name, run.sums[names[name]], run.sums[base]))
    ]
    told = f"not noticed: {', '.join(unnoticed)}" if unnoticed else "all are noticed"
    count = len(names) - len(unnoticed)
    words: dict[str, Any] = {"suite": suite, "cases": len(run.axes), "all": len(names)}
    return [row("regression-mutations", count, told=told, **words)]


def paired_rows(repeats: int) -> list[Row]:
    """Power of the paired test for a change of 3 %, and how often it calls nothing a change.

    Parameters
    ----------
    repeats : int
    """
    found = alarms = 0
    for seed in range(repeats):
        rng = np.random.default_rng([16, seed])
        before, same, worse = (_sums(rng, factor) for factor in (1.0, 1.0, 1.0 + CHANGE))
        alarms += bool(differences("", same, before))
        noticed = differences("", worse, before)
        found += any(one.worse and one.figure == "rms error" for one in noticed)
    words: dict[str, Any] = {"repeats": repeats, "cases": CASES, "columns": COLUMNS}
    return [
        row("regression-power", 100 * found / repeats, seed=16, **words),
        row("regression-alarms", 100 * alarms / repeats, seed=16, **words),
    ]


def _sums(rng: np.random.Generator, factor: float) -> dict[str, CaseSums]:
    return drawn_sums(rng, CASES, COLUMNS, factor)
