"""Tolerances against closed forms: linear errors of Gaussian causes, and deterministic rigs."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from scipy.special import ndtri
from scipy.stats import norm
from study_cases import known_of, study_with

from lscan.config.documents import Document, check
from lscan.errors import InputError
from lscan.records import Floats
from sim.studies import running, tiers as module
from sim.studies.budget import Tolerances
from sim.studies.page import tolerance_sentence
from sim.studies.problem import Output
from sim.studies.results import Results, load_results
from sim.studies.running import StudyOptions
from sim.studies.study import run_study
from sim.studies.studyfile import Bound, StudyFile
from sim.studies.tiers import (
    CLOSE,
    FARTHEST,
    STEPS,
    bounded_output,
    find_tolerances,
    sizes_of,
    with_spreads,
)

TWO_SIDED = float(norm.ppf(0.975))
"""Sigmas that 95 % of a normal number lie within."""
SEEN = 3 * (0.95 * 0.05 / 512) ** 0.5
"""Of the yield: three standard deviations of a share of 512 random rigs; these are more even."""

NOISE: Document = {"key": "sensor.noise", "when": "noise"}


def normal(deviation: float, **others: object) -> Document:
    return {"key": "lens.focal_px", "when": "drift", "normal": [0.0, deviation], **others}


def file_of(causes: Document, seed: int = 1) -> StudyFile:
    return check(
        StudyFile, {"calibrate": "a", "scan": "b", "seed": seed, "cause": causes}, where="study"
    )


class LinearRigs:
    """Rigs whose error is the sum of the causes' normal numbers, noise of a given sigma, a mean."""

    def __init__(self, file: StudyFile, noise: float = 0.0, mean: float = 0.0) -> None:
        self.file, self.noise, self.mean, self.calls = file, noise, mean, 0

    def __call__(self, factors: Mapping[str, float], rows: Floats) -> Floats:
        """(N,) absolute errors."""
        self.calls += 1
        found = np.full(len(rows), self.mean)
        for column, (name, cause) in zip(rows.T, self.file.cause.items(), strict=True):
            sigma = self.noise if cause.when == "noise" else cause.deviation
            found += factors.get(name, 1.0) * sigma * ndtri(column)
        return np.abs(found)

    def sigma(self, found: Tolerances) -> float:
        """Of the error with the tolerances found."""
        parts = [self.noise] + [
            (cause.factor or 0.0) * self.file.cause[cause.cause].deviation for cause in found.causes
        ]
        return float(np.linalg.norm(parts))


def tolerances_of(rigs: LinearRigs, most_mm: float, **shares: float) -> Tolerances:
    return find_tolerances(rigs.file, Bound(most_mm=most_mm), shares, rigs)


@pytest.mark.parametrize("most_mm", [0.02, 0.1, 0.7])
def test_a_normal_error_keeps_its_bound_with_the_yield_asked_for(most_mm: float) -> None:
    """The exact yield, two-sided, with the spreads found; noise takes its part first."""
    causes = {"one": normal(0.03), "two": normal(0.1), "noise": NOISE}
    rigs = LinearRigs(file_of(causes), noise=0.005)
    found = tolerances_of(rigs, most_mm)
    assert 2 * norm.cdf(most_mm / rigs.sigma(found)) - 1 == pytest.approx(0.95, abs=SEEN)
    assert found.floor_mm == pytest.approx(0.005 * TWO_SIDED, rel=0.1)
    assert found.allowed_mm is not None
    assert CLOSE * most_mm <= found.allowed_mm <= most_mm
    one, two, noise = found.causes
    assert one.factor is not None
    assert one.factor == two.factor
    assert (noise.stated, noise.allowed, noise.factor) == ("the scene's own", None, None)
    assert one.allowed == f"normal 0 ± {0.03 * one.factor:g}"


def test_a_mean_that_is_off_takes_its_part_of_the_bound() -> None:
    """Far off, only one side can break the bound: mean + 1.645 sigma = most."""
    rigs = LinearRigs(file_of({"one": normal(1.0)}), mean=5.0)
    found = tolerances_of(rigs, 6.0)
    assert found.floor_mm == 5.0
    assert norm.cdf(1.0 / rigs.sigma(found)) == pytest.approx(0.95, abs=SEEN)


def test_the_verifying_intervals_hold_the_true_yield() -> None:
    """Of 20 studies 19 are expected; fewer than 16 would be seen in 1 of 390."""
    held = 0
    for seed in range(20):
        rigs = LinearRigs(file_of({"one": normal(0.1), "two": normal(0.2)}, seed))
        found = tolerances_of(rigs, 0.1)
        assert found.found is not None
        true = 2 * norm.cdf(0.1 / rigs.sigma(found)) - 1
        assert true == pytest.approx(0.95, abs=SEEN)
        held += found.found.low <= true <= found.found.high
    assert held >= 16


def test_a_floor_beyond_the_bound_ends_the_search_at_once() -> None:
    rigs = LinearRigs(file_of({"one": normal(0.1), "noise": NOISE}), noise=0.1)
    found = tolerances_of(rigs, 0.1)
    assert rigs.calls == 2  # without spread, and as stated
    assert "what cannot be made tighter alone makes" in found.note
    assert [cause.allowed for cause in found.causes] == [None, None]
    assert found.found is None
    assert found.note in tolerance_sentence(found)


def test_a_study_of_nothing_but_noise_has_no_tolerances() -> None:
    found = tolerances_of(LinearRigs(file_of({"noise": NOISE}), noise=0.01), 0.1)
    assert found.floor_mm == found.stated_mm
    assert "No tolerances were found" in found.note


def test_loose_spreads_are_looked_at_up_to_a_limit() -> None:
    found = tolerances_of(LinearRigs(file_of({"one": normal(0.001)})), 0.1)
    assert found.causes[0].factor == FARTHEST
    assert "room to spare" in found.note


def test_rigs_that_fail_keep_no_bound() -> None:
    """Beyond a third of the stated spread more than a twentieth fail: no secant can be drawn."""
    file = file_of({"one": normal(1.0)})

    def sizes(factors: Mapping[str, float], rows: Floats) -> Floats:
        off = np.abs(factors["one"] * ndtri(rows[:, 0]))
        return np.where(off > TWO_SIDED / 3, np.inf, 0.01 * off)

    found = find_tolerances(file, Bound(most_mm=0.1), {}, sizes)
    assert found.stated_mm is None
    assert found.found is not None
    assert found.causes[0].factor is not None
    assert 0 < found.causes[0].factor < 0.34
    assert found.found.value > 0.95 - SEEN

    def broken(factors: Mapping[str, float], rows: Floats) -> Floats:
        return np.full(len(rows), np.inf if factors["one"] else 0.0)

    found = find_tolerances(file, Bound(most_mm=0.1), {}, broken)
    assert "No tolerances were found" in found.note
    assert found.found is None


@examples(10)
@given(st.floats(0.02, 0.2), st.floats(1.1, 3.0), st.integers(0, 99))
def test_a_tighter_bound_asks_for_tighter_causes(most: float, looser: float, seed: int) -> None:
    """The same rigs are run, and the bounds lie farther apart than the search's last step."""
    rigs = LinearRigs(file_of({"one": normal(0.1), "noise": NOISE}, seed), noise=0.004)
    tight, loose = (tolerances_of(rigs, one).causes[0].factor for one in (most, most * looser))
    assert tight is not None
    assert loose is not None
    assert tight < loose


def test_effects_and_bound_twice_as_large_leave_the_factors() -> None:
    """Twice is exact in binary numbers."""
    factors = []
    for scale in (1.0, 2.0):
        causes = {"one": normal(0.1 * scale), "two": normal(0.03 * scale)}
        found = tolerances_of(LinearRigs(file_of(causes), mean=0.02 * scale), 0.1 * scale)
        factors.append([cause.factor for cause in found.causes])
    assert factors[0] == factors[1]


@examples(15)
@given(
    st.lists(st.floats(0.1, 100.0), min_size=3, max_size=3),
    st.lists(st.floats(0.02, 1.0), min_size=3, max_size=3),
    st.integers(0, 99),
)
def test_costs_are_the_least_that_keep_the_bound(
    costs: list[float], variances: list[float], seed: int
) -> None:
    """Every rig is off by the root of the variance: other factors of the same variance cost more.

    But for the three digits of a factor: half a percent each, in cost and in the variance's root.
    """
    names = ("a", "b", "c")
    causes = {n: normal(v**0.5, cost=c) for n, v, c in zip(names, variances, costs, strict=True)}

    def sizes(factors: Mapping[str, float], rows: Floats) -> Floats:
        parts = [v * factors[name] ** 2 for name, v in zip(names, variances, strict=True)]
        return np.full(len(rows), np.sqrt(np.sum(parts)))

    shares = {name: v / sum(variances) for name, v in zip(names, variances, strict=True)}
    shares = dict.fromkeys(names, 0.0) | shares
    found = find_tolerances(file_of(causes), Bound(most_mm=0.1), shares, sizes)
    factors = np.array([cause.factor for cause in found.causes], dtype=float)
    assert found.by_cost
    others = np.random.default_rng(seed).uniform(0.2, 5.0, (200, 3)) * factors
    others *= np.sqrt(factors**2 @ variances / (others**2 @ variances))[:, np.newaxis]
    cost, other_costs = np.sum(costs / factors), np.sum(costs / others, axis=1)
    assert (cost <= 1.01 * other_costs).all()


def test_causes_of_a_group_have_one_factor_and_add_their_costs() -> None:
    """8 against 3 + 5 at the same share: all the same; 8 against 1: twice, the cube root."""
    causes = {
        "a": normal(1.0, cost=3, group="pose"),
        "b": normal(1.0, cost=5, group="pose"),
        "c": normal(1.0, cost=8),
        "d": normal(1.0, cost=1),
    }
    found = tolerances_of(LinearRigs(file_of(causes)), 0.1, pose=0.25, c=0.25, d=0.25)
    a, b, c, d = (cause.factor or 0.0 for cause in found.causes)
    assert a == b == c
    assert c / d == pytest.approx(2.0, rel=0.01)  # three digits


def test_the_document_of_tighter_causes_is_that_of_their_distributions() -> None:
    causes = {
        "port": {"key": "port.gap_mm", "when": "as-built", "uniform": [9.0, 11.0], "cost": 3.0},
        "noise": NOISE,
    }
    study = study_with(causes)
    tight = with_spreads(study.file, study.document, {"port": 0.25})
    assert study.document["cause"]["port"]["uniform"] == [9.0, 11.0]
    port = check(StudyFile, tight, where="study").cause["port"]
    assert port == study.file.cause["port"].model_copy(update={"uniform": (9.75, 10.25)})
    assert {**tight, "cause": None} == {**study.document, "cause": None}


def test_a_field_is_as_large_as_its_rms_and_a_scalar_as_its_absolute_value() -> None:
    outputs = (Output("height", "mm", 2), Output("level", "mm"), Output("turn", "deg"))
    values = np.array([[3.0, -4.0, -2.0, 1.0], [np.nan] * 4])
    results = Results(values, ("ok", "lost"))
    assert sizes_of(results, outputs, "height").tolist() == [12.5**0.5, np.inf]
    assert sizes_of(results, outputs, "level").tolist() == [2.0, np.inf]
    assert bounded_output(Bound(output="level"), outputs, "study") == outputs[1]
    for name in ("turn", "hight"):
        with pytest.raises(InputError, match="tolerances"):
            bounded_output(Bound(output=name), outputs, "study")


@pytest.mark.slow
def test_a_study_finds_its_tolerances_and_goes_on_with_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Few rigs of the geometric tier; the second time none is run again, with the same result."""
    monkeypatch.setattr(running, "prepare", lambda _: known_of())
    monkeypatch.setattr(module, "RIGS", 16)
    monkeypatch.setattr(module, "FRESH", 4)
    file = tmp_path / "study.toml"
    file.write_text(
        """calibrate = "best/board"
        scan = "best/sandwave"
        [cause.board]
        key = "calibrate.target.position_mm.1"
        when = "as-built"
        normal = [0, 1]
        [precision]
        base = 16
        most = 16
        alone = 16
        [places]
        pictures = 4
        columns = 80
        [tolerances]
        most_mm = 0.1
        """
    )
    with pytest.raises(InputError, match="too many runs"):  # theirs are counted in
        run_study(file, tmp_path / "out", StudyOptions("none", at_most=module.MOST_RUNS))
    found = run_study(file, tmp_path / "out", StudyOptions("none"))
    assert found.tolerances is not None
    (board,) = found.tolerances.causes
    assert board.factor is not None
    assert found.tolerances.allowed_mm is not None
    assert CLOSE * 0.1 <= found.tolerances.allowed_mm <= 0.1
    assert len(list((tmp_path / "out" / "tolerances").iterdir())) <= STEPS + 2
    assert tolerance_sentence(found.tolerances) in (tmp_path / "out" / "report.html").read_text()
    assert load_results(tmp_path / "out").tolerances == found.tolerances

    def evaluate(*_: object) -> None:
        raise AssertionError("a run is there already")

    monkeypatch.setattr(running, "evaluate_rows", evaluate)
    again = run_study(file, tmp_path / "out", StudyOptions("none", resume=True))
    assert again.tolerances == found.tolerances
