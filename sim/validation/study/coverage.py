"""How often the intervals of Sobol' indices hold the closed forms."""

from dataclasses import dataclass

import numpy as np

from lscan.records import Mask
from sim.studies.indices import sobol_indices
from sim.studies.intervals import Bounded
from sim.studies.sampling import make_design
from sim.studies.testfunctions import ClosedForm, ishigami, sobol_g
from sim.validation.accuracy.intervals import band_miss_percent
from sim.validation.rows import Row, row

BASE, REPEATS = 1024, 200


@dataclass(frozen=True)
class Coverage:
    """Which intervals of repeated studies hold the truth.

    Attributes
    ----------
    first, total : (repeats, D) masks, of each cause's indices
    moments : (repeats, 2) mask, of mean and variance
    """

    first: Mask
    total: Mask
    moments: Mask


def coverage_rows(seed: int = 0, base: int = BASE, repeats: int = REPEATS) -> list[Row]:
    """Of each test function and kind of index: how far the share of intervals that hold is off.

    Parameters
    ----------
    seed : int, the first of as many as there are repeats
    base : int, base samples of a study
    repeats : int, studies
    """
    rows = []
    for problem in (ishigami(), sobol_g()):
        held = coverage(problem, base, range(seed, seed + repeats))
        for kind, inside in (("first-order", held.first), ("total", held.total)):
            figure = band_miss_percent(float(inside.mean()))
            words = {"function": problem.name, "kind": kind, "percent": 100 * inside.mean()}
            rows.append(
                row("index-coverage", figure, seed=seed, repeats=repeats, base=base, **words)
            )
    return rows


def coverage(problem: ClosedForm, base: int, seeds: range) -> Coverage:
    """Which intervals hold, study by study.

    Parameters
    ----------
    problem : ClosedForm
    base : int, base samples of a study
    seeds : range, one for each study
    """
    first, total, moments = [], [], []
    for seed in seeds:
        design = make_design(problem.causes, base, 0, seed)
        values = problem.evaluate(design.rows)
        (found,) = sobol_indices(design, values, problem.outputs).values()
        first.append([_holds(found.groups[c].first, problem.first[c]) for c in problem.causes])
        total.append([_holds(found.groups[c].total, problem.total[c]) for c in problem.causes])
        of = found.moments
        moments.append([_holds(of.mean, problem.mean), _holds(of.variance, problem.variance)])
    return Coverage(np.array(first), np.array(total), np.array(moments))


def _holds(found: Bounded, truth: float) -> bool:
    return found.low <= truth <= found.high
