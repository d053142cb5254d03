"""Both tiers of a study: which rigs are rendered, what differs, and the budget in rendered physics.

Of a cause alone, what is compared is the root of the mean square error of the same few rigs in
both tiers: their ratio hardly depends on which rigs they are where the error is in proportion to
the cause, or the same in all rigs.  It is carried over to all rigs of the geometric tier.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.stats import binomtest

from lscan.errors import InputError
from lscan.records import Floats
from sim.studies.budget import CauseBudget, OutputBudget, TierRow, Tolerance, Tolerances
from sim.studies.problem import (
    AGAIN,
    ALL,
    BASE,
    CONFIDENCE,
    SETS,
    Bounded,
    Design,
    Indices,
    Output,
    alone,
    columns,
    interval,
    make_design,
    mixed_block,
    moment_pseudo_values,
    pseudo_values,
    term_means,
)
from sim.studies.results import OK, Results
from sim.studies.rig.states import SEEDED
from sim.studies.studyfile import Bound, Cause, StudyFile

LARGE = 0.02  # share of the mean square from which on a cause is compared by itself
FEWEST = 4  # rigs of a cause alone: of fewer, Student's t is above four


def rendered_design(design: Design, squares: Mapping[str, float], most: int) -> Design:
    """The rows of a design that are rendered: the beginnings of its blocks.

    As many base samples as there is room for, which the indices need, and with what is left the
    largest causes alone.

    Parameters
    ----------
    design : Design
    squares : mapping, of each group its ``alone_squares``
    most : int, rows

    Raises
    ------
    InputError
        They do not suffice for one sample of each set.
    """
    a_sample = len(design.groups) + 2
    samples = (most - 1) // (a_sample * SETS) * SETS
    if samples == 0:
        what, allowed = "too few rendered runs", f"{a_sample * SETS + 1} or more"
        raise InputError(what, where="precision.rendered", value=most, allowed=allowed)
    samples = min(samples, len(design.blocks[ALL]))
    left = most - 1 - samples * a_sample
    large = large_causes(squares)[: left // FEWEST]
    counts = {BASE: 1} | dict.fromkeys((ALL, AGAIN, *map(mixed_block, design.groups)), samples)
    counts |= {alone(group): left // len(large) for group in large}
    return beginnings(design, counts)


def beginnings(design: Design, counts: Mapping[str, int]) -> Design:
    """The first rows of some blocks of a design.

    Parameters
    ----------
    design : Design
    counts : mapping, of a block, how many rows; none of the others
    """
    blocks = {name: rows[: counts.get(name, 0)] for name, rows in design.blocks.items()}
    return Design(blocks, design.groups)


def pad_rows(design: Design, part: Design, values: Floats) -> Floats:
    """(R, K) results of a part of a design in the place of its rows, NaN elsewhere.

    Parameters
    ----------
    design : Design, of R rows
    part : Design, whose blocks are beginnings of the other's
    values : (r, K) array, of the part's rows
    """
    whole = {name: np.full((len(rows), values.shape[1]), np.nan)
             for name, rows in design.blocks.items()}  # fmt: skip
    for name, found in part.split(values).items():
        whole[name][: len(found)] = found
    return np.concatenate(list(whole.values()))


def alone_squares(design: Design, values: Floats) -> dict[str, float]:
    """Of each group the mean square of what it adds, alone at work, to the error without causes.

    Parameters
    ----------
    design : Design
    values : (R, P) array, results of its rows of one output, NaN where a run failed
    """
    blocks = design.split(values)
    added = {group: (blocks[alone(group)] - blocks[BASE]) ** 2 for group in design.groups}
    known = {group: off[np.isfinite(off).all(axis=1)] for group, off in added.items()}
    return {group: float(off.mean()) for group, off in known.items() if len(off)}


def large_causes(squares: Mapping[str, float]) -> list[str]:
    """The groups that make LARGE of the sum or more, the largest first.

    Parameters
    ----------
    squares : mapping, of each group its ``alone_squares``
    """
    least = max(LARGE * sum(squares.values()), np.finfo(float).tiny)
    return sorted((g for g in squares if squares[g] >= least), key=lambda group: -squares[group])


def tier_rows(
    design: Design, geometric: Floats, rendered: Floats, outputs: Sequence[Output]
) -> tuple[TierRow, ...]:
    """Of each output its rms in both tiers: all causes at work, none, and each large one alone.

    Parameters
    ----------
    design : Design
    geometric, rendered : (R, K) arrays, results of its rows, NaN where there are none
    outputs : sequence of Output, whose sizes sum up to K
    """
    rows = []
    for output in outputs:
        where = columns(outputs)[output.name]
        cheap, dear = (design.split(tier[:, where]) for tier in (geometric, rendered))
        compared = {"all causes": _all(cheap, dear), "no cause": _base(cheap[BASE], dear[BASE])}
        for group in large_causes(alone_squares(design, geometric[:, where])):
            compared[_alone(group)] = paired_bounds(cheap[alone(group)], dear[alone(group)])
        rows += [
            TierRow(_words(output.name, what), output.unit, *bounds)
            for what, bounds in compared.items()
            if bounds[2].known
        ]
    return tuple(rows)


def in_rendered_physics(
    budget: OutputBudget, indices: Mapping[str, Indices], tiers: Sequence[TierRow]
) -> OutputBudget:
    """A budget of geometric runs with the moments, and what is compared, of the rendered tier.

    Parameters
    ----------
    budget : OutputBudget, with the indices already
    indices : mapping, of each output's name, in rendered physics
    tiers : sequence of TierRow
    """
    rendered = {row.what: row.rendered for row in tiers}
    moments = indices[budget.name].moments
    base = rendered.get(_words(budget.name, "no cause"))

    def cause(one: CauseBudget) -> CauseBudget:
        found = rendered.get(_words(budget.name, _alone(one.cause)), one.alone_rms)
        return replace(one, alone_rms=found)

    return replace(
        budget,
        causes=tuple(map(cause, budget.causes)),
        base_rms=base.value if base else None,
        mean=(moments.mean if budget.places == 1 else _root(moments.systematic)).known,
        standard_uncertainty=_root(moments.variance).known,
        rms=_root(moments.mean_square).known,
        after=budget.after and in_rendered_physics(budget.after, indices, tiers),
    )


def paired_bounds(geometric: Floats, rendered: Floats) -> tuple[Bounded, Bounded, Bounded]:
    """Rms over rigs and places in the geometric tier, in the rendered one, and their difference.

    Parameters
    ----------
    geometric, rendered : (N, P) arrays, errors of the same rigs, NaN where there are none
    """
    squares, others = ((tier**2).mean(axis=1) for tier in (geometric, rendered))
    both = np.isfinite(squares) & np.isfinite(others)
    means = term_means(squares[:, None])
    cheap = interval(means.pseudo_values(lambda of: np.sqrt(of[..., 0])), True)
    # Each rig is a set of its own.
    sums = np.column_stack([np.ones(both.sum()), squares[both], others[both]])
    ratio = pseudo_values(sums, lambda of: np.sqrt(of[..., 2] / of[..., 1]) - 1)
    share = interval(ratio)
    off = Bounded(*(cheap.value * x for x in (share.value, share.low, share.high)))
    value, reach = cheap.value + off.value, float(np.hypot(cheap.half_width, off.half_width))
    return cheap, Bounded(value, value - reach, value + reach), off


def _all(
    geometric: Mapping[str, Floats], rendered: Mapping[str, Floats]
) -> tuple[Bounded, Bounded, Bounded]:
    cheap, dear = (np.concatenate([tier[ALL], tier[AGAIN]]) for tier in (geometric, rendered))
    one, other = moment_pseudo_values(cheap)["rms"], moment_pseudo_values(cheap, dear)["rms"]
    return interval(one, True), interval(other, True), interval(other - one)


def _base(geometric: Floats, rendered: Floats) -> tuple[Bounded, Bounded, Bounded]:
    """Of one rig, in which nothing is random."""
    cheap, dear = (float(np.sqrt(np.mean(tier**2))) for tier in (geometric, rendered))
    cheap_, dear_, off = (Bounded(x, x, x) for x in (cheap, dear, dear - cheap))
    return cheap_, dear_, off


def _root(square: Bounded) -> Bounded:
    ends = (square.value, square.low, square.high)
    return Bounded(*(float(np.sqrt(max(end, 0.0))) for end in ends))


def _words(output: str, what: str) -> str:
    return f"rms of {output}, {what}"


def _alone(group: str) -> str:
    return f"{group} alone"


# How tight each cause must be for an output to keep a bound: the budget's question, turned round.
#
# All spreads are multiplied by one factor: evenly stringent.  Where the study's file states costs,
# the factors differ.  To hold a cause to f times its stated spread is taken to cost c / f, the
# reciprocal model of Chase & Greenwood, and the output's variance to be the sum of v f² over the
# causes, v their total Sobol' indices.  The least sum of c / f with the sum of v f² held has, by
# Lagrange's multiplier, -c / f² + 2 lambda v f = 0 for every cause: f is as the cube root of c / v.
# (With Spotts' cost, c / f², it is the fourth root.)  Costs and indices set the proportions only;
# how small all of them must be is found by runs of rigs that have these spreads.
#
# The same quasi-random rigs are run with every factor tried, so that the quantile of the output is
# a continuous function of it.  What cannot be made tighter, noise and fixed causes and how far the
# means are off the scene's own numbers, takes its part of the bound first.
#
# References ---------- Spotts 1973, Journal of Engineering for Industry 95, 762: allocation by
# Lagrange's multiplier. Chase & Greenwood 1988, Manufacturing Review 1, 50: reciprocal cost. Wilson
# 1927, Journal of the American Statistical Association 22, 209: interval of a share.


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
        drawn = file.cause[name].scaled(factor)
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
    loose = {name: one for name, one in file.cause.items() if one.deviation > 0}
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
        kept = int(np.sum(sizes(factors, fresh) <= bound.most_mm))
        wilson = binomtest(kept, FRESH).proportion_ci(CONFIDENCE, method="wilson")
        found = Bounded(kept / FRESH, float(wilson.low), float(wilson.high))
    return Tolerances(
        output=bound.output,
        most_mm=bound.most_mm,
        in_share=bound.in_share,
        by_cost=_has_costs(loose),
        causes=tuple(
            Tolerance(
                name,
                cause.in_words,
                cause.scaled(factors[name]).in_words if name in factors else None,
                factors.get(name),
            )
            for name, cause in file.cause.items()
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
