"""The light of a line's core, whatever lies beside it."""

import numpy as np
from drawn_examples import examples
from hypothesis import given, strategies as st
from lines_drawn import drawn

from lscan.records import Status, Stripe
from lscan.stripe.peaks import BESIDE_CORE_PX, CORE_PX, core_flux

HEIGHT, WIDTH = 60, 40
WIDTH_PX = 1.0
FEW = examples(20)


def stripe(centre, status=Status.OK):
    """A stripe at ``centre`` (W,) with one status."""
    nought = np.zeros(len(centre))
    return Stripe("columns", centre, nought, nought, np.full(len(centre), int(status)))


def line(centre):
    """(W, H) light of one line, a row for each column of the picture."""
    return np.ascontiguousarray(drawn(centre, WIDTH_PX, HEIGHT).T)


@FEW
@given(st.floats(20, 40), st.floats(-50, 50), st.floats(0.1, 10))
def test_even_ground_and_brightness_change_nothing_but_the_scale(row, ground, factor):
    centre = np.full(WIDTH, row)
    light = line(centre)
    one = core_flux(stripe(centre), light)
    other = core_flux(stripe(centre), factor * light + ground)
    np.testing.assert_allclose(other, factor * one, rtol=1e-9)


@FEW
@given(st.integers(20, 40), st.floats(-2, 2), st.floats(0, 20))
def test_sloping_ground_and_a_wall_from_the_line_downwards_change_nothing(row, slope, wall):
    """Ground that is odd about the line: half of the core, one of the sides."""
    centre = np.full(WIDTH, float(row))
    light = line(centre)
    place = np.arange(HEIGHT) - row
    odd = slope * place + wall * (np.sign(place) + 1) / 2
    np.testing.assert_allclose(
        core_flux(stripe(centre), light + odd), core_flux(stripe(centre), light), rtol=1e-9
    )


def test_it_is_the_light_between_the_core_s_bounds():
    """Of a line of 1 px the core holds its pixels' sum, and the ground but 1e-3 of its height."""
    centre = np.full(WIDTH, 30.0)
    light = line(centre)
    core = light[:, 30 - CORE_PX : 30 + CORE_PX + 1].sum(axis=1)
    pixels = (2 * CORE_PX + 1) * light[0, 30 + BESIDE_CORE_PX[0]]
    np.testing.assert_allclose(core_flux(stripe(centre), light), core, atol=pixels)


def test_no_line_no_light_and_a_border_are_no_number_or_a_finite_one():
    centre = np.full(WIDTH, 30.0)
    none = stripe(np.full(WIDTH, np.nan), Status.NO_PEAK)
    assert np.isnan(core_flux(none, line(centre))).all()
    assert np.isnan(core_flux(stripe(centre), np.zeros((WIDTH, HEIGHT)))).all()
    edge = np.full(WIDTH, 1.0)
    assert np.isfinite(core_flux(stripe(edge), line(edge))).all()
