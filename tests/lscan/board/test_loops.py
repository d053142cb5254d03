"""The compiled loops over marks give what the same lines give as Python."""

from typing import Any

import numpy as np
import pytest

from lscan.board import loops

RNG = np.random.default_rng(59)
GREY = RNG.normal(0, 30, (24, 30)).astype(np.float32)
POINTS = RNG.uniform(0, 24, (40, 2))
NODES = np.where(RNG.random((5, 6, 2)) < 0.2, np.nan, RNG.uniform(0, 24, (5, 6, 2)))
WIDTHS, FEW = np.array([1.1, 1.9, 0.9, 1.4]), np.array([[0, 0], [23, 20], [29, 3], [12, 30]])
STEPS = np.array([(0, 1, 0, 1, 0, 2), (1, 0, 0, -1, 1, -1)])
NEAREST = RNG.integers(0, 40, (4, 12))
ARGUMENTS: dict[str, tuple[Any, ...]] = {
    "fit_marks": (GREY, abs(GREY), FEW + 0.4, WIDTHS, np.array([6, 9, 5, 7]), 4, False),
    "brightest": (GREY, FEW, np.array([2, 3, 1, 40])),
    "means_of_known": (NODES, STEPS),
    "round_peaks": (GREY, -GREY, 5.0, 4.0),
    "crosses": (POINTS, 1.5, 9.0, 7, 0.5),
    "noise_by_level": (GREY, np.array([-20.0, 0.0, 30.0]), np.array([4.0, 9.0, 2.0]), 3.0),
    "local_polynomials": (POINTS, POINTS**2, NEAREST, POINTS[:4], 5.0),
    "disc_shifts": (RNG.random((3, 2, 2)), RNG.random((3, 2, 2, 2)), np.ones(3), np.ones(3)),
}


@pytest.mark.parametrize("name", ARGUMENTS)
def test_a_loop_gives_what_it_gives_as_python(name: str) -> None:
    loop, arguments = getattr(loops, name), ARGUMENTS[name]
    found, expected = (some(*arguments) for some in (loop, getattr(loop, "py_func", loop)))
    several = isinstance(found, tuple)
    for one, other in zip(
        found if several else [found], expected if several else [expected], strict=True
    ):
        np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-9)
