"""Pairs of rigs whose errors are known: how often the intervals of their comparison hold these."""

import numpy as np

from lscan.records import Floats
from sim.studies.comparison import INTERACTION, SAME, RigRuns, compare_rigs
from sim.studies.problem import Bounded, make_design
from tests.validation.rows import Row, row
from tests.validation.studies.coverage import ClosedForm, ishigami, nearly_linear, sobol_g

PAIRS, BASE, REPEATS = 20, 256, 40
SLOPES = (3.0, 2.0, 1.0, 0.5, 0.2)
MIDDLE = 94.0  # per cent, of the band that is asked for


def comparison_rows(seed: int = 0, base: int = BASE, repeats: int = REPEATS) -> list[Row]:
    """How far the share of intervals that hold is off the middle of 90 to 98 %, and their width.

    Parameters
    ----------
    seed : int, the first of as many as there are repeats
    base : int, base samples of a study
    repeats : int, studies of each pair
    """
    held: dict[str, list[bool]] = {"ratio": [], "part": []}
    narrower = []
    for this, other in known_pairs():
        for drawn in range(seed, seed + repeats):
            design = make_design(this.causes, base, 0, drawn)
            first, second = (
                RigRuns(one.outputs, one.evaluate(design.rows)) for one in (this, other)
            )
            (found,) = compare_rigs(design, first, second, {}).outputs
            held["ratio"].append(_holds(found.ratio, rms(other) / rms(this)))
            before, after = parts(this), parts(other)
            held["part"] += [
                _holds(one.difference, after[one.part] - before[one.part]) for one in found.parts
            ]
            narrower.append(found.narrower or np.inf)
    words = {"pairs": PAIRS, "repeats": repeats, "base": base}
    # As of independent studies, in each of which the parts hold or miss together.
    sigma = float(100 * np.sqrt(0.95 * 0.05 / (PAIRS * repeats)))
    rows = [
        row(f"comparison-{kind}", abs(percent - MIDDLE), seed=seed, sigma=sigma, percent=percent,
            **words)
        for kind, percent in ((kind, 100 * float(np.mean(of))) for kind, of in held.items())
    ]  # fmt: skip
    return [*rows, row("comparison-narrower", float(np.median(narrower)), seed=seed, **words)]


def known_pairs(seed: int = 0) -> list[tuple[ClosedForm, ClosedForm]]:
    """PAIRS of problems and others like them: other slopes and mean errors, curved, not linear.

    Parameters
    ----------
    seed : int, of what they differ in
    """
    rng = np.random.default_rng(seed)

    def linear(slopes: Floats) -> ClosedForm:
        return nearly_linear(tuple(slopes.tolist()), 0.3 * rng.random(), rng.normal())

    slopes = np.array(SLOPES)
    pairs = [(linear(slopes), linear(slopes * rng.uniform(0.2, 1.5, 5))) for _ in range(PAIRS - 3)]
    # As large, of other causes.
    pairs.append((nearly_linear(SLOPES), nearly_linear(SLOPES[::-1])))
    pairs.append((ishigami(), ishigami(6.0, 0.12)))
    return [*pairs, (sobol_g((0.0, 0.5, 3.0, 9.0)), sobol_g((0.5, 0.5, 3.0, 9.0)))]


def rms(problem: ClosedForm) -> float:
    """The root of the mean square of its error.

    Parameters
    ----------
    problem : ClosedForm
    """
    return float(np.sqrt(problem.mean**2 + problem.variance))


def parts(problem: ClosedForm) -> dict[str, float]:
    """What the mean square of its error is the sum of, as ``mean_square_parts`` names them.

    Parameters
    ----------
    problem : ClosedForm
    """
    first = {cause: index * problem.variance for cause, index in problem.first.items()}
    return {SAME: problem.mean**2, **first, INTERACTION: problem.variance - sum(first.values())}


def _holds(found: Bounded | None, truth: float) -> bool:
    rounding = 1e-12
    return found is not None and found.low - rounding <= truth <= found.high + rounding
