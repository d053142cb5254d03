"""Blocks of a given roughness: their spectrum, their shape, and their truth."""

from typing import Any

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from pydantic import ValidationError

from lscan.errors import InputError
from lscan.records import Floats, Status
from sim.meshes.parts import ripple_heights, rough_block_mesh, rough_density, rough_heights
from sim.scene import Scene, into_world, load_scene, target_pose
from sim.scene.matter import Ripples, RoughBlock
from sim.truth import stripe_truths

SMALL: dict[str, Any] = {
    "size_mm": (60.0, 40.0), "step_mm": 0.5, "longest_mm": 20.0, "shortest_mm": 2.0
}  # fmt: skip


def mean_square(block: RoughBlock) -> float:
    """cm², of the field: the integral of w2 k^(1 - gamma2) 2 pi over its wavenumbers, in closed
    form; stretching the plane leaves areas as they are."""
    low, high = (2 * np.pi * 10 / length for length in (block.longest_mm, block.shortest_mm))
    if block.gamma2 == 2:
        return float(2 * np.pi * block.w2_cm4 * np.log(high / low))
    power = 2 - block.gamma2
    return float(2 * np.pi * block.w2_cm4 * (high**power - low**power) / power)


@pytest.mark.parametrize("change", [{}, {"gamma2": 2.0}, {"gamma2": 3.5, "ratio": 3.0}], ids=str)
def test_the_field_has_the_power_of_its_spectrum(change: dict[str, Any]) -> None:
    """The mean over 200 seeds of a field's mean square, within 4 standard errors."""
    found = []
    for seed in range(200):
        block = RoughBlock(**SMALL | {"step_mm": 1.0} | change, seed=seed)
        found.append((rough_heights(block)[2] ** 2).mean() / 100)
    block = RoughBlock(**SMALL | {"step_mm": 1.0} | change)
    error = np.std(found, ddof=1) / np.sqrt(len(found))
    assert abs(np.mean(found) - mean_square(block)) < 4 * error


def test_the_field_has_nothing_beyond_its_wavelengths_and_is_stretched_across() -> None:
    block = RoughBlock(**SMALL, ratio=4.0, heading_deg=30.0)
    k = np.array([2 * np.pi / 0.5])  # rad/cm, of 5 mm
    way = np.radians([30.0, 120.0])
    along, across = (rough_density(block, np.sin(w) * k, np.cos(w) * k)[0] for w in way)
    assert along / across == pytest.approx(4.0**3)
    assert rough_density(block, np.array([2 * np.pi / 2.1]), np.array([0.0]))[0] > 0
    for length_cm in (9.0, 0.05):
        assert rough_density(block, 2 * np.pi / np.array([length_cm]), np.array([0.0]))[0] == 0


@examples(10)
@given(crests=st.floats(0, 1), heading=st.floats(-180, 180))
def test_ripples_span_their_height_over_their_wavelength(crests: float, heading: float) -> None:
    ripples = Ripples(wavelength_mm=10, height_mm=3, heading_deg=heading, crests=crests)
    way, s = np.radians(heading), np.linspace(0, 20, 2001)
    z = ripple_heights(ripples, s * np.cos(way), s * np.sin(way))
    assert z.max() == pytest.approx(1.5, abs=1e-4) and z.min() == pytest.approx(-1.5, abs=1e-4)
    np.testing.assert_allclose(z[:1001], z[1000:], atol=1e-9)
    across = ripple_heights(ripples, -s * np.sin(way), s * np.cos(way))
    np.testing.assert_allclose(across, across[0], atol=1e-9)


def test_the_block_is_closed_and_has_the_volume_beneath_its_heights() -> None:
    block = RoughBlock(**SMALL, depth_mm=20.0)
    z = rough_heights(block)[2]
    mesh = rough_block_mesh(block)
    assert mesh.is_watertight and mesh.is_winding_consistent
    square = np.ones(z.shape)
    for axis in (0, 1):  # each triangle's mean height is that of its corners
        ends = [slice(None), slice(None)]
        ends[axis] = [0, -1]  # type: ignore[call-overload]
        square[tuple(ends)] /= 2
    a, b, c, d = z[:-1, :-1], z[:-1, 1:], z[1:, 1:], z[1:, :-1]
    above = ((a + b + c) / 6 + (a + c + d) / 6).sum() * 0.25
    assert mesh.volume == pytest.approx(60 * 40 * 20 + above, rel=1e-9)


def rough(**changes: Any) -> Scene:
    scene = load_scene("targets/rough").with_tank(render={"scatter_samples": 0})
    block = {**SMALL, "size_mm": (120.0, 60.0), "depth_mm": 42.0, **changes}
    return scene.with_tank(
        target={"rough": RoughBlock(**block), "position_mm": (165.0, 30.0, -330.0)}
    )


def test_the_truth_lies_on_the_field() -> None:
    """On the two triangles of each cell, which are planes through its corners."""
    scene = rough()
    block = scene.tank.target.rough
    assert block is not None
    (truth,) = stripe_truths(scene, [60.0])
    shown = truth.status == Status.OK
    points = np.insert(truth.xz_mm[shown], 1, 0.0, axis=1)
    places = into_world(scene.tank.head, points, np.full(len(points), 60.0))
    x, y, height = target_pose(scene).invert(places).T
    on_block = (x > 1) & (x < 119) & (height > -30)
    assert on_block.sum() > 50
    x, y, height = x[on_block], y[on_block], height[on_block]
    z = rough_heights(block)[2]
    row, column = (y / 0.5).astype(int), (x / 0.5).astype(int)
    v, u = y / 0.5 - row, x / 0.5 - column
    a, b = z[row, column], z[row, column + 1]
    c, d = z[row + 1, column + 1], z[row + 1, column]
    expected = np.where(u >= v, a + u * (b - a) + v * (c - b), a + v * (d - a) + u * (c - d))
    np.testing.assert_allclose(height, expected, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"shortest_mm": 30.0}, "shortest_mm"),
        ({"step_mm": 1.5}, "step_mm"),
        ({"w2_cm4": 0.0}, "nothing is rough"),
        ({"gamma2": float("nan")}, "gamma2"),
    ],
)
def test_a_block_that_contradicts_itself_is_refused(change: dict[str, Any], match: str) -> None:
    with pytest.raises(ValidationError, match=match):
        RoughBlock(**SMALL | change)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"depth_mm": 0.5, "w2_cm4": 1.0}, "depth_mm"),
        ({"size_mm": (2000.0, 2000.0), "step_mm": 0.1}, "step_mm"),
    ],
)
def test_a_block_that_cannot_be_made_is_refused(change: dict[str, Any], match: str) -> None:
    with pytest.raises(InputError, match=match):
        rough_heights(RoughBlock(**SMALL | change))


def heights(scene: Scene) -> Floats:
    assert scene.tank.target.rough is not None
    return rough_heights(scene.tank.target.rough)[2]


def test_the_scenes_fit_their_blocks() -> None:
    """Ripples ride on the field that is there without them."""
    ripples = load_scene("targets/ripples")
    block = ripples.tank.target.rough
    assert block is not None and block.ripples is not None
    bare = block.model_copy(update={"ripples": None})
    x, y, z = rough_heights(bare)
    added = heights(ripples) - z
    np.testing.assert_allclose(added, ripple_heights(block.ripples, x, y[:, np.newaxis]))
