"""The Cramér-Rao bound against its closed forms."""

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st

from lscan.stripe.fit import centre_bound_px, lines
from lscan.stripe.picture import Noise

# A pixel turns a Gaussian of width w into very nearly one of width sqrt(w² + 1/12): what is
# left is of fourth order, under 1/(120 · 12 w⁴) of it: 3e-4 at 1.2 px.
FOURTH_ORDER = 1e-3


@examples(40)
@given(width=st.floats(1.2, 6.0), ratio=st.floats(5, 500), phase=st.floats(-0.5, 0.5))
def test_additive_noise_gives_the_closed_form(width, ratio, phase):
    # (sigma_n / A) sqrt(2 w / sqrt(pi)), docs/explanation/physics.md, section 4; the height sinks
    # as the width grows.
    seen = np.sqrt(width**2 + 1 / 12)
    closed = seen / width / ratio * np.sqrt(2 * seen / np.sqrt(np.pi))
    bound = centre_bound_px(width, 100.0, Noise((100.0 / ratio) ** 2, 0.0), phase)
    np.testing.assert_allclose(bound, closed, rtol=FOURTH_ORDER)


@examples(40)
@given(width=st.floats(1.2, 6.0), gain=st.floats(0.01, 2.0), phase=st.floats(-0.5, 0.5))
def test_shot_noise_gives_the_width_over_the_root_of_the_electrons(width, gain, phase):
    electrons = 100.0 * width * np.sqrt(2 * np.pi) / gain
    # The reading noise only keeps the far pixels' weights finite.
    bound = centre_bound_px(width, 100.0, Noise(1e-12, gain), phase)
    np.testing.assert_allclose(bound, np.sqrt((width**2 + 1 / 12) / electrons), rtol=FOURTH_ORDER)


@examples(40)
@given(
    width=st.floats(0.6, 5.0),
    read=st.floats(0.1, 5.0),
    gain=st.floats(0.0, 1.0),
    more=st.floats(1.01, 3.0),
)
def test_the_bound_rises_with_every_noise_and_falls_with_more_pixels(width, read, gain, more):
    least = centre_bound_px(width, 100.0, Noise(read**2, gain))
    assert centre_bound_px(width, 100.0, Noise(more * read**2, gain)) > least
    assert centre_bound_px(width, 100.0, Noise(read**2, more * gain + 0.1)) > least
    assert centre_bound_px(width, 100.0, Noise(read**2, gain, 0.2)) > least
    few = int(np.ceil(2 * width)) + 1
    assert centre_bound_px(width, 100.0, Noise(read**2, gain), reach_px=few) >= least


def test_the_bound_is_of_the_shape_of_its_arguments():
    noise = Noise(1.0, 0.1)
    both = centre_bound_px(np.array([1.0, 2.0]), 100.0, noise)
    assert both.shape == (2,)
    # The wider line's reach holds for both; more pixels add nothing on the narrow one.
    assert both[0] == pytest.approx(centre_bound_px(1.0, 100.0, noise)[0], rel=1e-9)


@examples(40)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_models_jacobian_is_its_derivatives(seed):
    rng = np.random.default_rng(seed)
    ranges = [(-1.0, 1.0), np.log([0.5, 6.0]), np.log([5.0, 500.0]), (-20, 50), (-1, 1)]
    parameters = np.array([[rng.uniform(*ends) for ends in ranges]])
    steps = np.arange(-20.0, 21.0)
    jacobian = lines(parameters, steps).jacobian[0]
    step = 1e-5
    for index in range(5):
        ends = []
        for sign in (1, -1):
            moved = parameters.copy()
            moved[0, index] += sign * step
            model = lines(moved, steps)
            ends.append((model.light + model.ground)[0])
        # Central differences err by step² / 6 of a third derivative, below 1e4 DN here, and
        # by rounding, 1e-13 · 1e3 / step.
        np.testing.assert_allclose(jacobian[index], (ends[0] - ends[1]) / (2 * step), atol=1e-5)
