"""Edges by the fading of the line over them: a model scan whose edges are known."""

from dataclasses import replace

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from scipy.special import ndtr

from lscan.errors import MeasurementError
from lscan.records import Floats
from lscan.stripe.blurredstep import ROUNDS, SETTLED_MM, _next_state, _Prior, _within_bounds
from lscan.surface.edges import PLACE_SIGMA_MM, EdgeFit, FaceSamples, fit_fading

WIDTH_MM = 0.9


def start(*edges: FaceSamples) -> EdgeFit:
    """All edges at their nominal place, x = slope * y, without lean."""
    slope = np.array([edge.slope for edge in edges])
    return EdgeFit(0 * slope, slope, 0.0, 0.0, np.zeros((0, 0)), np.zeros(0))


def faces(
    at: float, lean: float, slope: float, wall: float, noise: float = 0.0, seed: int = 0
) -> FaceSamples:
    """An edge at x = at + (slope + lean) y, the upper face at smaller x, 100 DN, the lower 80."""
    y, depth = (a.ravel() for a in np.meshgrid(np.arange(-15, 15, 0.5), np.arange(-9, 9, 0.8)))
    t = depth / WIDTH_MM
    lower = t < 0
    x = at + (slope + lean) * y - depth
    share = ndtr(np.abs(t)) + wall * np.exp(-(t**2) / 2) / np.sqrt(2 * np.pi)
    speckle = 1 + noise * np.random.default_rng(seed).standard_normal(len(y))
    light = np.where(lower, 80.0, 100.0) * (1 + 0.002 * y) * share * speckle
    return FaceSamples(slope, 1, 0, np.column_stack([x, y]), light, lower)


def far(at: float, lean: float, slope: float) -> FaceSamples:
    """The same without a lower face in sight."""
    both = faces(at, lean, slope, wall=0.0)
    kept = ~both.lower
    return replace(
        both, plan=both.plan[kept], brightness=both.brightness[kept], lower=both.lower[kept]
    )


@given(st.floats(-1, 1), st.floats(-0.02, 0.02), st.floats(0, 0.5))
@examples(20)
def test_edges_of_the_model_are_found_exactly(at: float, lean: float, wall: float) -> None:
    """A closed form: the light is the model's own but for the product 0.002 y Phi."""
    edges = faces(at, lean, 0.867, wall), far(-at / 2, lean, -0.867)
    fit = fit_fading(edges, start(*edges))
    assert abs(fit.at_mm[0] - at) < 1e-4
    assert abs(fit.at_mm[1] + at / 2) < 1e-4
    assert abs(fit.lean - lean) < 1e-5


def test_a_wall_would_displace_an_edge_found_from_its_upper_face_alone() -> None:
    """Phi(t) + g phi(t) is Phi(t + g) to first order: the edge moves by about g widths."""
    edge = faces(0.0, 0.0, 0.867, wall=0.4)
    kept = ~edge.lower
    alone = replace(
        edge, plan=edge.plan[kept], brightness=edge.brightness[kept], lower=edge.lower[kept]
    )
    moved = fit_fading([alone], start(alone)).at_mm[0]
    assert moved > 0.2 * WIDTH_MM
    assert abs(fit_fading([edge], start(edge)).at_mm[0]) < 1e-4


def test_covariance_is_the_scatter_of_repeats() -> None:
    """Forty repeats know a standard deviation to 11 %: three times that either way.

    Noise of 3 %, at which wall, width and place are still nearly linear in the light; at 15 %
    edges as short as these scatter by two to three times what is stated.
    """
    found: list[Floats] = []
    said: list[Floats] = []
    for seed in range(40):
        edges = [
            faces(0.0, 0.0, 0.867, 0.3, 0.03, seed),
            faces(0.0, 0.0, -0.867, 0.3, 0.03, -1 - seed + 1000),
        ]
        fit = fit_fading(edges, start(*edges))
        found.append(np.array([fit.lean, fit.at_mm[0], fit.at_mm[1]]))
        said.append(np.sqrt(np.diag(fit.covariance)))
    stated = np.median(said, axis=0)
    ratio = np.std(found, axis=0, ddof=1) / stated
    assert (np.abs(ratio - 1) < 0.33).all()
    # Unbiased: the mean within four of its own standard errors.
    assert (np.abs(np.mean(found, axis=0)) < 4 * stated / np.sqrt(40)).all()


@pytest.mark.slow  # a search ends with a step of zero, below
def test_noise_keeps_no_search_going_to_and_fro(monkeypatch: pytest.MonkeyPatch) -> None:
    """The search comes to rest: twice as many rounds move nothing beyond SETTLED_MM a round.

    The last steps shrink by a fifth or more a round, and are five in sum of the last at most.  With
    whole steps a fifth of these searches went in a circle, places half a millimetre apart, for
    wall and place then nearly stand for each other; with samples that count in full or not at all
    the ends differed by 1e-5 mm and more, for no place left a step of zero.
    """
    for edge in short_edges():
        found = []
        for rounds in (ROUNDS, 2 * ROUNDS):
            monkeypatch.setattr("lscan.stripe.blurredstep.ROUNDS", rounds)
            found.append(fit_fading([edge], start(edge)).at_mm[0])
        assert np.ptp(found) < 5 * SETTLED_MM


def test_a_search_ends_with_a_step_of_zero(monkeypatch: pytest.MonkeyPatch) -> None:
    """With samples that count in full or not at all the step changed its sign where one came or
    went, and searches ran to their last round, moving by ever smaller shares of it."""
    rounds: list[int] = []
    monkeypatch.setattr(
        "lscan.stripe.blurredstep._next_state",
        lambda *args: (rounds.append(1), _next_state(*args))[1],
    )
    for seed in range(10):
        edge = faces(0.0, 0.0, 0.867, 0.4, 0.15, seed)
        rounds.clear()
        fit_fading([edge], start(edge))
        assert len(rounds) < ROUNDS


def test_what_is_at_its_bound_is_held_and_the_others_step_without_it() -> None:
    """A quadratic of two unknowns: free both step by the inverse, beside a held one by 1/2."""
    known, gradient = np.array([[2.0, 1.0], [1.0, 2.0]]), np.array([1.0, 5.0])
    at, wide, inverse = np.zeros(2), np.full(2, 9.0), np.linalg.inv(known)

    def step(least: Floats, most: Floats) -> Floats:
        return _within_bounds(known, inverse, gradient, at, _Prior(at, at, least, most))

    free = step(-wide, wide)
    np.testing.assert_allclose(free, np.linalg.solve(known, gradient))
    held = step(-wide, np.array([9.0, 0.0]))
    np.testing.assert_allclose(held, [0.5, 0.0])
    inwards = step(np.array([-9.0, 0.0]), wide)
    np.testing.assert_allclose(inwards, free)


def short_edges() -> list[FaceSamples]:
    """Twenty edges 12 mm long, in noise of 15 %, little of their lower faces seen."""
    edges = []
    for seed in range(20):
        edge = faces(0.0, 0.0, 0.867, 0.4, 0.15, seed)
        y = edge.plan[:, 1]
        kept = (np.abs(y) < 6) & (~edge.lower | (edge.plan[:, 0] - 0.867 * y > 1.5))
        edges.append(
            replace(
                edge, plan=edge.plan[kept], brightness=edge.brightness[kept], lower=edge.lower[kept]
            )
        )
    return edges


def test_too_few_samples_are_refused() -> None:
    edge = faces(0.0, 0.0, 0.5, 0.0)
    few = replace(edge, plan=edge.plan[:5], brightness=edge.brightness[:5], lower=edge.lower[:5])
    with pytest.raises(MeasurementError, match="do not fix"):
        fit_fading([few], start(few))


def test_a_line_that_ends_without_fading_leaves_its_edge_to_the_prior() -> None:
    """Nothing overflows, and the edge is known no better than before: to PLACE_SIGMA_MM.

    Half of that is asked, for the samples do say that the edge is not among them.
    """
    edge = far(0.0, 0.0, 0.867)
    speckle = np.random.default_rng(1).standard_normal(len(edge.plan))
    even = replace(edge, brightness=100 * (1 + 0.01 * speckle))
    with np.errstate(all="raise", under="ignore"):
        fit = fit_fading([even], start(even))
    assert np.sqrt(fit.covariance[1, 1]) > PLACE_SIGMA_MM / 2
