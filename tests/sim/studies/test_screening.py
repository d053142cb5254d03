"""Morris screening."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from SALib.analyze import morris

from lscan.records import Floats
from sim.studies.problem import Output
from sim.studies.screening import LEVELS, LOWEST, effects, screening_rows
from sim.studies.testfunctions import sobol_g

CAUSES = ("a", "b", "c", "d")
EACH = {cause: (cause,) for cause in CAUSES}
GROUPS = {"left": ("a", "d"), "b": ("b",), "c": ("c",)}
SCALAR = (Output("error", "mm"),)


@settings(max_examples=15, deadline=None)
@given(trajectories=st.integers(1, 6), more=st.integers(0, 6), seed=st.integers(0, 2**32))
def test_each_step_is_that_of_one_group(trajectories: int, more: int, seed: int) -> None:
    rows = screening_rows(CAUSES, trajectories, seed, GROUPS)
    assert rows.shape == (trajectories, len(GROUPS) + 1, len(CAUSES))
    levels = (rows - LOWEST) * LEVELS
    np.testing.assert_allclose(levels, np.clip(np.round(levels), 0, LEVELS - 1), atol=1e-12)
    for trajectory in rows:
        moved = [tuple(np.flatnonzero(step)) for step in np.diff(trajectory, axis=0)]
        assert sorted(moved) == [(0, 3), (1,), (2,)]
    greater = screening_rows(CAUSES, trajectories + more, seed, GROUPS)
    np.testing.assert_array_equal(greater[:trajectories], rows)


def test_effects_are_those_of_salib() -> None:
    problem = sobol_g((0.0, 0.5, 3.0, 99.0))
    rows = screening_rows(CAUSES, 20, 1, EACH)
    values = problem.evaluate(rows)
    found = effects(rows, values, CAUSES, SCALAR, EACH)["error"]
    names = {"num_vars": 4, "names": list(CAUSES), "bounds": [[LOWEST, 1 - LOWEST]] * 4}
    other = morris.analyze(names, rows.reshape(-1, 4), values.ravel(), num_levels=LEVELS, seed=1)
    sizes = [effect.size.value for effect in found.values()]
    np.testing.assert_allclose(sizes, other["mu_star"], rtol=1e-12)
    np.testing.assert_allclose([e.spread for e in found.values()], other["sigma"], rtol=1e-12)
    # Its bootstrap of 100 resamples, of normal quantiles, against Student's interval.
    np.testing.assert_allclose(
        [effect.size.half_width for effect in found.values()], other["mu_star_conf"], rtol=0.4
    )


def line(rows: Floats) -> Floats:
    """Two places: at one a counts 3 and b 1, at the other a counts 4."""
    return np.stack([3 * rows[..., 0] + rows[..., 1], 4 * rows[..., 0]], axis=-1)


def test_a_linear_error_has_its_slopes_as_effects() -> None:
    """Over the way from the lowest to the highest level, 3/4; rms over the two places."""
    rows = screening_rows(CAUSES, 8, 2, EACH)
    found = effects(rows, line(rows), CAUSES, (Output("error", "mm", 2),), EACH)["error"]
    for cause, slope in {"a": 12.5**0.5, "b": 0.5**0.5, "c": 0.0}.items():
        effect = found[cause]
        assert effect.size.value == pytest.approx(0.75 * slope)
        assert effect.size.half_width == pytest.approx(0, abs=1e-9)
        assert effect.spread == pytest.approx(0, abs=1e-9)
        assert effect.used == 8


def test_a_failed_run_costs_the_two_steps_beside_it() -> None:
    rows = screening_rows(CAUSES, 8, 2, EACH)
    values = line(rows)
    values[0, 2] = np.nan
    found = effects(rows, values, CAUSES, (Output("error", "mm", 2),), EACH)["error"]
    assert sorted(effect.used for effect in found.values()) == [7, 7, 8, 8]
    values[:] = np.nan
    gone = effects(rows, values, CAUSES, (Output("error", "mm", 2),), EACH)["error"]
    assert all(np.isnan(effect.size.value) and effect.used == 0 for effect in gone.values())
