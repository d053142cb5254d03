"""The budget of a study's runs: rms, mean and scatter of each output, and each cause's part in it.

A field is taken as Lamboni, Monod & Makowski (2011, Reliab. Eng. Syst. Saf. 96, 450) take many
outputs: squares are summed over its places before any root or ratio.  Intervals are the bootstrap's
over runs (Efron & Tibshirani 1993, An Introduction to the Bootstrap): percentiles (ch. 13) of
means, the bootstrap-t (sec. 12.5) of squares.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, Literal

import numpy as np

from lscan.records import Floats, Mask
from sim.studies.problem import AFTER, ALL, BASE, Bounded, Indices, Output, alone, columns

# A finished study as plain data: of each output, cause by cause, where its error comes from.
#
# What cannot be said is None; no number is infinite or not a number.


When = Literal["as-built", "drift", "each-frame", "noise", "mixed"]
"""When a cause is at work; a group of causes of several kinds is mixed."""


@dataclass(frozen=True)
class CauseFacts:
    """What varies in a study.

    Attributes
    ----------
    name : str, as the study's file names it
    when : str, in which state of the rig it is at work
    keys : tuple of str, the dotted keys of the scene that it sets
    distribution : str, in words
    unit : str or None, of its value; None where it has none, such as noise
    group : str, the group that the budget counts it in, "" where it stands alone
    """

    name: str
    when: When
    keys: tuple[str, ...]
    distribution: str
    unit: str | None = None
    group: str = ""

    @property
    def counted_as(self) -> str:
        """The name it has in the budgets."""
        return self.group or self.name


@dataclass(frozen=True)
class StudyRuns:
    """The inputs and outputs of N runs, of D causes and K values in all.

    Attributes
    ----------
    causes : tuple of CauseFacts
    outputs : tuple of Output
    rows : (N, D) array, numbers in [0, 1), NaN where the cause is not at work
    physical : (N, D) array, in the causes' units, NaN where there is none
    blocks : tuple of str, what each run is for, as sim.studies.problem names its blocks: BASE,
        ALL, ``alone`` of a cause, or any other word
    values : (N, K) array, errors in the outputs' units, NaN where the run failed
    statuses : tuple of str, "ok" or why the run failed
    """

    causes: tuple[CauseFacts, ...]
    outputs: tuple[Output, ...]
    rows: Floats
    physical: Floats
    blocks: tuple[str, ...]
    values: Floats
    statuses: tuple[str, ...]


@dataclass(frozen=True)
class CauseBudget:
    """What one cause, or group, does to an output.

    Attributes
    ----------
    cause : str, its name, or that of the group
    alone_rms : Bounded, rms error with this cause alone at work, in the output's unit
    first, total : Bounded, Sobol indices
    sensitivity : float, in the output's unit for one unit of the cause; of a field, rms over places
    """

    cause: str
    alone_rms: Bounded | None = None
    first: Bounded | None = None
    total: Bounded | None = None
    sensitivity: float | None = None


@dataclass(frozen=True)
class IndexConvergence:
    """An index of a cause as it was after so many runs; runs and values have the same length."""

    cause: str
    index: Literal["first", "total"]
    runs: tuple[int, ...]
    values: tuple[Bounded, ...]


@dataclass(frozen=True)
class OutputBudget:
    """Where the error of an output comes from, in its unit; a field's is taken over its places.

    Attributes
    ----------
    name, unit : str
    places : int, 1 of a scalar
    causes : tuple of CauseBudget
    base_rms : float, rms with no cause at work
    mean : Bounded, mean error; of a field, rms over places of the mean error, its systematic part
    standard_uncertainty : Bounded, standard deviation; of a field, rms over places
    range_95 : tuple of float, quantiles 2.5 % and 97.5 % of the errors, of a field of all places
    rms : Bounded
    stated_rms : float, rms of the uncertainty that the instrument states itself
    rest : Bounded, share of the variance that is no cause's own but interaction
    convergence : tuple of IndexConvergence, of the largest indices
    after : OutputBudget, the same, calibrated anew before the scan
    """

    name: str
    unit: str
    places: int
    causes: tuple[CauseBudget, ...]
    base_rms: float | None = None
    mean: Bounded | None = None
    standard_uncertainty: Bounded | None = None
    range_95: tuple[float, float] | None = None
    rms: Bounded | None = None
    stated_rms: float | None = None
    rest: Bounded | None = None
    convergence: tuple[IndexConvergence, ...] = ()
    after: "OutputBudget | None" = None

    @property
    def stated_ratio(self) -> float | None:
        """The stated uncertainty over the rms error; below 1, the instrument promises too much."""
        if self.stated_rms is None or self.rms is None or self.rms.value == 0:
            return None
        return self.stated_rms / self.rms.value


@dataclass(frozen=True)
class ErrorMap:
    """The error over the surface with one cause alone at work, P places.

    Attributes
    ----------
    output, unit, cause : str
    xy_mm : tuple of P pairs, mm, on the workpiece
    rms, mean : tuple of P floats, in the output's unit
    """

    output: str
    unit: str
    cause: str
    xy_mm: tuple[tuple[float, float], ...]
    rms: tuple[float, ...]
    mean: tuple[float, ...]


@dataclass(frozen=True)
class CauseScatter:
    """The values of an output's largest cause and the errors of the same runs, all causes at work.

    Attributes
    ----------
    output, cause : str
    cause_unit : str
    values : tuple of float, in the cause's unit
    errors : tuple of float, in the output's unit; of a field, rms over its places
    """

    output: str
    cause: str
    cause_unit: str
    values: tuple[float, ...]
    errors: tuple[float, ...]


@dataclass(frozen=True)
class TierRow:
    """A figure of both tiers, and rendered less geometric."""

    what: str
    unit: str
    geometric: Bounded
    rendered: Bounded
    difference: Bounded


@dataclass(frozen=True)
class DesignTrial:
    """A rig that the design search tried.

    Attributes
    ----------
    objectives : mapping, name with unit to figure, None where it was not looked at; of a laser
        class its name
    parts : mapping, what it is built of, and its free numbers
    on_front : bool, it keeps all limits, and no other is better in every objective
    status : str, "ok", or why it failed, which limits it breaks, or why it was not rendered
    predicted_mm : float, mm, predicted error of the rigs that were rendered, where some were
    rendered_mm : Bounded, mm, rendered error of the same rigs
    """

    objectives: Mapping[str, float | str | None]
    parts: Mapping[str, str | float]
    on_front: bool = True
    status: str = "ok"
    predicted_mm: float | None = None
    rendered_mm: Bounded | None = None


@dataclass(frozen=True)
class Tolerance:
    """A cause's spread as the study's file states it, and that with which the bound is kept.

    Attributes
    ----------
    cause : str
    stated, allowed : str, distributions in words; allowed is None where there is none to find
    factor : float, allowed spread over stated
    """

    cause: str
    stated: str
    allowed: str | None
    factor: float | None


@dataclass(frozen=True)
class Tolerances:
    """How tight each cause must be for an output to keep a bound.

    Attributes
    ----------
    output : str
    most_mm : float, mm, the bound: of a field's rms over its places, of a scalar's absolute value
    in_share : float, of all rigs, that are to keep it
    by_cost : bool, the causes' costs were counted; else all are equally stringent
    causes : tuple of Tolerance
    floor_mm, stated_mm, allowed_mm : float, mm, what that share of all rigs keeps: with no spread
        but of what cannot be made tighter; with the stated spreads; with those allowed
    fresh : int, rigs drawn anew, with the allowed spreads
    found : Bounded, the share of them that kept the bound
    note : str, what a reader has to know, "" for nothing
    """

    output: str
    most_mm: float
    in_share: float
    by_cost: bool
    causes: tuple[Tolerance, ...]
    floor_mm: float | None
    stated_mm: float | None
    allowed_mm: float | None = None
    fresh: int = 0
    found: Bounded | None = None
    note: str = ""


@dataclass(frozen=True)
class PartChange:
    """What one part of an output's mean square is in each of two rigs, in the unit squared.

    Attributes
    ----------
    part : str, a cause or group, whose part is its first-order index times the variance; "the
        mean error", the same on all rigs; or "interaction", no cause's own.  They add up
    this, other : Bounded
    difference : Bounded, the other's less this one's, of the same draws
    """

    part: str
    this: Bounded | None
    other: Bounded | None
    difference: Bounded | None


@dataclass(frozen=True)
class OutputComparison:
    """The rms error of an output in two rigs on the same draws, in the output's unit.

    Attributes
    ----------
    name, unit : str
    places : int, 1 of a scalar
    this, other : Bounded, of either rig
    ratio : Bounded, the other's over this one's
    difference : Bounded, the other's less this one's
    narrower : float, how many times as wide the ratio's interval would be on draws of its own
    verdict : str, in words: better or worse, by how much, and through which part
    parts : tuple of PartChange, the largest change first
    """

    name: str
    unit: str
    places: int
    this: Bounded | None
    other: Bounded | None
    ratio: Bounded | None
    difference: Bounded | None
    narrower: float | None
    verdict: str
    parts: tuple[PartChange, ...]


@dataclass(frozen=True)
class RigComparison:
    """A study's rig and another one that differs in some numbers, on the same draws.

    Attributes
    ----------
    changes : mapping, from keys to this rig's number and the other's
    told : tuple of str, what the other rig's file states otherwise, since it follows
    folder : str, of the other rig's own study, beside these results
    rigs : int, pairs with all causes at work in which neither failed
    failed : tuple of int, of these rigs how many failed, of this one and of the other
    outputs : tuple of OutputComparison
    """

    changes: Mapping[str, tuple[float, float]]
    told: tuple[str, ...]
    folder: str
    rigs: int
    failed: tuple[int, int]
    outputs: tuple[OutputComparison, ...]


@dataclass(frozen=True)
class StudyResults:
    """All that a study found.

    Attributes
    ----------
    name : str
    source : mapping, the study's document
    tier : str; of "both", the budgets are in rendered physics
    seed, runs : int
    seconds : float, that it took
    causes : tuple of CauseFacts
    outputs : tuple of OutputBudget
    failures : mapping, why runs failed to how many did
    maps : tuple of ErrorMap
    scatters : tuple of CauseScatter
    notes : tuple of str, what a reader has to know
    tiers : tuple of TierRow, where both tiers were run
    trials : tuple of DesignTrial, where designs were searched
    tolerances : Tolerances, where the study's file asks for them
    against : RigComparison, where another rig was to be compared
    """

    name: str
    source: Mapping[str, Any]
    tier: Literal["geometric", "rendered", "both"]
    seed: int
    runs: int
    seconds: float
    causes: tuple[CauseFacts, ...]
    outputs: tuple[OutputBudget, ...]
    failures: Mapping[str, int] = field(default_factory=dict)
    maps: tuple[ErrorMap, ...] = ()
    scatters: tuple[CauseScatter, ...] = ()
    notes: tuple[str, ...] = ()
    tiers: tuple[TierRow, ...] = ()
    trials: tuple[DesignTrial, ...] = ()
    tolerances: Tolerances | None = None
    against: RigComparison | None = None


# The budget of a study's runs: rms, mean and scatter of each output, and each cause's part in it.


RESAMPLES = 400  # of the bootstrap: the ends of an interval lie 10 replicates inside
PERCENT = (2.5, 97.5)
MOST_SCATTERED = 600  # dots of a scatter


def budgets_of(
    runs: StudyRuns,
    indices: Mapping[str, Indices],
    *,
    seed: int,
    convergence: Mapping[str, tuple[IndexConvergence, ...]] | None = None,
) -> tuple[OutputBudget, ...]:
    """The budget of each output; that after recalibration lies in that before it.

    Parameters
    ----------
    runs : StudyRuns, those that failed are left out
    indices : mapping, of an output's name; some may be missing
    seed : int, of the bootstrap
    convergence : mapping, of an output's name, its largest indices against the number of runs
    """
    convergence = convergence or {}
    found = {
        output.name: _budget(
            runs,
            output.name,
            indices.get(output.name),
            seed=seed,
            convergence=convergence.get(output.name, ()),
        )
        for output in reversed(runs.outputs)
    }
    whole = []
    for output in runs.outputs:
        if not output.name.endswith(AFTER) or output.name.removesuffix(AFTER) not in found:
            whole.append(replace(found[output.name], after=found.get(output.name + AFTER)))
    return tuple(whole)


def _budget(
    runs: StudyRuns,
    name: str,
    indices: Indices | None,
    *,
    seed: int,
    convergence: tuple[IndexConvergence, ...],
) -> OutputBudget:
    output = next(output for output in runs.outputs if output.name == name)
    base, mixed = errors_in(runs, name, BASE), errors_in(runs, name, ALL)
    enough = len(mixed) > 1
    mean, deviation = _mean_and_deviation(mixed, seed) if enough else (None, None)
    low, high = np.percentile(mixed, PERCENT) if enough else (0.0, 0.0)
    groups = dict.fromkeys(cause.counted_as for cause in runs.causes)
    return OutputBudget(
        name=name,
        unit=output.unit,
        places=output.size,
        causes=tuple(_cause(runs, name, group, indices, seed) for group in groups),
        base_rms=float(np.sqrt(np.mean(base**2))) if len(base) else None,
        mean=mean,
        standard_uncertainty=deviation,
        range_95=(float(low), float(high)) if enough else None,
        rms=_rms(mixed, seed),
        rest=indices.rest.known if indices else None,
        convergence=convergence,
    )


def _cause(
    runs: StudyRuns, name: str, group: str, indices: Indices | None, seed: int
) -> CauseBudget:
    own = indices.groups.get(group) if indices else None
    return CauseBudget(
        cause=group,
        alone_rms=_rms(errors_in(runs, name, alone(group)), seed),
        first=own.first.known if own else None,
        total=own.total.known if own else None,
        sensitivity=_sensitivity(runs, name, group),
    )


def errors_in(runs: StudyRuns, name: str, block: str) -> Floats:
    """(n, P) errors of an output in the runs of a block that did not fail.

    Parameters
    ----------
    runs : StudyRuns
    name : str, of the output
    block : str
    """
    return runs.values[_chosen(runs, block), columns(runs.outputs)[name]]


def _chosen(runs: StudyRuns, block: str) -> Mask:
    """Mask of the runs of a block that did not fail."""
    wanted = np.array(runs.blocks, dtype=object) == block
    return wanted & (np.array(runs.statuses, dtype=object) == "ok")


@lru_cache(maxsize=2)  # all outputs, and causes that failed as often, share them
def _weights(runs: int, seed: int) -> Floats:
    """(RESAMPLES, runs) how much of each replicate is each run."""
    rng = np.random.default_rng(seed)
    return rng.multinomial(runs, np.full(runs, 1 / runs), size=RESAMPLES) / runs


def _finite_bounded(value: float, low: float, high: float) -> Bounded | None:
    return Bounded(float(value), float(low), float(high)).known


def _rms(errors: Floats, seed: int) -> Bounded | None:
    """Root of the mean over runs and places of the squared error."""
    return _root((errors**2).mean(axis=1), seed) if len(errors) else None


def _root(squares: Floats, seed: int) -> Bounded | None:
    """Root of the mean of (n,) squares; its interval is the bootstrap-t's, of the logarithm.

    Squares are skewed: of 200 Gaussian errors a percentile interval holds the truth 93 times in a
    hundred, this one 94 to 95 times.
    """
    mean, variance = squares.mean(), squares.var()
    if variance == 0:
        return _finite_bounded(*[np.sqrt(mean)] * 3)
    weights = _weights(len(squares), seed)
    means = weights @ squares
    variances = weights @ (squares - mean) ** 2 - (means - mean) ** 2
    told = variances > 1e-12 * variance  # else all of its runs are one
    off = np.log(means[told] / mean) * means[told] / np.sqrt(variances[told])
    low, high = np.percentile(off, PERCENT) if told.any() else (0.0, 0.0)
    step = np.sqrt(variance) / mean
    return _finite_bounded(*np.sqrt(mean * np.exp(-step * np.array([0.0, high, low]))))


def _mean_and_deviation(errors: Floats, seed: int) -> tuple[Bounded | None, Bounded | None]:
    """Mean and standard deviation over (n, P) errors; of a field, rms over its places."""
    n, places = errors.shape
    weights = _weights(n, seed)
    means, more_means = errors.mean(axis=0), weights @ errors
    squares = ((errors - means) ** 2).mean(axis=1) * n / (n - 1)
    if places == 1:
        mean, more = means[0], more_means[:, 0]
    else:
        # The square of a mean of n runs is too large by variance / n; that of a replicate, which
        # is drawn from such runs, by twice as much.
        mean = np.sqrt(max((means**2).mean() - squares.mean() / n, 0.0))
        bias = 2 * (weights @ squares) / n
        more = np.sqrt(np.maximum((more_means**2).mean(axis=1) - bias, 0.0))
    return _finite_bounded(mean, *np.percentile(more, PERCENT)), _root(squares, seed)


def _sensitivity(runs: StudyRuns, name: str, group: str) -> float | None:
    """Slope of the error against the value of a cause that is alone at work."""
    members = [k for k, cause in enumerate(runs.causes) if cause.counted_as == group]
    if len(members) != 1 or runs.causes[members[0]].unit is None:
        return None
    errors = errors_in(runs, name, alone(group))
    value = runs.physical[_chosen(runs, alone(group)), members[0]]
    if len(value) < 2 or not np.isfinite(value).all() or np.ptp(value) == 0:
        return None
    off = value - value.mean()
    slopes = off @ errors / (off @ off)
    return float(slopes[0] if slopes.size == 1 else np.sqrt(np.mean(slopes**2)))


def error_maps(runs: StudyRuns, xy_mm: Mapping[str, Floats]) -> tuple[ErrorMap, ...]:
    """Of each field, the errors over the surface: each cause alone.

    Parameters
    ----------
    runs : StudyRuns
    xy_mm : mapping, of a field's name, (P, 2) array, mm, its places on the workpiece
    """
    units = {output.name: output.unit for output in runs.outputs}
    found = []
    for name, places in xy_mm.items():
        for group in dict.fromkeys(cause.counted_as for cause in runs.causes):
            errors = errors_in(runs, name, alone(group))
            if len(errors):
                rms = np.sqrt((errors**2).mean(axis=0)).tolist()
                mean = errors.mean(axis=0).tolist()
                xy = tuple((float(x), float(y)) for x, y in places)
                found.append(ErrorMap(name, units[name], group, xy, tuple(rms), tuple(mean)))
    return tuple(found)


def scatters_of(runs: StudyRuns, budgets: tuple[OutputBudget, ...]) -> tuple[CauseScatter, ...]:
    """Of each output, its error against the largest cause that has a value, all being at work.

    Parameters
    ----------
    runs : StudyRuns
    budgets : tuple of OutputBudget, of the same runs
    """
    found = []
    numbered = {c.name: (k, c.unit) for k, c in enumerate(runs.causes) if c.unit and not c.group}
    for budget in budgets:
        ranked = sorted(
            (c for c in budget.causes if c.total and c.cause in numbered),
            key=lambda c: -c.total.value if c.total else 0.0,
        )
        errors = errors_in(runs, budget.name, ALL)[:MOST_SCATTERED]
        shown = errors[:, 0] if budget.places == 1 else np.sqrt((errors**2).mean(axis=1))
        for cause in ranked:
            column, unit = numbered[cause.cause]
            value = runs.physical[_chosen(runs, ALL), column][:MOST_SCATTERED]
            if len(value) and unit and np.isfinite(value).all():
                dots = tuple(value.tolist()), tuple(shown.tolist())
                found.append(CauseScatter(budget.name, cause.cause, unit, *dots))
                break
    return tuple(found)
