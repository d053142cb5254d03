"""The plane that the most lines agree on: half of them wrong, in any order."""

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st

from lscan.calibration.metric.sheet import Agreement, agreed_plane
from lscan.errors import MeasurementError
from lscan.records import Floats

LENGTH_MM, DEPTH_MM = 120.0, 900.0


def lines(rng: np.random.Generator, right: int, wrong: int, noise_mm: float = 0.1) -> Floats:
    """(V, 2, 3) ends of lines in a leaning plane, and of others up to half a line off it."""
    count = right + wrong
    middle = np.column_stack([rng.uniform(-150, 150, (count, 2)), np.zeros(count)])
    turn = rng.uniform(0, np.pi, count)
    along = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(count)])
    ends = middle[:, None] + np.array([[-0.5], [0.5]]) * LENGTH_MM * along[:, None]
    ends[..., 2] = DEPTH_MM + 0.4 * ends[..., 1]
    ends[:right, :, 2] += rng.normal(0, noise_mm, (right, 2))
    ends[right:, :, 2] += rng.uniform(-LENGTH_MM / 2, LENGTH_MM / 2, (wrong, 2))
    return ends


def off_mm(agreement: Agreement) -> float:
    """How far the plane lies from the true one within 200 mm of the axis."""
    x, y = np.meshgrid([-200.0, 0.0, 200.0], [-200.0, 0.0, 200.0])
    points = np.column_stack([x.ravel(), y.ravel(), DEPTH_MM + 0.4 * y.ravel()])
    q = agreement.q_per_mm
    return float(np.abs((points @ q - 1) / np.linalg.norm(q)).max())


@examples(30)
@given(seed=st.integers(0, 2**32 - 1), right=st.integers(5, 9))
def test_half_of_the_lines_may_be_wrong(seed: int, right: int) -> None:
    """A wrong line lies within 5 sigma, 0.5 mm of 60, at both its ends once in 14,000.

    The start must lie where the gates see which lines are right: within 1 mm, a tenth of the
    noise's reach short of the wrong lines' tens of millimetres.
    """
    rng = np.random.default_rng(seed)
    found = agreed_plane(lines(rng, right, right))
    assert found.agree[:right].sum() >= 3
    near = found.off_mm[right:] < 1.0
    assert not found.agree[right:][~near].any()
    assert off_mm(found) < 1.0
    assert found.by_chance < 1e-3


@examples(20)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_order_of_the_lines_does_not_matter(seed: int) -> None:
    rng = np.random.default_rng(seed)
    ends, order = lines(rng, 7, 5), rng.permutation(12)
    one, two = agreed_plane(ends), agreed_plane(ends[order])
    np.testing.assert_allclose(one.q_per_mm, two.q_per_mm, rtol=1e-9)
    np.testing.assert_array_equal(one.agree[order], two.agree)


def test_many_lines_are_tried_in_a_drawn_part_of_their_pairs_in_any_order() -> None:
    rng = np.random.default_rng(3)
    ends, order = lines(rng, 50, 50), rng.permutation(100)  # 4950 pairs
    one, two = agreed_plane(ends), agreed_plane(ends[order])
    np.testing.assert_allclose(one.q_per_mm, two.q_per_mm, rtol=1e-9)
    assert off_mm(one) < 0.5


def test_lines_at_random_agree_no_better_than_by_chance() -> None:
    """Of 40 draws of eight lines that have no plane, none counts: 1e-3 is allowed of each."""
    rng = np.random.default_rng(4)
    assert min(agreed_plane(lines(rng, 0, 8)).by_chance for _ in range(40)) > 1e-3


def test_planes_through_the_pinhole_are_none() -> None:
    ends = np.array(
        [[[x, 0.0, z], [x + 50.0, 0.0, z + 20.0]] for x, z in ((0.0, 900.0), (5.0, 800.0))]
    )
    with pytest.raises(MeasurementError, match="no plane before the camera"):
        agreed_plane(ends)
