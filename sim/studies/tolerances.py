"""How tight each cause must be for an output to keep a bound: the budget's question, turned round.

All spreads are multiplied by one factor: evenly stringent.  Where the study's file states costs,
the factors differ.  To hold a cause to f times its stated spread is taken to cost c / f, the
reciprocal model of Chase & Greenwood, and the output's variance to be the sum of v f² over the
causes, v their total Sobol' indices.  The least sum of c / f with the sum of v f² held has, by
Lagrange's multiplier, -c / f² + 2 lambda v f = 0 for every cause: f is as the cube root of c / v.
(With Spotts' cost, c / f², it is the fourth root.)  Costs and indices set the proportions only;
how small all of them must be is found by runs of rigs that have these spreads.

The same quasi-random rigs are run with every factor tried, so that the quantile of the output is a
continuous function of it.  What cannot be made tighter, noise and fixed causes and how far the
means are off the scene's own numbers, takes its part of the bound first.

References
----------
Spotts 1973, Journal of Engineering for Industry 95, 762: allocation by Lagrange's multiplier.
Chase & Greenwood 1988, Manufacturing Review 1, 50: reciprocal cost.
Wilson 1927, Journal of the American Statistical Association 22, 209: interval of a share.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from scipy.stats import binomtest

from lscan.errors import InputError
from lscan.records import Floats, Mask
from sim.studies.intervals import CONFIDENCE, Bounded
from sim.studies.problem import Output, columns
from sim.studies.records import Tolerance, Tolerances
from sim.studies.sampling import ALL, make_design
from sim.studies.states import SEEDED
from sim.studies.store import OK, Results
from sim.studies.studyfile import Bound, Cause, StudyFile

RIGS = 512
"""Run with each factor.  As random points they would put a yield of 95 % off by 1.0 points, as much
as the fresh rigs' own scatter; quasi-random, by 0.75, seen with a field linear in five causes."""
FRESH = 500  # rigs of the run that verifies
STEPS = 8  # factors tried at most
MOST_RUNS = (STEPS + 2) * RIGS + FRESH
CLOSE = 0.985  # of the bound: a quantile between it and the bound is near enough, half a percent
# of yield where the output is normal
FARTHEST = 10.0  # times the stated spreads: what a looser rig would do is not looked at
LEAST_SHARE = 0.01  # of the variance: a smaller index is not told apart from another one's
VERIFIED = 1  # stream of random numbers of the fresh rigs, apart from the design's

Sizes = Callable[[Mapping[str, float], Floats], Floats]
"""From the factors of causes, and (N, D) rows, to (N,) sizes of the output, as by ``sizes_of``."""


def bounded_output(bound: Bound, outputs: Sequence[Output], where: str) -> Output:
    """The output that a bound is of.

    Parameters
    ----------
    bound : Bound
    outputs : sequence of Output, those of the study
    where : str, the study's file, for errors

    Raises
    ------
    InputError
        There is none of that name whose unit is that of the bound.
    """
    lengths = {one.name: one for one in outputs if one.unit.startswith("mm")}
    if bound.output not in lengths:
        key, allowed = f"{where}, [tolerances] output", ", ".join(lengths)
        raise InputError("no such output", where=key, value=bound.output, allowed=allowed)
    return lengths[bound.output]


def sizes_of(results: Results, outputs: Sequence[Output], name: str) -> Floats:
    """(N,) how large an output is: its rms over the places of a field, its absolute value.

    Parameters
    ----------
    results : Results, of N rows; one that failed is infinite, it keeps no bound
    outputs : sequence of Output
    name : str, of the output
    """
    errors = results.values[:, columns(outputs)[name]]
    good = np.array(results.status) == OK
    return np.where(good, np.sqrt(np.mean(errors**2, axis=1)), np.inf)


def with_spreads(file: StudyFile, document: dict[str, Any], factors: Mapping[str, float]) -> Any:
    """A study's document with the distributions of causes drawn in to their middles.

    Parameters
    ----------
    file : StudyFile
    document : dict, that it was read from
    factors : mapping, name of a cause to the factor of its spread
    """
    causes = dict(document["cause"])
    for name, factor in factors.items():
        drawn = file.cause[name].distribution.scaled(factor)
        causes[name] = {**causes[name], drawn.kind: getattr(drawn, drawn.kind)}
    return {**document, "cause": causes}


def find_tolerances(
    file: StudyFile, bound: Bound, shares: Mapping[str, float], sizes: Sizes
) -> Tolerances:
    """The spreads with which an output keeps a bound, verified with rigs drawn anew.

    Parameters
    ----------
    file : StudyFile
    bound : Bound
    shares : mapping, name of a cause or group to its total index of the output; of one that is
        missing, negative or not a number the least share is taken.  They count with costs only.
    sizes : callable, that runs rigs whose causes have these factors
    """
    loose = {name: one for name, one in file.cause.items() if one.distribution.deviation > 0}
    weights = _weights(loose, shares)
    rows = make_design(tuple(file.cause), RIGS, 0, file.seed).blocks[ALL]

    def quantile(factors: Mapping[str, float]) -> float:
        # A cause without spread has one value: rows that differ in nothing else are one rig.
        still = [
            factors.get(name) == 0 and cause.key not in SEEDED for name, cause in file.cause.items()
        ]
        return _quantile(sizes(factors, np.where(still, 0.5, rows)), bound.in_share)

    floor = quantile(dict.fromkeys(loose, 0.0))
    stated = quantile(dict.fromkeys(loose, 1.0)) if loose else floor
    factors, allowed = _search(lambda f: quantile(_factors(weights, f)), weights, floor, bound)
    found = None
    if factors:
        fresh = np.random.default_rng([file.seed, VERIFIED]).random((FRESH, len(file.cause)))
        found = _share(np.asarray(sizes(factors, fresh) <= bound.most_mm))
    return Tolerances(
        output=bound.output,
        most_mm=bound.most_mm,
        in_share=bound.in_share,
        by_cost=_has_costs(loose),
        causes=tuple(
            _tolerance(name, cause, factors.get(name)) for name, cause in file.cause.items()
        ),
        floor_mm=_finite(floor),
        stated_mm=_finite(stated),
        allowed_mm=allowed,
        fresh=FRESH if found else 0,
        found=found,
        note=_note(bound, floor, factors, allowed),
    )


def _has_costs(causes: Mapping[str, Cause]) -> bool:
    return any("cost" in cause.model_fields_set for cause in causes.values())


def _weights(causes: Mapping[str, Cause], shares: Mapping[str, float]) -> dict[str, float]:
    """Each cause's factor beside the others', that of the whole variance being 1.

    Causes of one group have one index, and so one factor: what they cost is added.
    """
    if not _has_costs(causes):
        return dict.fromkeys(causes, 1.0)
    group = {name: cause.group or name for name, cause in causes.items()}
    cost = dict.fromkeys(group.values(), 0.0)
    for name, cause in causes.items():
        cost[group[name]] += cause.cost
    stated = np.array([shares.get(name, 0.0) for name in cost])
    share = np.fmax(stated, LEAST_SHARE)
    factor = np.cbrt(np.array(list(cost.values())) / share)
    factor /= np.sqrt(np.sum(share * factor**2) / np.sum(share))
    of_group = dict(zip(cost, factor.tolist(), strict=True))
    return {name: of_group[group[name]] for name in causes}


def _factors(weights: Mapping[str, float], factor: float) -> dict[str, float]:
    """The causes' factors with three digits, as a drawing states them: these are then run."""
    return {name: float(f"{factor * weight:.3g}") for name, weight in weights.items()}


def _quantile(sizes: Floats, share: float) -> float:
    """What a share of all rigs is below, of a sample: Weibull's, whose yield has no bias."""
    with np.errstate(invalid="ignore"):  # of infinite neighbours
        found = float(np.quantile(sizes, share, method="weibull"))
    return found if np.isfinite(found) else np.inf


def _search(
    quantile: Callable[[float], float], weights: Mapping[str, float], floor: float, bound: Bound
) -> tuple[dict[str, float], float | None]:
    """The causes' factors, and the quantile with them: the loosest tried that keep the bound.

    The quantile's square is nearly linear in the factor's: secants of the squares, and bisection
    where one leads out of what is known to enclose the factor.
    """
    if floor > bound.most_mm or not weights:
        return {}, None
    tried = [(0.0, floor)]
    factor = 1.0
    while len(tried) <= STEPS and factor not in dict(tried):
        tried.append((factor, quantile(factor)))
        if CLOSE * bound.most_mm <= tried[-1][1] <= bound.most_mm:
            break
        factor = _next(tried, bound.most_mm)
    kept = max(one for one in tried if one[1] <= bound.most_mm)
    return (_factors(weights, kept[0]), kept[1]) if kept[0] > 0 else ({}, None)


def _next(tried: list[tuple[float, float]], most: float) -> float:
    low = max(factor for factor, size in tried if size <= most)
    high = min((factor for factor, size in tried if size > most), default=FARTHEST)
    (x, y), (further, larger) = np.square(tried[-2:])
    aim = (most * (1 + CLOSE) / 2) ** 2
    with np.errstate(all="ignore"):
        square = further + (aim - larger) * (further - x) / (larger - y)
    if np.isfinite(square) and low**2 < square < high**2:
        return float(np.sqrt(square))
    if high == FARTHEST and low < FARTHEST:
        return FARTHEST
    return float(np.sqrt(low * high)) if low > 0 else high / 4


def _share(kept: Mask) -> Bounded:
    """The share of rigs that kept the bound, with Wilson's interval."""
    test = binomtest(int(kept.sum()), len(kept))
    interval = test.proportion_ci(CONFIDENCE, method="wilson")
    return Bounded(float(kept.mean()), float(interval.low), float(interval.high))


def _tolerance(name: str, cause: Cause, factor: float | None) -> Tolerance:
    if factor is None:
        return Tolerance(name, cause.in_words, None, None)
    drawn = cause.distribution.scaled(factor)
    scaled = cause.model_copy(update={drawn.kind: getattr(drawn, drawn.kind)})
    return Tolerance(name, cause.in_words, scaled.in_words, factor)


def _note(bound: Bound, floor: float, factors: Mapping[str, float], allowed: float | None) -> str:
    """What a reader has to know, in one line; "" where the tolerances say it all."""
    if floor > bound.most_mm:
        return (
            f"No tolerances keep {bound.output} within {bound.most_mm:g} mm in "
            f"{bound.in_share:.4g} of all rigs: what cannot be made tighter alone makes {floor:.3g}"
        )
    if not factors:
        return f"No tolerances were found that keep {bound.output} within {bound.most_mm:g} mm."
    if allowed is not None and allowed < CLOSE * bound.most_mm:
        return (
            f"The bound is kept with room to spare, {allowed:.3g} mm; spreads beyond "
            f"{FARTHEST:g} times the stated ones were not looked at."
        )
    return ""


def _finite(size: float) -> float | None:
    return size if np.isfinite(size) else None
