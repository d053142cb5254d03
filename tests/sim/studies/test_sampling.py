"""The rows of a study."""

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st

from lscan.errors import InputError
from sim.studies.problem import AGAIN, ALL, BASE, SETS, Design, alone, make_design, mixed_block

CAUSES = ("shift", "tilt", "salt", "shake")
GROUPS = {"sheet": ("shift", "tilt"), "salt": ("salt",)}  # nobody asks for the shake

sizes = st.integers(0, 12).map(lambda points: SETS * points)


def drawn(base: int, apart: int, seed: int = 0) -> Design:
    return make_design(CAUSES, base, apart, seed, GROUPS)


@examples(30)
@given(base=sizes, more=sizes, apart=sizes, apart_more=sizes, seed=st.integers(0, 2**32))
def test_a_greater_design_begins_with_the_smaller(
    base: int, more: int, apart: int, apart_more: int, seed: int
) -> None:
    """So a study that grows repeats no run: a row is known by its block and its place there."""
    small, great = drawn(base, apart, seed), drawn(base + more, apart + apart_more, seed)
    assert list(small.blocks) == list(great.blocks)
    rows = dict(zip(great.labels, great.rows, strict=True))
    for label, row in zip(small.labels, small.rows, strict=True):
        np.testing.assert_array_equal(row, rows[label])


@examples(30)
@given(base=sizes, apart=sizes, seed=st.integers(0, 2**32))
def test_results_return_to_their_blocks(base: int, apart: int, seed: int) -> None:
    design = drawn(base, apart, seed)
    assert len(design.rows) == len(design.labels) == 1 + 2 * apart + 4 * base
    for name, rows in design.split(design.rows).items():
        np.testing.assert_array_equal(rows, design.blocks[name])


def test_each_block_has_its_causes_at_work() -> None:
    blocks = drawn(32, 16).blocks
    at_work = {name: ~np.isnan(rows) for name, rows in blocks.items()}
    assert not at_work[BASE].any() and len(blocks[BASE]) == 1
    expected = {
        alone("sheet"): [True, True, False, False],
        alone("salt"): [False, False, True, False],
        **{
            name: [True] * 3 + [False]
            for name in (ALL, AGAIN, mixed_block("sheet"), mixed_block("salt"))
        },
    }
    for name, mask in expected.items():
        assert (at_work[name] == mask).all()


def test_a_mixed_block_takes_one_group_from_the_second_draw() -> None:
    blocks = drawn(32, 16).blocks
    first, again = blocks[ALL], blocks[AGAIN]
    np.testing.assert_array_equal(blocks[mixed_block("sheet")][:, :2], again[:, :2])
    np.testing.assert_array_equal(blocks[mixed_block("sheet")][:, 2:], first[:, 2:])
    np.testing.assert_array_equal(blocks[mixed_block("salt")][:, 2], again[:, 2])
    np.testing.assert_array_equal(blocks[mixed_block("salt")][:, :2], first[:, :2])
    assert (first[:, :3] != again[:, :3]).all()


def test_the_points_of_each_set_are_even_and_no_number_has_an_infinite_quantile() -> None:
    """Of a scrambled Sobol' sequence, one point lies in each of 2^k equal parts of each cause."""
    points = 16
    numbers = make_design(CAUSES, SETS * points, 0, seed=3).blocks[ALL]
    assert (numbers > 0).all() and (numbers < 1).all()
    parts = np.sort(np.floor(numbers * points).reshape(points, SETS, -1), axis=0)
    assert (parts == np.arange(points)[:, None, None]).all()
    assert len(np.unique(numbers[:SETS], axis=0)) == SETS  # no two sets are the same


def test_another_seed_draws_other_rows() -> None:
    assert (drawn(32, 16, 0).blocks[ALL][:, :3] != drawn(32, 16, 1).blocks[ALL][:, :3]).all()


def test_what_is_no_design_is_refused() -> None:
    with pytest.raises(InputError, match="base is 100, must be a multiple of 16"):
        drawn(100, 16)
    with pytest.raises(InputError, match="apart is -16"):
        drawn(16, -16)
    with pytest.raises(InputError, match="colour is no cause"):
        make_design(CAUSES, 16, 16, 0, {"light": ("colour",)})
    with pytest.raises(InputError, match="salt is in two groups"):
        make_design(CAUSES, 16, 16, 0, {"water": ("salt",), "sea": ("salt", "tilt")})
    with pytest.raises(InputError, match="water has no causes"):
        make_design(CAUSES, 16, 16, 0, {"water": ()})
