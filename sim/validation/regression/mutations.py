"""Whether a suite notices what is done to an extractor: twenty mutations and the paired test."""

from typing import Any

import numpy as np

from lscan.benchmark.judging import CaseSums, JudgedExtractor
from lscan.benchmark.suiterun import Difference, differences, run_suite
from sim.validation.regression import mutants
from sim.validation.regression.drawnsums import drawn_sums
from sim.validation.rows import Row, row

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
    run = run_suite(suite, [*bases, *names.values()])
    judged = {one.extractor: one for one in run.judged}
    unnoticed = [
        name
        for name, base in mutants.MUTANTS.items()
        if not any(one.worse for one in _changes(judged[names[name]], judged[base]))
    ]
    told = f"not noticed: {', '.join(unnoticed)}" if unnoticed else "all are noticed"
    count = len(names) - len(unnoticed)
    words: dict[str, Any] = {"suite": suite, "cases": len(run.axes), "all": len(names)}
    return [row("regression-mutations", count, told=told, **words)]


def _changes(now: JudgedExtractor, before: JudgedExtractor) -> list[Difference]:
    return differences(now.extractor, now.sums, before.sums)


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
