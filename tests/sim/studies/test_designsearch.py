"""The design search, its error a closed form: the same trials, resumed or not, and their front."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import islice, product
from math import cos, radians
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies
from hypothesis.extra import numpy as arrays

from lscan.config.documents import Document, check
from lscan.config.rig import load_rig
from lscan.errors import InputError, MeasurementError
from lscan.records import Floats
from sim.scene import Head
from sim.studies.design.catalogue import Catalogue, DesignSection, load_catalogue
from sim.studies.design.rig import aim_mm, document_of, with_exposure
from sim.studies.design.search import (
    DesignProblem,
    Judged,
    Parameters,
    RigTrial,
    front,
    front_of,
    search,
)

pytestmark = pytest.mark.xdist_group("design_search")  # one worker: they share a fixture

SECTION = {
    "sights": ["logitech-*", "sony-*", "raspberry-pi-gs + *", "basler-daa1440*"],
    "tracks": ["v-slot-tr8", "belt-gt2"],
    "numbers": {"stand_off_mm": {"uniform": [400, 1200]}, "head.depression_deg": [15, 30, 45]},
    "limits": {"cost_eur": {"at_most": 500}, "laser_class": {"at_most": "3R"}},
    "trials": 20,
    "population": 10,
    "expose": False,
}
CENTRE_PX = 0.1
Judge = Callable[[Parameters], Judged]


def error_mm(document: Document) -> float:
    """Triangulation: a line found to CENTRE_PX in air; a height moves the line by f cos / D."""
    head, focal_px = document["head"], document["lens"]["focal_px"]
    slope = cos(radians(head["depression_deg"]))
    return CENTRE_PX * -head["camera_mm"][1] / slope / (focal_px * slope)


def failing(document: Document) -> float:
    """As ``error_mm``, and no rig of 45 degrees can be calibrated."""
    if document["head"]["depression_deg"] == 45.0:
        raise MeasurementError("the board is not in the picture")
    return error_mm(document)


@pytest.fixture(scope="module")
def catalogue() -> Catalogue:
    return load_catalogue()


@pytest.fixture(scope="module")
def problem(catalogue: Catalogue) -> DesignProblem:
    section = check(DesignSection, SECTION, where="a test")
    return DesignProblem(section, catalogue, load_rig("paper/sandwave").document, error_mm)


@pytest.fixture(scope="module")
def trials(problem: DesignProblem) -> list[RigTrial]:
    return search(problem)


def backwards(judge: Judge, of: Sequence[Parameters]) -> Iterable[Judged]:
    """Judges in another order than asked for, as workers do."""
    return reversed([judge(one) for one in reversed(of)])


def test_the_seed_gives_the_trials_whoever_runs_them(
    problem: DesignProblem, trials: list[RigTrial]
) -> None:
    assert len(trials) == 20
    assert search(problem, run=backwards) == trials
    other = replace(problem, section=problem.section.model_copy(update={"seed": 2}))
    assert search(other) != trials


def test_a_search_goes_on_where_it_was_stopped(
    problem: DesignProblem, trials: list[RigTrial], tmp_path: Path
) -> None:
    """Stopped within its second generation: nothing is judged twice, and the file is the same."""
    whole, stopped = tmp_path / "whole.json", tmp_path / "stopped.json"
    judged: list[Parameters] = []

    def some(judge: Judge, of: Sequence[Parameters]) -> Iterable[Judged]:
        for one in islice(of, 15 - len(judged)):
            judged.append(one)
            yield judge(one)
        raise KeyboardInterrupt

    def counted(judge: Judge, of: Sequence[Parameters]) -> Iterable[Judged]:
        judged.extend(of)
        return map(judge, of)

    assert search(problem, whole) == trials
    with pytest.raises(KeyboardInterrupt):
        search(problem, stopped, run=some)
    assert search(problem, stopped, run=counted) == trials
    different = {str(sorted(trial.parameters.items())) for trial in trials}
    assert len(judged) == len(different)
    assert stopped.read_bytes() == whole.read_bytes()


def test_trials_of_another_search_are_refused(problem: DesignProblem, tmp_path: Path) -> None:
    file = tmp_path / "trials.json"
    small = problem.section.model_copy(update={"trials": 10})
    search(replace(problem, section=small), file)
    with pytest.raises(InputError, match=r"trials\.json: holds trials of another search"):
        search(problem, file)


def test_a_failing_design_is_a_row_with_its_reason(problem: DesignProblem) -> None:
    section = problem.section.model_copy(update={"limits": {}})
    problem = replace(problem, section=section, error_of=failing)
    trials = search(problem)
    failed = [trial for trial in trials if trial.figures is None]
    assert failed and {trial.reason for trial in failed} == {"the board is not in the picture"}
    assert {trial.parameters["head.depression_deg"] for trial in failed} == {45.0}
    assert len(trials) == 20 and front_of(problem, trials)


def test_the_front_keeps_the_limits_and_is_found(
    problem: DesignProblem, trials: list[RigTrial]
) -> None:
    best = front_of(problem, trials)
    assert best and len({str(trial.parameters) for trial in best}) == len(best)
    for trial in best:
        assert trial.figures is not None and trial.figures.error_mm is not None
        assert trial.figures.cost_eur <= 500
        assert trial.figures.laser_class in ("1", "2", "3R")
        # Its figures are those of its scene.
        document = problem.document(trial.parameters)
        assert error_mm(document) == trial.figures.error_mm
    errors = [trial.figures.error_mm for trial in best if trial.figures]
    assert errors == sorted(errors)
    # What breaks a limit is a row, not assessed, and on no front.
    dear = [trial for trial in trials if trial.figures and trial.figures.cost_eur > 500]
    assert all(trial.reason.startswith("breaks the limit of") for trial in dear)
    assert all(trial.figures and trial.figures.error_mm is None for trial in dear)


def test_parts_beyond_the_limit_are_left_out_and_no_others(problem: DesignProblem) -> None:
    """Against every rig there is: a part is tried if and only if some rig with it is affordable."""
    catalogue, space = problem.catalogue, problem.section.space(problem.catalogue)
    free = problem.section.model_copy(update={"limits": {}}).space(catalogue)
    kinds = ("sight", "laser", "window", "track")
    prices = {part.name: part.price.eur for kind in kinds[1:] for part in getattr(catalogue, kind)}
    for name, parts in catalogue.sights.items():
        prices[name] = sum(part.price.eur for part in parts if part)
    affordable: dict[str, set[object]] = {kind: set() for kind in kinds}
    for rig in product(*(free[kind] for kind in kinds)):
        if sum(prices[name] for name in rig) <= 500:
            for kind, name in zip(kinds, rig, strict=True):
                affordable[kind].add(name)
    for kind, names in affordable.items():
        assert set(space[kind]) == names
    assert len(space["laser"]) < len(free["laser"])


@pytest.mark.parametrize(
    ("keys", "named"),
    [
        ({"tracks": ["rail-*"]}, "design.tracks: is no part's name or pattern (got 'rail-*'"),
        ({"trials": 31}, "trials must be a multiple of population"),
        ({"limits": {"cost_eur": {"at_most": 9}}}, "no rig of the chosen parts is so cheap"),
    ],
)
def test_a_wrong_section_is_refused(
    problem: DesignProblem, keys: dict[str, object], named: str
) -> None:
    with pytest.raises(InputError) as refused:
        section = check(DesignSection, SECTION | keys, where="study.toml", prefix="design")
        search(replace(problem, section=section))
    assert named in str(refused.value)


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ({"stand_off_mm": 900.0, "baseline_mm": 950.0}, "is no leg of stand_off_mm"),
        (
            {"stand_off_mm": 900.0, "baseline_mm": 500.0, "head.depression_deg": 30.0},
            "two of them give the third",
        ),
    ],
)
def test_numbers_that_make_no_rig_are_refused(
    problem: DesignProblem, trials: list[RigTrial], numbers: dict[str, float], message: str
) -> None:
    design = replace(problem.design(trials[0].parameters), numbers=numbers)
    with pytest.raises(InputError, match=message):
        document_of(design, problem.base)


def test_two_of_stand_off_baseline_and_angle_give_the_third(
    problem: DesignProblem, trials: list[RigTrial]
) -> None:
    design = problem.design(trials[0].parameters)
    ways = (
        {"stand_off_mm": 800.0, "head.depression_deg": 30.0},
        {"stand_off_mm": 800.0, "baseline_mm": 800.0 * cos(radians(30.0))},
        {"baseline_mm": 800.0 * cos(radians(30.0)), "head.depression_deg": 30.0},
    )
    places = [document_of(replace(design, numbers=way), problem.base)["head"] for way in ways]
    for place in places:
        # The paper's axis meets the sheet 0.2 m below O; to its printed 0.1 um.
        np.testing.assert_allclose(place["camera_mm"], [225.0, -692.8203, 200.0], atol=1e-3)
        assert place["depression_deg"] == pytest.approx(30.0)


def test_the_exposure_follows_the_line(problem: DesignProblem, trials: list[RigTrial]) -> None:
    """Twice the light halves it, and without a line there is none."""
    design = problem.design(trials[0].parameters)
    laser = next(
        one for one in problem.catalogue.laser if one.name == "laser-components-mvnano-640"
    )
    camera, lens = problem.catalogue.sights["raspberry-pi-gs + raspberry-pi-6mm"]
    design = replace(design, camera=camera, lens=lens, laser=laser, numbers={"aim_z_mm": -330.0})
    document = document_of(design, problem.base)
    assert aim_mm(check(Head, document["head"], where="a test"))[2] == pytest.approx(-330.0)
    brighter = {**document, "laser": {**document["laser"]}}
    brighter["laser"]["power_mw"] *= 2
    once, twice = (
        with_exposure(one, "a test")["camera"]["exposure_ms"] for one in (document, brighter)
    )
    assert twice == pytest.approx(once / 2)
    dark = {**document, "laser": {**document["laser"], "on": False}}
    with pytest.raises(InputError, match="no line is lit and seen"):
        with_exposure(dark, "a test")


POINTS = arrays.arrays(
    float,
    strategies.tuples(strategies.integers(1, 30), strategies.integers(1, 4)),
    elements=strategies.integers(-3, 3).map(float),
)


def dominates(one: Floats, other: Floats) -> bool:
    return bool((one <= other).all() and (one < other).any())


@given(POINTS)
def test_the_front_is_what_nothing_dominates(values: Floats) -> None:
    on = front(values)
    assert on.any()
    for point, member in zip(values, on, strict=True):
        assert member == (not any(dominates(other, point) for other in values))
        # And whatever is not on it is dominated by a member.
        assert member or any(dominates(other, point) for other in values[on])
