"""Sobol' indices with their intervals, against closed forms and under what must not matter."""

from dataclasses import replace

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from SALib.analyze import sobol

from lscan.records import Floats
from sim.studies.problem import (
    AGAIN,
    ALL,
    SETS,
    Bounded,
    Design,
    Indices,
    Output,
    alone,
    interval,
    make_design,
    mixed_block,
    moments,
    next_base,
    sobol_indices,
)
from tests.validation.studies.coverage import ClosedForm, ishigami, sobol_g

BASE = 512


def field(places: int) -> tuple[Output, ...]:
    return (Output("error", "mm", places),)


def of(design: Design, values: Floats) -> Indices:
    (found,) = sobol_indices(design, values, field(values.shape[1])).values()
    return found


def table(found: Indices) -> Floats:
    """(G, 6) of each group both indices and their bounds."""
    return np.array(
        [
            [
                x
                for index in (group.first, group.total)
                for x in (index.value, index.low, index.high)
            ]
            for group in found.groups.values()
        ]
    )


def holds(found: Bounded, truth: float) -> bool:
    """Whether the truth is within 2.2 half-widths: 4.7 standard errors, beyond which Student's t
    with 15 degrees of freedom is once in 3,500 times; some 40 comparisons are made here, so that
    one in a hundred seeds would break one of them."""
    return abs(found.value - truth) <= 2.2 * found.half_width


@pytest.fixture(scope="module")
def design() -> Design:
    return make_design(ishigami().causes, BASE, 64, seed=1)


@pytest.fixture(scope="module")
def values(design: Design) -> Floats:
    return ishigami().evaluate(design.rows)


@pytest.mark.parametrize("problem", [ishigami(), sobol_g()], ids=lambda problem: problem.name)
def test_indices_are_those_of_the_closed_form(problem: ClosedForm) -> None:
    """Ishigami: V1 = (1 + b pi⁴ / 5)² / 2, V2 = a² / 8, V13 = b² pi⁸ (1/18 - 1/50) (Ishigami &
    Homma 1990).  G: Vi = 1 / 3 (1 + ai)², V = prod(1 + Vi) - 1, total Vi prod(1 + Vj, j != i)
    (Saltelli & Sobol' 1995)."""
    rows = make_design(problem.causes, 2048, 0, seed=4)
    found = of(rows, problem.evaluate(rows.rows))
    for cause, group in found.groups.items():
        assert holds(group.first, problem.first[cause])
        assert holds(group.total, problem.total[cause])
        # The three largest half-widths, of 2048 rigs, are below those asked for of 0.05.
        assert max(group.first.half_width, group.total.half_width) < 0.05
    assert holds(found.rest, 1 - sum(problem.first.values()))
    assert holds(found.moments.mean, problem.mean)
    assert holds(found.moments.variance, problem.variance)
    assert found.note == "" and found.failed == 0 and found.base == 2048


def test_indices_agree_with_those_of_salib(design: Design, values: Floats) -> None:
    """Another estimator on the same runs: both are off by no more than their intervals."""
    blocks = design.split(values[:, 0])
    order = [blocks[ALL], *(blocks[mixed_block(cause)] for cause in design.groups), blocks[AGAIN]]
    problem = {"num_vars": 3, "names": list(design.groups), "bounds": [[0, 1]] * 3}
    other = sobol.analyze(problem, np.stack(order, axis=1).ravel(), calc_second_order=False, seed=1)
    for k, group in enumerate(of(design, values).groups.values()):
        for index, kind in ((group.first, "S1"), (group.total, "ST")):
            reach = index.half_width + other[f"{kind}_conf"][k]
            assert abs(index.value - other[kind][k]) < reach


@examples(20)
@given(scale=st.floats(1e-6, 1e6) | st.floats(-1e6, -1e-6), shift=st.floats(-1e3, 1e3))
def test_the_unit_and_the_zero_of_an_error_do_not_matter(scale: float, shift: float) -> None:
    """Shifted by 1000 standard deviations or so, squares lose six of 16 digits."""
    design = make_design(ishigami().causes, 64, 0, seed=1)
    values = ishigami().evaluate(design.rows)
    found = of(design, scale * (values + shift))
    np.testing.assert_allclose(table(found), table(of(design, values)), rtol=1e-6, atol=1e-8)


def test_a_field_of_one_error_everywhere_has_its_indices(design: Design, values: Floats) -> None:
    scalar, wide = of(design, values), of(design, np.repeat(values, 5, axis=1))
    np.testing.assert_allclose(table(wide), table(scalar), rtol=1e-9, atol=1e-12)
    for name in ("mean", "systematic", "variance", "mean_square"):
        one, other = getattr(scalar.moments, name), getattr(wide.moments, name)
        assert (other.value, other.low) == pytest.approx((one.value, one.low))


def test_a_dead_place_takes_no_part(design: Design, values: Floats) -> None:
    """Its share of the mean over places is nothing: the variance halves, the indices stay."""
    dead = np.full_like(values, 3.7)
    scalar, half = of(design, values), of(design, np.hstack([values, dead]))
    np.testing.assert_allclose(table(half), table(scalar), rtol=1e-9, atol=1e-12)
    assert half.moments.variance.value == pytest.approx(scalar.moments.variance.value / 2)


def test_a_field_weights_its_places_by_their_variance(design: Design) -> None:
    """Place one follows x1 and place two x2, of four times its variance: shares 1/5 and 4/5."""
    x = design.rows
    found = of(design, np.where(np.isnan(x), 0.5, x)[:, :2] * [1, 2])
    for cause, share in (("x1", 0.2), ("x2", 0.8), ("x3", 0.0)):
        group = found.groups[cause]
        assert holds(group.first, share) and group.first.half_width < 0.05
        assert holds(group.total, share) and group.total.half_width < 0.05
    # What does nothing is told exactly.
    assert found.groups["x3"].first == found.groups["x3"].total == Bounded(0, 0, 0)


def test_causes_in_a_group_are_counted_together() -> None:
    """x1 and x3 of Ishigami's function act together alone: as one group nothing interacts."""
    problem = ishigami()
    design = make_design(problem.causes, BASE, 0, 1, {"both": ("x1", "x3"), "x2": ("x2",)})
    found = of(design, problem.evaluate(design.rows))
    for index in (found.groups["both"].first, found.groups["both"].total):
        assert holds(index, 1 - problem.first["x2"])
    assert holds(found.rest, 0)


def test_an_interval_is_that_of_students_t() -> None:
    """Of 16 values: 2.13145 standard errors of their mean, on either side; a gap does not count."""
    values = np.append(np.arange(16.0), np.nan)
    found, error = interval(values), np.sqrt(16 * 17 / 12) / 4
    assert (found.value, found.half_width) == pytest.approx((7.5, 2.13145 * error), rel=1e-5)


def test_moments_add_up(design: Design, values: Floats) -> None:
    found = of(design, np.hstack([values, -values, 2 * values])).moments
    assert found.mean_square.value == pytest.approx(found.systematic.value + found.variance.value)
    assert found.mean.value == pytest.approx(3.5 * 2 / 3, abs=0.2)
    assert found.systematic.value == pytest.approx(3.5**2 * 2, rel=0.1)


def test_the_moments_of_a_cause_alone(design: Design, values: Floats) -> None:
    """x2 alone: a sin² x2, of mean a / 2 and variance a² / 8; x3 alone does nothing, at the
    median of x1."""
    blocks = design.split(values)
    found = {group: moments(blocks[alone(group)]) for group in ("x2", "x3")}
    assert holds(found["x2"].mean, 3.5)
    assert holds(found["x2"].variance, 49 / 8)
    assert found["x3"].mean_square == Bounded(0, 0, 0)


def test_failed_runs_are_left_out_where_they_count(design: Design, values: Floats) -> None:
    """5 % of all runs, whichever: less than the note's bar is told without one."""
    rng = np.random.default_rng(2)
    broken = values.copy()
    broken[rng.choice(len(values), int(0.049 * len(values)), replace=False)] = np.nan
    whole, found = of(design, values), of(design, broken)
    blocks = design.split(broken[:, 0])
    assert found.failed == sum(
        int(np.isnan(blocks[name]).sum()) for name in (ALL, AGAIN, *map(mixed_block, design.groups))
    )
    for cause, group in found.groups.items():
        three = np.stack([blocks[ALL], blocks[AGAIN], blocks[mixed_block(cause)]])
        assert group.used == np.isfinite(three).all(axis=0).sum() < BASE
        for kind in ("first", "total"):
            before = getattr(whole.groups[cause], kind)
            assert before.low < getattr(group, kind).value < before.high


def test_a_failed_place_is_a_failed_run(design: Design, values: Floats) -> None:
    broken = np.hstack([values, values])
    broken[-1, 0] = np.nan  # in the last block, of x3
    found = of(design, broken)
    assert [group.used for group in found.groups.values()] == [BASE, BASE, BASE - 1]
    assert found.failed == 1 and found.note == ""


def test_a_note_says_where_too_many_runs_failed(design: Design, values: Floats) -> None:
    broken = values.copy()
    broken[-len(values) // 10 :] = np.nan
    found = of(design, broken)
    assert found.note.startswith(f"{found.failed} of {5 * BASE} runs failed")


def test_what_does_not_vary_and_what_always_fails_have_no_indices(
    design: Design, values: Floats
) -> None:
    still = of(design, np.full_like(values, 0.1))
    assert "does not vary" in still.note and np.isnan(table(still)).all()
    assert still.moments.mean.value == pytest.approx(0.1)
    gone = of(design, np.full_like(values, np.nan))
    assert gone.note == "every run failed" and np.isnan(table(gone)).all()
    assert np.isnan(gone.moments.variance.value)
    assert next_base([still, gone], 0.01, BASE) is None


@examples(50)
@given(width=st.floats(1e-3, 10), wanted=st.floats(1e-3, 1), sets=st.integers(1, 1000))
def test_the_next_base_is_a_power_of_two_in_reach(width: float, wanted: float, sets: int) -> None:
    bounded = Bounded(0.5, 0.5 - width, 0.5 + width)
    design = make_design(("x",), 16, 0, 0)
    found = of(design, design.rows)
    group = replace(found.groups["x"], first=bounded)
    after = next_base([replace(found, groups={"x": group})], wanted, SETS * sets)
    if after is None:
        assert bounded.half_width <= wanted
    else:
        assert np.log2(after / SETS).is_integer() and SETS * sets < after < 8 * SETS * sets
        assert after >= min((width * 0.999 / wanted) ** 2, 4) * SETS * sets
