"""How often the intervals of Sobol' indices hold the closed forms."""

from dataclasses import dataclass

import numpy as np

from lscan.records import Mask
from sim.studies.indices import Bounded, sobol_indices
from sim.studies.problem import AGAIN, ALL, SETS, make_design, mixed
from sim.studies.testfunctions import ClosedForm, ishigami, nearly_linear, sobol_g
from sim.studies.tiers import beginnings, padded
from tests.validation.exposures import band_miss_percent
from tests.validation.rows import Row, row

BASE, REPEATS = 1024, 200
SLOPES = (3.0, 2.0, 1.5, 1.0, 0.8, 0.6, 0.5, 0.4, 0.3, 0.2, 0.1, 0.05)  # of twelve causes
OFF = tuple(np.linspace(0.9, 1.1, len(SLOPES)))  # the rendered tier's over the geometric one's


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
    seeds = range(seed, seed + repeats)
    for key, problem, cheap in (
        *(("index-coverage", problem, None) for problem in (ishigami(), sobol_g())),
        *(("two-tier-coverage", dear, cheap) for cheap, dear in two_tier_pairs()),
    ):
        held = coverage(problem, base, seeds, cheap)
        for kind, inside in (("first-order", held.first), ("total", held.total)):
            figure = band_miss_percent(float(inside.mean()))
            words = {"function": problem.name, "kind": kind, "percent": 100 * inside.mean()}
            rows.append(row(key, figure, seed=seed, repeats=repeats, base=base, **words))
    return rows


def two_tier_pairs() -> list[tuple[ClosedForm, ClosedForm]]:
    """A cheap problem and a dear one that is like it: other slopes, curved, and off."""
    slopes = tuple(slope * off for slope, off in zip(SLOPES, OFF, strict=True))
    return [
        (ishigami(), ishigami(7.5, 0.11)),
        (nearly_linear(SLOPES), nearly_linear(slopes, 0.15, 0.3)),
    ]


def coverage(
    problem: ClosedForm, base: int, seeds: range, cheap: ClosedForm | None = None
) -> Coverage:
    """Which intervals hold, study by study.

    Parameters
    ----------
    problem : ClosedForm
    base : int, base samples of a study
    seeds : range, one for each study
    cheap : ClosedForm, optional, that is evaluated in its place but for SETS base samples
    """
    first, total, moments = [], [], []
    for seed in seeds:
        design = make_design(problem.causes, base, 0, seed)
        values, dear = (cheap or problem).evaluate(design.rows), None
        if cheap is not None:
            blocks = (ALL, AGAIN, *map(mixed, design.groups))
            part = beginnings(design, dict.fromkeys(blocks, SETS))
            dear = padded(design, part, problem.evaluate(part.rows))
        (found,) = sobol_indices(design, values, problem.outputs, dear).values()
        first.append([_holds(found.groups[c].first, problem.first[c]) for c in problem.causes])
        total.append([_holds(found.groups[c].total, problem.total[c]) for c in problem.causes])
        of = found.moments
        moments.append([_holds(of.mean, problem.mean), _holds(of.variance, problem.variance)])
    return Coverage(np.array(first), np.array(total), np.array(moments))


def _holds(found: Bounded, truth: float) -> bool:
    return found.low <= truth <= found.high
