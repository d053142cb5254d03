"""Sobol' indices of each output and group of causes, and the moments of its error.

With a and b two independent draws of all causes, c as a but for one group's causes as in b, all
less the mean, the first-order index is E[bc] / V and the total one E[(a - c)^2] / 2V (Jansen 1999).
V is the mean of both squares in the pair (Janon et al. 2014), so that an index near one has little
scatter.  E[ab] is zero, whatever the causes do: the sample's is subtracted with the weight that
correlation gives (a control variate).  Where the group does little, c is a, the weight is one, and
what is left is Saltelli's E[b(c - a)] (2010) with the small scatter that it has there.

Of a field, products are summed over the places before the ratio is taken (Lamboni et al. 2011,
Gamboa et al. 2014).

A base sample counts for a group where its three runs have not failed.  To leave it out of all
groups where any of its runs failed would, of 12 causes and 5 % of runs, leave out half.

References
----------
Jansen 1999, Computer Physics Communications 117.
Janon, Klein, Lagnoux, Nodet & Prieur 2014, ESAIM: Probability and Statistics 18.
Saltelli, Annoni, Azzini, Campolongo, Ratto & Tarantola 2010, Computer Physics Communications 181.
Lamboni, Monod & Makowski 2011, Reliability Engineering and System Safety 96.
Gamboa, Janon, Klein & Lagnoux 2014, Electronic Journal of Statistics 8.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lscan.records import Floats, Mask
from sim.studies.intervals import Bounded, interval, pseudo_values, set_sums
from sim.studies.problem import Output, columns
from sim.studies.sampling import AGAIN, ALL, SETS, Design, alone, mixed

MOST_FAILED = 0.05
"""Share of failed runs beyond which a note says so: the 5 % of errors that a 95 % range leaves out
could then all be those of rigs that nobody could measure."""

ROUNDS = 2
"""Of finding a weight and the ratio from one another: each takes 1 / sqrt(N) of what is left."""


@dataclass(frozen=True)
class Moments:
    """Moments of an error over rigs, of a field's also over its places.

    mean_square is systematic + variance.

    Attributes
    ----------
    mean : Bounded, in the output's unit
    systematic : Bounded, the mean error over rigs squared, mean over places, unit squared
    variance : Bounded, of rigs about that, mean over places, unit squared
    mean_square : Bounded, unit squared
    """

    mean: Bounded
    systematic: Bounded
    variance: Bounded
    mean_square: Bounded


@dataclass(frozen=True)
class GroupIndices:
    """Sobol' indices of a group.  used: the base samples that they come from."""

    first: Bounded
    total: Bounded
    used: int


@dataclass(frozen=True)
class Indices:
    """Where the variance of an output comes from.

    Attributes
    ----------
    groups : mapping, name of a group to its indices
    rest : Bounded, 1 less all first-order indices: what interaction leaves
    moments : Moments, with all causes at work
    base : int, base samples
    failed : int, runs without a value
    note : str, what a reader has to know, "" where nothing
    """

    groups: Mapping[str, GroupIndices]
    rest: Bounded
    moments: Moments
    base: int
    failed: int
    note: str = ""


def sobol_indices(design: Design, values: Floats, outputs: Sequence[Output]) -> dict[str, Indices]:
    """The indices of each output, by its name.

    Parameters
    ----------
    design : Design
    values : (R, K) array, results of its rows, NaN where a run failed
    outputs : sequence of Output, whose sizes sum up to K
    """
    return {
        name: _output_indices(design, design.split(values[:, where]))
        for name, where in columns(outputs).items()
    }


def alone_moments(
    design: Design, values: Floats, outputs: Sequence[Output]
) -> dict[str, dict[str, Moments]]:
    """The moments of each output, by its name, with each group alone at work.

    Parameters
    ----------
    design : Design
    values : (R, K) array, results of its rows, NaN where a run failed
    outputs : sequence of Output, whose sizes sum up to K
    """
    found = {}
    for name, where in columns(outputs).items():
        blocks = design.split(values[:, where])
        found[name] = {group: moments(blocks[alone(group)]) for group in design.groups}
    return found


def moments(errors: Floats) -> Moments:
    """Moments of errors with their intervals.

    Parameters
    ----------
    errors : (N, P) array, of rigs in the order of a design's blocks, at P places; NaN where failed
    """
    kept, places = _intact(errors), errors.shape[1]
    errors = np.where(kept[:, None], errors, 0.0)
    sums = set_sums(np.column_stack([kept, (errors**2).sum(axis=1), errors]))

    def systematic(of: Floats) -> Floats:
        return np.mean((of[..., 2:] / of[..., :1]) ** 2, axis=-1)

    def mean_square(of: Floats) -> Floats:
        return of[..., 1] / of[..., 0] / places

    return Moments(
        mean=interval(pseudo_values(sums, lambda of: of[..., 2:].mean(axis=-1) / of[..., 0])),
        systematic=interval(pseudo_values(sums, systematic)),
        variance=interval(
            pseudo_values(sums, lambda of: mean_square(of) - systematic(of)), positive=True
        ),
        mean_square=interval(pseudo_values(sums, mean_square), positive=True),
    )


def next_base(indices: Iterable[Indices], wanted_half_width: float, base: int) -> int | None:
    """To which base the design must grow for the half-widths wanted; None where they are reached.

    Those of the three groups with the largest total indices of each output count, of both
    indices.  They fall as 1 / sqrt(base), or faster.  It grows to SETS times a power of two, and
    about fourfold at most: what a small base says of its own intervals is uncertain.

    Parameters
    ----------
    indices : iterable of Indices, of the outputs that count
    wanted_half_width : float
    base : int, of the design that they come from
    """
    widest = 0.0
    for output in indices:
        told = [group for group in output.groups.values() if np.isfinite(group.total.value)]
        for group in sorted(told, key=lambda group: -group.total.value)[:3]:
            widest = max(widest, group.first.half_width, group.total.half_width)
    if widest <= wanted_half_width:
        return None
    grown = SETS
    while grown <= base or grown < min(base * (widest / wanted_half_width) ** 2, 4 * base):
        grown *= 2
    return grown


def _output_indices(design: Design, blocks: Mapping[str, Floats]) -> Indices:
    first, again = blocks[ALL], blocks[AGAIN]
    sobol = [first, again, *(blocks[mixed(group)] for group in design.groups)]
    failed = sum(int(np.sum(~_intact(block))) for block in sobol)
    both = np.concatenate([first, again])
    either = both[_intact(both)]
    # Less one of them first: what does not vary is then exactly zero.
    centre = either[:1] + (either - either[:1]).mean(axis=0) if len(either) else np.nan
    a, b = first - centre, again - centre
    groups, firsts = {}, []
    for group in design.groups:
        c = blocks[mixed(group)] - centre
        kept = _intact(np.hstack([a, b, c]))
        free = _dot(a, b)
        pseudo = _ratio(kept, _dot(b, c), (_dot(b, b) + _dot(c, c)) / 2, free, 1.0)
        firsts.append(pseudo)
        total = _ratio(kept, _dot(a - c, a - c) / 2, (_dot(a, a) + _dot(c, c)) / 2, free, 0.0)
        groups[group] = GroupIndices(interval(pseudo), interval(total, True), int(kept.sum()))
    runs = sum(map(len, sobol))
    return Indices(
        groups=groups,
        rest=interval(1 - np.sum(firsts, axis=0)),
        moments=moments(both),
        base=len(first),
        failed=failed,
        note=_note(failed, runs, len(either) > 0 and bool((either == either[:1]).all())),
    )


def _ratio(kept: Mask, above: Floats, beneath: Floats, free: Floats, start: float) -> Floats:
    """(SETS,) pseudo-values of the ratio of two means, ``free`` being known to have the mean 0.

    All of (N,) samples.  The best weight of ``free`` is the slope of the ratio's residual on it
    (Glasserman 2003, Monte Carlo Methods in Financial Engineering, 4.1), found from ``start``.
    """
    above, beneath, free = (np.where(kept, x, 0.0) for x in (above, beneath, free))
    samples = [kept, above, beneath, free, above * free, beneath * free, free**2]

    def figure(sums: Floats) -> Floats:
        top, low, zero, top_zero, low_zero, square = np.moveaxis(
            sums[..., 1:] / sums[..., :1], -1, 0
        )
        spread = square - zero**2
        weight: Floats = np.asarray(start)
        for _ in range(ROUNDS):
            ratio = (top - weight * zero) / low
            slope = top_zero - ratio * low_zero - (top - ratio * low) * zero
            weight = np.where(spread > 0, slope / np.where(spread > 0, spread, 1.0), 0.0)
        return (top - weight * zero) / low

    return pseudo_values(set_sums(np.column_stack(samples)), figure)


def _dot(x: Floats, y: Floats) -> Floats:
    """(N,) sums of products over the places."""
    return np.einsum("np,np->n", x, y)


def _intact(errors: Floats) -> Mask:
    """Which runs have a value at all P places, of (..., P)."""
    return np.asarray(np.isfinite(errors).all(axis=-1))


def _note(failed: int, runs: int, constant: bool) -> str:
    if failed == runs:
        return "every run failed"
    if constant:
        return "does not vary: there are no indices"
    if failed > MOST_FAILED * runs:
        return f"{failed} of {runs} runs failed: this speaks for the rigs that could be measured"
    return ""
