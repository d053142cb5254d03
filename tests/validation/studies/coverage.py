"""Functions whose Sobol' indices are known, and how often the intervals of a study hold these."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from lscan.records import Floats, Mask
from sim.studies.problem import (
    AGAIN,
    ALL,
    SETS,
    Bounded,
    Output,
    make_design,
    mixed_block,
    sobol_indices,
)
from sim.studies.tiers import beginnings, pad_rows
from tests.validation.exposures import band_miss_percent
from tests.validation.rows import Row, row

# Functions whose Sobol' indices are known in closed form, as problems of a study.


@dataclass(frozen=True)
class ClosedForm:
    """A problem of one output with its true indices; it follows ``StudyProblem``.

    Attributes
    ----------
    name : str
    function : callable, from (..., D) numbers in [0, 1) to the error, (...)
    mean, variance : float
    first, total : mapping, name of a cause to its index
    """

    name: str
    function: Callable[[Floats], Floats]
    mean: float
    variance: float
    first: Mapping[str, float]
    total: Mapping[str, float]

    @property
    def causes(self) -> tuple[str, ...]:
        """The names of D causes."""
        return tuple(self.first)

    @property
    def outputs(self) -> tuple[Output, ...]:
        """One scalar."""
        return (Output("error", ""),)

    def evaluate(self, row: Floats) -> Floats:
        """(..., 1) errors.

        Parameters
        ----------
        row : (..., D) array; a NOMINAL number is the median, 0.5
        """
        return self.function(np.where(np.isnan(row), 0.5, row))[..., None]


def ishigami(a: float = 7.0, b: float = 0.1) -> ClosedForm:
    """sin x1 + a sin² x2 + b x3⁴ sin x1, x uniform from -pi to pi.

    Its x3 has no effect of its own, only with x1.

    Parameters
    ----------
    a, b : float

    References
    ----------
    Ishigami & Homma 1990, Proc. ISUMA'90, 398; the indices as in Saltelli et al. 2008, Global
    Sensitivity Analysis: The Primer.
    """

    def function(u: Floats) -> Floats:
        x1, x2, x3 = np.moveaxis(np.pi * (2 * u - 1), -1, 0)
        return np.asarray(np.sin(x1) * (1 + b * x3**4) + a * np.sin(x2) ** 2)

    one, two = (1 + b * np.pi**4 / 5) ** 2 / 2, a**2 / 8
    both = b**2 * np.pi**8 * (1 / 18 - 1 / 50)
    variance = one + two + both
    return ClosedForm(
        "Ishigami",
        function,
        mean=a / 2,
        variance=variance,
        first={"x1": one / variance, "x2": two / variance, "x3": 0.0},
        total={"x1": (one + both) / variance, "x2": two / variance, "x3": both / variance},
    )


def sobol_g(a: tuple[float, ...] = (0.0, 0.5, 3.0, 9.0, 99.0, 99.0)) -> ClosedForm:
    """The product of (|4 x - 2| + a) / (1 + a), x uniform from 0 to 1: the larger a, the less.

    Parameters
    ----------
    a : tuple of float, one for each cause

    References
    ----------
    Saltelli & Sobol' 1995, Reliability Engineering and System Safety 50, 225.
    """
    weights = np.array(a)
    own = 1 / 3 / (1 + weights) ** 2
    variance = float(np.prod(1 + own)) - 1

    def function(u: Floats) -> Floats:
        return np.asarray(np.prod((np.abs(4 * u - 2) + weights) / (1 + weights), axis=-1))

    return ClosedForm(
        "Sobol' G",
        function,
        mean=1.0,
        variance=variance,
        first={f"x{k + 1}": float(v / variance) for k, v in enumerate(own)},
        total={
            f"x{k + 1}": float(v / (1 + v) * (1 + variance) / variance) for k, v in enumerate(own)
        },
    )


def nearly_linear(slopes: tuple[float, ...], curvature: float = 0.0, at: float = 0.0) -> ClosedForm:
    """at + the sum of slope times z + curvature (z1² - 1), z normal: a rig of small causes.

    Parameters
    ----------
    slopes : tuple of float, one for each cause
    curvature, at : float
    """
    weights = np.array(slopes)
    own = weights**2
    own[0] += 2 * curvature**2

    def function(u: Floats) -> Floats:
        z = ndtri(u)
        return np.asarray(at + z @ weights + curvature * (z[..., 0] ** 2 - 1))

    shares = {f"x{k + 1}": float(share) for k, share in enumerate(own / own.sum())}
    return ClosedForm("nearly linear", function, at, float(own.sum()), shares, shares)


# How often the intervals hold them.


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
            blocks = (ALL, AGAIN, *map(mixed_block, design.groups))
            part = beginnings(design, dict.fromkeys(blocks, SETS))
            dear = pad_rows(design, part, problem.evaluate(part.rows))
        (found,) = sobol_indices(design, values, problem.outputs, dear).values()
        first.append([_holds(found.groups[c].first, problem.first[c]) for c in problem.causes])
        total.append([_holds(found.groups[c].total, problem.total[c]) for c in problem.causes])
        of = found.moments
        moments.append([_holds(of.mean, problem.mean), _holds(of.variance, problem.variance)])
    return Coverage(np.array(first), np.array(total), np.array(moments))


def _holds(found: Bounded, truth: float) -> bool:
    return found.low <= truth <= found.high
