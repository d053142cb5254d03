"""Both tiers of a study: which rigs are rendered, what differs, and the budget in rendered physics.

Of a cause alone, what is compared is the root of the mean square error of the same few rigs in
both tiers: their ratio hardly depends on which rigs they are where the error is in proportion to
the cause, or the same in all rigs.  It is carried over to all rigs of the geometric tier.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from lscan.errors import InputError
from lscan.records import Floats
from sim.studies.indices import Indices, moment_pseudo_values
from sim.studies.intervals import Bounded, interval, pseudo_values
from sim.studies.multifidelity import term_means
from sim.studies.problem import Output, columns
from sim.studies.records import CauseBudget, OutputBudget, TierRow
from sim.studies.sampling import AGAIN, ALL, BASE, SETS, Design, alone, mixed

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
        raise InputError(
            "too few rendered runs",
            where="precision.rendered",
            value=most,
            allowed=f"{a_sample * SETS + 1} or more",
        )
    samples = min(samples, len(design.blocks[ALL]))
    left = most - 1 - samples * a_sample
    large = large_causes(squares)[: left // FEWEST]
    counts = {BASE: 1} | dict.fromkeys((ALL, AGAIN, *map(mixed, design.groups)), samples)
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


def padded(design: Design, part: Design, values: Floats) -> Floats:
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
            compared[_alone(group)] = paired(cheap[alone(group)], dear[alone(group)])
        rows += [
            TierRow(_words(output.name, what), output.unit, *bounds)
            for what, bounds in compared.items()
            if np.isfinite(bounds[2].half_width)
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
        mean=_told(moments.mean if budget.places == 1 else _root(moments.systematic)),
        standard_uncertainty=_told(_root(moments.variance)),
        rms=_told(_root(moments.mean_square)),
        after=budget.after and in_rendered_physics(budget.after, indices, tiers),
    )


def paired(geometric: Floats, rendered: Floats) -> tuple[Bounded, Bounded, Bounded]:
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


def _told(bounded: Bounded) -> Bounded | None:
    return bounded if np.isfinite(bounded.half_width) else None


def _words(output: str, what: str) -> str:
    return f"rms of {output}, {what}"


def _alone(group: str) -> str:
    return f"{group} alone"
