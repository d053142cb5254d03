"""Planes, spheres and cylinders fitted to points: closed forms, coverage, equivariance."""

from collections.abc import Callable

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from scipy.spatial.transform import Rotation
from shape_surfaces import RADIUS_MM, common_errors, dome, plan, points_of, ridge

from lscan.errors import MeasurementError
from lscan.measure.board import algebraic_ball
from lscan.measure.shapes import (
    CylinderShape,
    FittedShape,
    ParallelPlanes,
    ShapeFit,
    SphereShape,
    fit_shape,
)
from lscan.records import Floats

SEEDS = 40
BAND = 3 * np.sqrt(0.95 * 0.05 / SEEDS)
"""Three standard deviations of the share of SEEDS intervals that hold the truth: 0.10."""

Start = Callable[[Floats], FittedShape]


def flat(xyz: Floats) -> ParallelPlanes:
    return ParallelPlanes.start(xyz, np.zeros(len(xyz), dtype=np.int64))


STARTS: dict[str, Start] = {
    "plane": flat,
    "sphere": SphereShape.start,
    "cylinder": CylinderShape.start,
}


def exact(kind: str, count: int = 21) -> Floats:
    """(K, 3) points of the shape, about the origin."""
    x, y = plan(count)
    z = {"plane": lambda: 0.2 * x - 0.1 * y, "sphere": lambda: dome(x, y)}.get(
        kind, lambda: ridge(x, y)
    )()
    return np.stack([x, y, z], axis=-1).reshape(-1, 3)


def fitted(kind: str, xyz: Floats, **known: float) -> ShapeFit:
    return fit_shape(STARTS[kind](xyz), points_of(xyz, **known), kind)


TRUE: dict[str, dict[str, float]] = {
    "plane": {
        "height_mm": 0.0,
        "slope_x_deg": float(np.degrees(np.arctan(0.2))),
        "slope_y_deg": float(np.degrees(np.arctan(-0.1))),
    },
    "sphere": {"radius_mm": RADIUS_MM, "x_mm": 0.0, "y_mm": 0.0, "z_mm": 0.0},
    "cylinder": {
        "radius_mm": RADIUS_MM, "x_mm": 0.0, "y_mm": 0.0, "z_mm": 0.0, "turn_deg": 90.0,
        "rise_deg": 0.0,
    },
}  # fmt: skip


@pytest.mark.parametrize("kind", STARTS)
def test_exact_points_give_the_shape_exactly(kind: str) -> None:
    fit = fitted(kind, exact(kind))
    assert fit.shape.quantities() == pytest.approx(TRUE[kind], abs=1e-6)
    assert fit.rms_mm < 1e-9
    assert fit.kept.all() and fit.determined


def test_a_step_is_the_distance_of_two_planes_along_their_normal() -> None:
    """Planes of slope 0.1 that lie 5 mm apart in z are 5 / sqrt(1.01) mm apart."""
    x, y = plan()
    z = 0.1 * x + np.where(x > 0, 5.0, 0.0)
    xyz = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    which = np.where(xyz[:, 0] > 0, 0, 1)
    fit = fit_shape(ParallelPlanes.start(xyz, which), points_of(xyz), "step")
    assert fit.shape.quantities()["height_mm"] == pytest.approx(5 / np.sqrt(1.01), abs=1e-9)
    # Two means of many points: no less certain than their noise allows.
    upper, lower = (which == 0).sum(), (which == 1).sum()
    least = 0.05 * np.sqrt(1 / upper + 1 / lower)
    sigma = fit.sigma(np.array([[0.0, 0.0, 1.0, -1.0]]))[0]
    assert least < sigma < 3 * least


@pytest.mark.parametrize("kind", STARTS)
def test_the_design_is_the_derivative_of_the_distances(kind: str) -> None:
    """Against finite differences at a shape moved off the points by about a millimetre."""
    xyz = exact(kind, 7)
    shape = STARTS[kind](xyz)
    terms = shape.terms(xyz)
    count = terms.design.shape[1]
    shape = shape.moved(np.linspace(0.01, 0.02, count))
    design = shape.terms(xyz).design
    for parameter in range(count):
        step = 1e-6 * np.eye(count)[parameter]
        change = shape.moved(step).terms(xyz).distance_mm
        change = (change - shape.moved(-step).terms(xyz).distance_mm) / 2e-6
        np.testing.assert_allclose(design[:, parameter], change, atol=2e-4)


@pytest.mark.parametrize(
    "kind", ["plane", "sphere", pytest.param("cylinder", marks=pytest.mark.slow)]
)
def test_intervals_hold_the_truth_where_noise_and_common_errors_are_as_stated(kind: str) -> None:
    truth, inside = exact(kind), []
    # Where along a cylinder its axis is looked at is no error.
    measured = [name for name in TRUE[kind] if (kind, name) != ("cylinder", "y_mm")]
    rows = [list(TRUE[kind]).index(name) for name in measured]
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        modes = common_errors(truth)
        xyz = truth + modes @ rng.normal(0, 1, 3) + rng.normal(0, 0.05, truth.shape)
        fit = fit_shape(STARTS[kind](xyz), points_of(xyz, 0.05, modes), kind)
        error = np.array([fit.shape.quantities()[name] - TRUE[kind][name] for name in measured])
        inside.append(np.abs(error) <= 1.96 * fit.sigma(by_parameters(fit)[rows]))
    share = np.mean(inside, axis=0)
    assert (np.abs(share - 0.95) < BAND).all(), dict(zip(measured, share, strict=True))


def by_parameters(fit: ShapeFit) -> Floats:
    count = len(fit.covariance)

    def at(step: Floats) -> Floats:
        return np.array(list(fit.shape.moved(step).quantities().values()))

    return np.stack([(at(h) - at(-h)) / 2e-5 for h in 1e-5 * np.eye(count)], axis=1)


def test_noise_that_neighbours_share_widens_the_interval() -> None:
    """Bumps 5 mm across of 0.05 mm: 56 points each, so seven times the sigma of as many alone."""
    truth = exact("sphere", 61)
    inside, alone = [], []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        bumps = rng.normal(0, 0.05, (9, 9))
        cell = np.clip(((truth[:, :2] + 20) // 5).astype(int), 0, 8)
        xyz = truth + truth / RADIUS_MM * bumps[cell[:, 0], cell[:, 1], None]
        fit = fitted("sphere", xyz, sigma_mm=0.05)
        error = fit.shape.quantities()["radius_mm"] - RADIUS_MM
        sigma = fit.sigma(np.array([[0.0, 0.0, 0.0, 1.0]]))[0]
        inside.append(abs(error) <= 1.96 * sigma)
        design = fit.terms.design
        alone.append(abs(error) <= 1.96 * 0.05 * np.sqrt(np.linalg.inv(design.T @ design)[3, 3]))
    # Three standard deviations of the share of 60 intervals are 0.084; as much again for the
    # scatter of 64 cells being known to a tenth.
    assert np.mean(inside) > 0.95 - 0.17
    assert np.mean(alone) < 0.6


def test_outliers_are_left_out_and_counted() -> None:
    """A tenth of the points lie 3 mm up: sixty of their sigmas."""
    xyz = exact("sphere")
    wrong = np.random.default_rng(5).permutation(len(xyz))[: len(xyz) // 10]
    xyz[wrong, 2] += 3.0
    fit = fitted("sphere", xyz)
    assert set(np.flatnonzero(~fit.kept)) == set(wrong)
    assert fit.shape.quantities()["radius_mm"] == pytest.approx(RADIUS_MM, abs=1e-6)


@pytest.mark.parametrize(("kind", "count"), [("plane", 2), ("sphere", 2), ("cylinder", 3)])
def test_too_few_points_are_refused(kind: str, count: int) -> None:
    with pytest.raises(MeasurementError, match=r"points lie there, .* are needed"):
        fitted(kind, exact(kind, count))


def test_a_steep_strip_is_as_steep_where_heights_alone_are_uncertain() -> None:
    """16 sigmas wide: orthogonal distances alone would find it too steep by 1 of its sigmas.

    The mean of 25 errors, in sigmas, is off by 3 / sqrt(25) = 0.6 in one of 400 trials.
    """
    errors = []
    for seed in range(25):
        rng = np.random.default_rng(seed)
        x, y = rng.uniform(-20, 20, 400), rng.uniform(-0.4, 0.4, 400)
        xyz = np.column_stack([x, y, 0.3 * y + rng.normal(0, 0.05, 400)])
        points = points_of(xyz)
        points.own_mm2[:, :2] = 0.0
        fit = fit_shape(flat(xyz), points, "strip")
        slope = fit.shape.quantities()["slope_y_deg"] - np.degrees(np.arctan(0.3))
        errors.append(slope / fit.sigma(by_parameters(fit)[2:])[0])
    assert abs(np.mean(errors)) < 0.6
    assert np.mean(np.abs(errors) < 1.96) > 0.95 - 3 * np.sqrt(0.95 * 0.05 / 25)


angles = st.floats(-3.0, 3.0)
shifts = st.floats(-500.0, 500.0)


@examples(25)
@given(kind=st.sampled_from(["sphere", "cylinder"]), turn=st.tuples(*3 * [angles]),
       shift=st.tuples(*3 * [shifts]))  # fmt: skip
def test_a_moved_shape_is_found_moved(
    kind: str, turn: tuple[float, ...], shift: tuple[float, ...]
) -> None:
    """Noise that turns along leaves the fit the same: radius, sigma, and where the centre lies."""
    rotation = Rotation.from_rotvec(turn)
    rng = np.random.default_rng(3)
    xyz = exact(kind) + rng.normal(0, 0.02, (441, 3))
    moved = rotation.apply(xyz) + shift
    one, other = fitted(kind, xyz), fitted(kind, moved)
    radii = [fit.shape.quantities()["radius_mm"] for fit in (one, other)]
    # SETTLED of a sigma of some 0.01 mm.
    assert radii[0] == pytest.approx(radii[1], abs=1e-5)
    centre = one.shape.centre_mm if kind == "sphere" else one.shape.axis_mm
    again = other.shape.centre_mm if kind == "sphere" else other.shape.axis_mm
    np.testing.assert_allclose(rotation.apply(centre) + shift, again, atol=1e-4)


def test_the_algebraic_ball_of_a_circle_and_of_a_sphere_is_exact() -> None:
    angle = np.linspace(0, 2, 9)
    circle = np.column_stack([3 + 5 * np.cos(angle), -1 + 5 * np.sin(angle)])
    np.testing.assert_allclose(algebraic_ball(circle), [3, -1, 5], atol=1e-9)
    np.testing.assert_allclose(algebraic_ball(exact("sphere")), [0, 0, 0, RADIUS_MM], atol=1e-8)
