"""Neighbours on the grid of a board's nodes."""

import numpy as np
from hypothesis import given, strategies as st

from lscan.board.search import moved


@given(
    shape=st.tuples(st.integers(0, 5), st.integers(0, 5)),
    shift=st.tuples(st.integers(-7, 7), st.integers(-7, 7)),
    of_each=st.sampled_from([(), (2,)]),
)
def test_each_node_holds_what_is_so_many_rows_and_columns_away(
    shape: tuple[int, int], shift: tuple[int, int], of_each: tuple[int, ...]
) -> None:
    values = np.random.default_rng(1).normal(size=shape + of_each)
    expected = np.full(values.shape, np.nan)
    for row, column in np.ndindex(*shape):
        there = row + shift[0], column + shift[1]
        if 0 <= there[0] < shape[0] and 0 <= there[1] < shape[1]:
            expected[row, column] = values[there]
    np.testing.assert_array_equal(moved(values, *shift), expected)
