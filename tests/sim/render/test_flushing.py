"""Numbers below 1e-38: 0 where light is worked out, themselves elsewhere."""

import numpy as np
import pytest

from sim.render.ambient import Interpolation, SurfaceNodes
from sim.render.backend import CAN_FLUSH, flushing

pytestmark = pytest.mark.skipif(not CAN_FLUSH, reason="Linux on x86-64 alone")


def faint() -> bool:
    """Whether a product below the least normal number of 32 bits, 1.2e-38, is not 0."""
    return bool((np.full(4, 1e-30, np.float32) * np.float32(1e-10) != 0).all())


def test_faint_numbers_are_zero_within_the_block_alone() -> None:
    with flushing():
        assert not faint()
        with flushing(False):
            assert faint()
        assert not faint()
    assert faint()


def test_the_block_ends_with_an_error() -> None:
    with pytest.raises(KeyError), flushing():
        raise KeyError
    assert faint()


def test_samples_are_found_among_places_at_zero() -> None:
    """Where the tree's cut beside 0 becomes 0, it never ends: the process dies."""
    place = np.zeros((40, 3))
    place[20:, 0] = np.arange(20)
    upright = np.tile([0.0, 0.0, 1.0], (40, 1))
    each = np.arange(40)
    nodes = SurfaceNodes(place, place, upright, np.zeros(40, int), np.ones(40, bool))
    with flushing():
        near = Interpolation(nodes, each, each).near
    assert near.shape == (40, 8)
