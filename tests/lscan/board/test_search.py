"""Neighbours on the grid of a board's nodes."""

import numpy as np
from hypothesis import given, strategies as st

from lscan.board.picture import Centres
from lscan.board.search import Nodes, seed_nodes, shift_by, spread
from lscan.records import Floats, Mask


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
    np.testing.assert_array_equal(shift_by(values, *shift), expected)


def test_each_dot_belongs_to_one_node() -> None:
    """Rows that stray at the rim run back over the board: 9 by 9 dots on 41 by 41 nodes are 81."""
    dots = 20.0 * np.stack(np.meshgrid(np.arange(9), np.arange(9)), axis=-1).reshape(-1, 2)
    nodes = Nodes.empty(41, 41)
    where, _ = seed_nodes((20, 20), dots[[40, 49, 41]])

    def seen(points: Floats) -> Centres:
        return Centres(points, *np.ones((2, len(points))), np.ones(len(points), bool))

    def nearest(expected: Floats, pitch: Floats, beside: Floats) -> tuple[Centres, Mask]:
        apart = np.linalg.norm(expected[:, None] - dots, axis=2)
        return seen(dots[apart.argmin(axis=1)]), np.ones(len(expected), bool)

    nodes.put(where, seen(dots[[40, 49, 41]]), np.ones(3, bool))
    spread(nodes, nearest, box=0.22)
    found = nodes.points[nodes.found]
    assert nodes.found[16:25, 16:25].all() and len(found) == 81
    np.testing.assert_array_equal(np.unique(found, axis=0), np.unique(dots, axis=0))
