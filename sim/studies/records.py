"""A finished study as plain data: of each output, cause by cause, where its error comes from.

What cannot be said is None; no number is infinite or not a number.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from lscan.records import Floats
from sim.studies.intervals import Bounded
from sim.studies.problem import Output

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
    blocks : tuple of str, what each run is for, as sim.studies.sampling names its blocks: BASE,
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
