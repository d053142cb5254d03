"""A made-up study whose budget is known in closed form: errors linear in Gaussian causes.

The error at place p is the sum of slope x factor of the place x value over the causes; what is new
in each picture is drawn at each place anew.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import norm

from lscan.records import Floats
from sim.studies.budget import (
    CauseFacts,
    DesignTrial,
    IndexConvergence,
    OutputComparison,
    PartChange,
    RigComparison,
    StudyResults,
    StudyRuns,
    TierRow,
    Tolerance,
    Tolerances,
    When,
    budgets_of,
    error_maps,
    scatters_of,
)
from sim.studies.problem import (
    ALL,
    BASE,
    Bounded,
    GroupIndices,
    Indices,
    Moments,
    Output,
    alone,
    columns,
    width,
)

OUTPUTS = (Output("height", "mm", 80), Output("height.after", "mm", 80), Output("yaw", "deg"))
XY_MM = np.stack(np.meshgrid(np.linspace(0, 150, 10), np.linspace(0, 110, 8)), axis=-1)
XY_MM = XY_MM.reshape(-1, 2)
REASONS = ("board.png: no dots", "sandwave: the line leaves the picture (allowed: 640 px)")


@dataclass(frozen=True)
class LinearCause:
    """A cause and its effect: mm of height, and degrees of yaw, for one sigma of it.

    left: the share of its effect on the height that recalibrating leaves.
    """

    facts: CauseFacts
    sigma: float
    height_mm: float
    yaw_deg: float
    left: float
    lean: float = 0.0


def _cause(
    name: str, when: When, key: str, sigma: float, unit: str | None, group: str = ""
) -> CauseFacts:
    words = f"normal, sd {sigma:g} {unit or ''}".rstrip()
    return CauseFacts(name, when, (key,), words, unit, group)


CAUSES = (
    LinearCause(_cause("board-off", "as-built", "board.y_mm", 1.0, "mm"), 1.0, 0.35, 0.0, 1.0),
    LinearCause(_cause("tilt", "drift", "port.tilt_deg", 0.2, "deg"), 0.2, 0.9, 0.02, 0.05, 1.0),
    LinearCause(_cause("salinity", "drift", "water.salinity_psu", 5, "psu"), 5.0, 0.5, 0, 0.1, 0.5),
    LinearCause(
        _cause("angle", "drift", "head.depression_deg", 0.01, "deg", "pose"), 0.01, 0.2, 0.01, 0.1
    ),
    LinearCause(
        _cause("distance", "drift", "head.y_mm", 0.1, "mm", "pose"), 0.1, 0.15, 0.01, 0.1, 0.8
    ),
    LinearCause(_cause("pointing", "each-frame", "laser.tilt_deg", 0.02, None), 1, 0.2, 0.03, 1),
    LinearCause(_cause("speckle", "noise", "noise.speckle", 1, None), 1.0, 0.07, 0.005, 1.0),
)
GROUPS = tuple(dict.fromkeys(cause.facts.counted_as for cause in CAUSES))


def profile(cause: LinearCause) -> Floats:
    """(P,) factor of each place: 1, or leaning along x by ``lean``."""
    return 1 + cause.lean * (XY_MM[:, 0] - XY_MM[:, 0].mean()) / np.ptp(XY_MM[:, 0])


def effect(cause: LinearCause, output: str) -> Floats:
    """(size,) error of an output for one sigma of the cause."""
    if output == "yaw":
        return np.array([cause.yaw_deg])
    return cause.height_mm * profile(cause) * (cause.left if output.endswith(".after") else 1.0)


def true_square(group: str, output: str) -> float:
    """The mean square over places that a cause or group makes: closed form."""
    members = [cause for cause in CAUSES if cause.facts.counted_as == group]
    return float(sum((effect(cause, output) ** 2).mean() for cause in members))


def true_share(group: str, output: str) -> float:
    """Its first index, which is its total one as well: nothing interacts."""
    every = sum(true_square(one, output) for one in GROUPS)
    return true_square(group, output) / every


def study_runs(seed: int, alone_runs: int = 256, mixed: int = 2048, failing: int = 0) -> StudyRuns:
    """Runs of the blocks; every ``failing``-th one failed, if not 0."""
    blocks = [BASE, *(alone(group) for group in GROUPS for _ in range(alone_runs)), *[ALL] * mixed]
    rng = np.random.default_rng(seed)
    numbers = rng.random((len(blocks), len(CAUSES)))
    for n, block in enumerate(blocks):
        for k, cause in enumerate(CAUSES):
            if block not in (ALL, alone(cause.facts.counted_as)):
                numbers[n, k] = np.nan
    physical = norm.ppf(numbers) * [cause.sigma for cause in CAUSES]
    values = np.zeros((len(blocks), width(OUTPUTS)))
    for k, cause in enumerate(CAUSES):
        at_work = np.isfinite(numbers[:, k])
        for name, where in columns(OUTPUTS).items():
            one = physical[at_work, k, None] / cause.sigma
            if cause.facts.unit is None:  # new at each place
                one = rng.standard_normal((at_work.sum(), where.stop - where.start))
            values[at_work, where] += one * effect(cause, name)
    physical[:, [cause.facts.unit is None for cause in CAUSES]] = np.nan
    statuses = np.array(["ok"] * len(blocks), dtype=object)
    if failing:
        for k, reason in enumerate(REASONS):
            statuses[failing + k :: 2 * failing] = reason
    values[statuses != "ok"] = np.nan
    facts = tuple(cause.facts for cause in CAUSES)
    return StudyRuns(facts, OUTPUTS, numbers, physical, tuple(blocks), values, tuple(statuses))


def indices(spread: float = 0.02) -> dict[str, Indices]:
    """The true indices of every output, with intervals of this half-width."""
    found = {}
    unknown, none = Bounded(np.nan, np.nan, np.nan), spread * np.sqrt(len(GROUPS))
    for output in OUTPUTS:
        shares = {group: true_share(group, output.name) for group in GROUPS}
        bounded = {group: Bounded(s, s - spread, s + spread) for group, s in shares.items()}
        groups = {group: GroupIndices(one, one, 64) for group, one in bounded.items()}
        rest, moments = Bounded(0.0, -none, none), Moments(*[unknown] * 4)
        found[output.name] = Indices(groups, rest, moments, 64, 0)
    return found


def study_results(seed: int = 1) -> tuple[StudyResults, StudyRuns]:
    """All that a study can have: failures, maps, both tiers and designs."""
    runs = study_runs(seed, failing=20)
    steps = tuple(
        IndexConvergence(
            group,
            "total",
            (256, 512, 1024, 2048),
            tuple(
                Bounded(s, s - 0.6 / n**0.5, s + 0.6 / n**0.5)
                for n in (256, 512, 1024, 2048)
                for s in [true_share(group, "height") + 0.3 / n**0.5]
            ),
        )
        for group in ("tilt", "salinity", "board-off")
    )
    height, *more = budgets_of(runs, indices(), seed=seed, convergence={"height": steps})
    assert height.after is not None
    after = replace(height.after, stated_rms=0.09)
    budgets = (replace(height, stated_rms=0.09, after=after), *more)
    rng = np.random.default_rng(seed)
    return StudyResults(
        name="seasons",
        source={"calibrate": "best/board", "cause": {"salinity": {"normal": [0, 5]}}},
        tier="geometric",
        seed=seed,
        runs=len(runs.statuses),
        seconds=211.4,
        causes=runs.causes,
        outputs=budgets,
        failures={reason: runs.statuses.count(reason) for reason in REASONS},
        maps=error_maps(runs, {"height": XY_MM, "height.after": XY_MM}),
        scatters=scatters_of(runs, budgets),
        notes=("5 % of the runs failed.",),
        tiers=(
            TierRow(
                "height, tilt alone",
                "mm",
                Bounded(0.94, 0.9, 0.98),
                Bounded(0.97, 0.88, 1.06),
                Bounded(0.03, -0.06, 0.12),
            ),
        ),
        trials=tuple(_trial(*rng.random(3), on_front=k % 5 == 0) for k in range(60)),
        tolerances=Tolerances(
            "height",
            0.1,
            0.95,
            True,
            (
                Tolerance("tilt", "normal 0 ± 0.2", "normal 0 ± 0.012", 0.06),
                Tolerance("speckle", "the scene's own", None, None),
            ),
            0.07,
            2.1,
            0.099,
            500,
            Bounded(0.954, 0.932, 0.969),
        ),
        against=_against(),
    ), runs


def _against() -> RigComparison:
    """Of the height less, through tilt, of the yaw nothing known."""
    this, other, less = Bounded(1.1, 1.0, 1.2), Bounded(0.6, 0.5, 0.7), Bounded(-0.5, -0.6, -0.4)
    parts = (PartChange("tilt", this, other, less), PartChange("interaction", None, None, None))
    words = "the other rig is better: its rms error is 0.545 ± 0.04 of this one’s"
    height = OutputComparison(
        "height", "mm", 80, this, other, Bounded(0.545, 0.51, 0.59), less, 4.2, words, parts
    )
    yaw = OutputComparison("yaw", "deg", 1, None, None, None, None, None, "not compared", ())
    changes, told = {"port.tilt_deg": (0.2, 0.1)}, ("optics.gap_mm = 16, 3",)
    return RigComparison(changes, told, "against/port.tilt_deg=0.1", 512, (3, 0), (height, yaw))


def _trial(angle: float, camera: float, laser: float, *, on_front: bool) -> DesignTrial:
    cost = 60 + 400 * camera + 80 * laser
    error = 0.08 + 6 / cost + 0.3 * (angle - 0.5) ** 2 + (0 if on_front else 0.08)
    objectives = {"error / mm": error, "cost / €": cost, "measured width / mm": 120 + 160 * angle}
    parts = {
        "camera": f"webcam {int(20 * camera)}",
        "laser": f"line {int(10 * laser)}",
        "depression / deg": 15 + 40 * angle,
    }
    safety = {"laser class": "3R" if laser > 0.5 else "2"}
    return DesignTrial({**objectives, **safety}, parts, on_front)


def strange_results() -> StudyResults:
    """A study that found nothing, with names that a page has to escape."""
    results, _ = study_results()
    name = "<script>alert('x')</script> & a name that is much longer than any column of a table"
    cause = CauseFacts(name, "drift", ("a.b",), "<i>uniform</i>", "</script>")
    blank = replace(
        results.outputs[-1], causes=(), convergence=(), after=None, name=name, rest=None
    )
    return StudyResults(
        name, {"a": name}, "rendered", 0, 3, 1.0, (cause,), (blank,), {f"{name}: failed": 3}
    )
