"""Ends of blurred, speckled tops, and what errs alike in the lengths between them."""

from dataclasses import replace

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from scipy.stats import norm

from lscan.config.targets import GroovedBlock
from lscan.measure import groove_dimensions
from lscan.measure.board import LengthBudget, mean_length
from lscan.measure.grooves import FALSE_LIGHT, PHASE, USUAL_BLUR, Segment, Trace, segment_ends
from lscan.records import Floats, PlanePoints, Profile, Status

PIECE = GroovedBlock()
PITCH_MM = 0.94
DARKEST = 0.08  # of a top's brightness: a threshold of 15 DN under a peak of 180


def top(left: float, right: float, blur: float, speckle: float, seed: int) -> Trace:
    """One top from ``left`` to ``right`` mm, its brightness blurred by ``blur`` columns."""
    x: Floats = (np.arange(80.0) - 10) * PITCH_MM
    lit = norm.cdf((x - left) / blur / PITCH_MM) * norm.cdf((right - x) / blur / PITCH_MM)
    shading = 180 * (1 + 0.002 * x)
    rng = np.random.default_rng(seed)
    peak = shading * lit * (1 + speckle * rng.normal(size=80))
    seen = np.flatnonzero(lit > DARKEST)
    x, peak = x[seen], peak[seen]
    nought = np.zeros_like(x)
    return Trace(x, nought, nought, nought + 0.01, peak, PITCH_MM, 0.0)


def ends(line: Trace) -> tuple[Floats, Floats]:
    """(2,) places and own uncertainties of the one segment's ends."""
    found = segment_ends(line, [Segment(np.arange(len(line.x)), 0.0)])[0]
    return np.array([e.x_mm for e in found]), np.array([e.own_mm for e in found])


@given(st.floats(0, PITCH_MM), st.floats(0.5, 1.5), st.floats(35, 45))
@examples(30)
def test_ends_without_noise_are_exact(left: float, blur: float, right: float) -> None:
    place, own = ends(top(left, right, blur, 0.0, 0))
    # The model is the one drawn: only the fit's weak priors pull, whose least standard deviation
    # p is that of the blur, and by at most (own / p)² of the p that the blur drawn is off.
    np.testing.assert_allclose(place, [left, right], atol=own.max() ** 2 / USUAL_BLUR / PITCH_MM)


@given(st.integers(-50, 50), st.integers(0, 30))
@examples(15)
def test_ends_move_with_the_top_and_scale_with_nothing_bright(shift: int, seed: int) -> None:
    one = top(0.3, 40.2, 0.8, 0.1, seed)
    here, sigma = ends(one)
    there, _ = ends(replace(one, x=one.x + shift, brightness=0.5 * one.brightness))
    np.testing.assert_allclose(there - shift, here, atol=0.02 * sigma.min())


def test_stated_uncertainty_of_an_end_is_its_scatter() -> None:
    """60 tops of one place with speckle of 0.15: their deviation is known to 9 %.

    The fit weighs by the noise drawn, but for UNMODELLED, which makes the stated uncertainty a
    little too large: no more than 3 * 9 % and that.
    """
    pairs = [ends(top(0.3, 40.2, 0.8, 0.15, seed)) for seed in range(60)]
    places, stated = np.array([p for p, _ in pairs]), np.array([s for _, s in pairs])
    ratio = places.std(axis=0, ddof=1) / np.sqrt((stated**2).mean(axis=0))
    assert (ratio > 0.65).all()
    assert (ratio < 1.27).all()
    # The bias of the mean of 60 is known to an eighth of the deviation.
    assert (np.abs(places.mean(axis=0) - [0.3, 40.2]) < 0.4 * stated.mean(axis=0)).all()


def test_a_sharp_end_is_half_a_column_out_to_within_one() -> None:
    one = top(0.3, 40.2, 0.8, 0.0, 0)
    level = replace(one, brightness=np.full_like(one.brightness, 180.0))
    found = segment_ends(level, [Segment(np.arange(len(level.x)), 0.0)])[0]
    assert found[0].x_mm == pytest.approx(level.x[0] - PITCH_MM / 2)
    assert found[1].x_mm == pytest.approx(level.x[-1] + PITCH_MM / 2)
    assert found[0].common_mm == pytest.approx(PITCH_MM / np.sqrt(12))


@pytest.mark.parametrize("false_light", [0.005, 0.01])
def test_false_light_moves_an_end_outwards_by_about_what_is_stated(false_light: float) -> None:
    """Half a percent or one of the brightness along the foot: about FALSE_LIGHT."""
    one = top(0.3, 40.2, 0.76, 0.0, 0)
    place, _ = ends(replace(one, brightness=one.brightness + false_light * 180))
    outwards = (place - [0.3, 40.2]) * [-1, 1] / PITCH_MM
    assert (outwards > 0).all()
    assert (outwards < 3 * FALSE_LIGHT).all()


@given(st.floats(0.5, 3.0), st.integers(0, 30))
@examples(15)
def test_more_speckle_is_never_stated_as_less(factor: float, seed: int) -> None:
    """The same draw of speckle, ``factor`` times as strong; a fit's own freedom leaves 5 %."""
    less, more = (ends(top(0.3, 40.2, 0.8, c, seed))[1] for c in (0.05, 0.05 * (1 + factor)))
    assert (more > 0.95 * less).all()


# Means


lengths = st.lists(st.tuples(st.floats(9.9, 10.1), st.floats(0.01, 0.1)), min_size=2, max_size=20)


@given(lengths, st.floats(0, 0.2))
@examples(50)
def test_a_mean_lies_among_its_values_and_keeps_what_is_common(
    pairs: list[tuple[float, float]], common: float
) -> None:
    each = [LengthBudget(value, own, common, np.array([0.03, -0.04])) for value, own in pairs]
    mean = mean_length(each)
    assert min(v for v, _ in pairs) - 1e-9 <= mean.value_mm <= max(v for v, _ in pairs) + 1e-9
    assert mean.common_mm == pytest.approx(common)
    assert mean.modes_mm is not None
    np.testing.assert_allclose(mean.modes_mm, [0.03, -0.04])
    assert mean.sigma_mm >= np.hypot(common, 0.05) * (1 - 1e-9)


def test_an_outlier_is_left_out_and_equals_average_as_one_over_root_n() -> None:
    each = [LengthBudget(10.0 + d, 0.1, 0.0) for d in (-0.1, 0.1) * 8]
    assert mean_length(each).own_mm == pytest.approx(0.1 / 4, rel=0.05)
    with_outlier = mean_length([*each, LengthBudget(13.0, 0.1, 0.0)])
    assert with_outlier.value_mm == pytest.approx(10.0)


# Modes through to Table III


def block(modes: bool, bend_mm: float = 0.0, seed: int | None = None) -> Profile:
    """The block seen from straight above, its tops' ends blurred; no shadows, no perspective."""
    x = (np.arange(440) - 220) * PITCH_MM
    edges = PIECE.edges_mm() - PIECE.edges_mm()[-1] / 2
    tops = np.zeros_like(x)
    for left, right in edges.reshape(-1, 2):
        tops += norm.cdf((x - left) / 0.8 / PITCH_MM) * norm.cdf((right - x) / 0.8 / PITCH_MM)
    z = np.zeros_like(x)
    for (left, right), groove in zip(edges[1:-1].reshape(-1, 2), PIECE.grooves, strict=True):
        z[(x > left) & (x < right)] = PIECE.height_mm - groove.depth_mm
    z[tops > 0.5] = PIECE.height_mm
    peak = 180 * np.where(tops > 0.5, tops, 1 - tops)
    if seed is not None:
        z = z + np.random.default_rng(seed).normal(0, 0.05, len(z))
    # A stretch of x and a bend of z: errors of a calibration, one standard deviation each.
    stretch = np.stack([x / 100 * 0.1, 0 * x], axis=-1)
    bend = np.stack([0 * x, (z / 80) ** 2 * 0.07], axis=-1)
    field = np.stack([stretch, bend], axis=-1)
    xz = np.column_stack([x, z]) + bend_mm * field.sum(axis=-1)
    sigma = np.sqrt(0.02**2 + (field**2).sum(axis=-1))
    status = np.full(len(x), int(Status.OK))
    return Profile(0.0, PlanePoints(xz, sigma, status, field if modes else None), peak)


def test_modes_make_the_sigma_that_redoing_the_measurement_shows() -> None:
    """What the modes add to sigma is what a displacement by one deviation changes."""
    one = block(modes=True)
    assert one.points.modes_mm is not None
    still = replace(one, points=replace(one.points, modes_mm=0 * one.points.modes_mm))
    stated, alone = groove_dimensions(one, PIECE), groove_dimensions(still, PIECE)
    plus, minus = (groove_dimensions(block(True, bend), PIECE) for bend in (1.0, -1.0))
    for name, length in stated.items():
        change = (plus[name].measured_mm - minus[name].measured_mm) / 2
        # One of the two modes alone changes each entry: widths stretch, heights bend.
        added = np.sqrt(length.sigma_mm**2 - alone[name].sigma_mm ** 2)
        assert added == pytest.approx(abs(change), rel=0.15, abs=2e-3), name
        common = FALSE_LIGHT if name[0] in "WS" else PHASE
        assert alone[name].sigma_mm >= np.sqrt(2) * common * PITCH_MM * (1 - 1e-3), name


def test_without_modes_nothing_cancels() -> None:
    known = groove_dimensions(block(modes=True, seed=1), PIECE)
    unknown = groove_dimensions(block(modes=False, seed=1), PIECE)
    for name in known:
        assert known[name].measured_mm == unknown[name].measured_mm
    # Both ends of a narrow groove err alike; those of S1 and S2 do not.
    for name in ("W1", "W2", "W3"):
        assert known[name].sigma_mm < unknown[name].sigma_mm, name
