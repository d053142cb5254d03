"""What surfaces leave of the line's halo: of planes all, of blocks what quadrature says."""

from collections.abc import Iterator

import mitsuba as mi
import numpy as np
import pytest

from lscan.records import Floats
from sim.render.firstorder import HEAD
from sim.render.gathered.picture import LEFT_APART_MM, GatheredLight
from sim.render.gathered.veil import BLOCK, PARTS, START_MM, HaloPaths
from sim.render.plugins.arrays import floats, vectors
from sim.render.tank import Tank
from sim.scene import LaserLine, Pose, head_pose, load_scene
from tests.validation.light.gallery import shrunk

TIMES = 8  # pictures of 80 by 60 px
POSITION_MM = 65.0  # the line crosses the block and the floor


@pytest.fixture(scope="module")
def tank() -> Tank:
    scene = shrunk(load_scene("paper/groove"), TIMES).with_tank(render={"scatter_samples": 1})
    tank = Tank(scene)
    tank.higher_orders(POSITION_MM)
    return tank


def gathered(tank: Tank) -> GatheredLight:
    assert tank._gathered is not None
    return tank._gathered


@pytest.fixture
def paths(tank: Tank) -> Iterator[HaloPaths]:
    for sheet in tank.sheets:
        sheet.place(HEAD)
    yield HaloPaths(tank.integrator, gathered(tank)._chart)
    tank.place(POSITION_MM)


def pose_of(tank: Tank, position_mm: float = POSITION_MM) -> Pose:
    return head_pose(tank.scene.tank.head, position_mm)


@pytest.mark.parametrize(("axis", "turn"), [([1, 0, 0], 20), ([0, 1, 0], -20)])
def test_planes_leave_all(tank: Tank, paths: HaloPaths, axis: list[float], turn: float) -> None:
    """What a plane hides lies behind it, where no light of it gets."""
    plane = mi.ScalarTransform4f().rotate(axis, turn).scale(1e5)
    scene = mi.load_dict({"type": "scene", "plane": {"type": "rectangle", "to_world": plane}})
    # Rays start START_MM above the plane: of places along a ray, hundreds of mm, so few more.
    np.testing.assert_allclose(paths.left(scene, pose_of(tank)), 1, atol=2e-3)


def test_blocks_leave_what_quadrature_says(tank: Tank, paths: HaloPaths) -> None:
    """Light scattered once, summed along the camera's rays in even steps of distance.

    Of N points spread evenly a disc holds its share to N^(-3/4) at best (J. Beck, Irregularities
    of distribution I, Acta Mathematica 159, 1987), which is taken for what a shadow hides of the
    PARTS places by which light gets into a ray: the largest of the errors is four times that.
    """
    head, scene, chart = pose_of(tank), tank.mitsuba_scene, gathered(tank)._chart
    left = paths.left(scene, head)
    rows, columns = (np.arange(BLOCK // 2, side, 6 * BLOCK) for side in chart.inner.shape)
    row, column = (place.ravel() for place in np.meshgrid(rows, columns, indexing="ij"))
    eye = head.rotation @ chart.inner.pivot + head.origin_mm
    ways = head.rotation @ chart.between(chart.inner, np.stack([column, row]) - 0.5)
    expected = np.array([scattered_once(tank, eye, way) for way in ways.T])
    whole, visible = expected.T
    ratio = visible / whole
    assert ratio.min() < 0.95, "something is hidden"
    np.testing.assert_allclose(left[row, column], ratio, rtol=0, atol=4 * PARTS**-0.75)


@pytest.mark.slow
def test_two_lines_are_weighed_by_their_light() -> None:
    """What is left of the halo of both lies between what is left of each."""
    lines = tuple(LaserLine(tilt_deg=tilt, share=0.5) for tilt in (0.0, 12.0))
    scene = shrunk(load_scene("paper/groove"), TIMES)
    tank = Tank(scene.with_tank(render={"scatter_samples": 1}, laser={"lines": lines}))
    tank.higher_orders(POSITION_MM)
    for sheet in tank.sheets:
        sheet.place(HEAD)
    paths = HaloPaths(tank.integrator, gathered(tank)._chart)
    tank.place(POSITION_MM)
    fans = paths._fans
    left = []
    for paths._fans in (fans[:1], fans[1:], fans):
        fine = paths.left(tank.mitsuba_scene, pose_of(tank))
        left.append(fine[BLOCK // 2 :: BLOCK, BLOCK // 2 :: BLOCK])
    one, other, both = left
    apart = np.abs(one - other) > 0.02
    share = (both - one)[apart] / (other - one)[apart]
    assert apart.sum() > 100, "they differ"
    # Half a fine cell beside a ray, of BLOCK between rays, an eighth is of its neighbours.
    assert share.min() > -1 / 8 and share.max() < 9 / 8
    assert 0.2 < np.median(share) < 0.8, "both count"


def scattered_once(tank: Tank, eye: Floats, way: Floats) -> tuple[float, float]:
    """Of a camera's ray, the light that planes would leave, and that the surfaces do."""
    scene, phase = tank.mitsuba_scene, tank.integrator.phase
    extinction = float(np.array(tank.integrator.extinction).ravel()[0])
    sheet, count = tank.sheets[0], 512
    tank.place(POSITION_MM)
    half = float(np.array(sheet.half_angle).ravel()[0])
    phi = floats(half * ((np.arange(count) + 0.5) * 2 / count - 1))
    si = scene.ray_intersect(mi.Ray3f(sheet.apex(mi.Float(0)), sheet.direction(phi)))
    lit = np.array(si.is_valid())
    normal = np.array(si.n).T[lit]
    point = np.array(si.p).T[lit] + START_MM * normal
    power = np.array(sheet.power_density(phi) * np.exp(-extinction * np.array(si.t)))[lit]
    seen = reached(scene, point, np.broadcast_to(eye, point.shape))
    ray = mi.Ray3f(
        mi.Point3f(vectors(eye[:, np.newaxis])), mi.Vector3f(vectors(way[:, np.newaxis]))
    )
    end = float(np.array(scene.ray_intersect_preliminary(ray).t)[0])
    distance = np.arange(gathered(tank)._chart.near_mm, 1500, 2.0)
    place = eye + way * distance[:, np.newaxis]
    leg = place[:, np.newaxis] - point
    length = np.linalg.norm(leg, axis=-1)
    cosine = np.maximum(np.einsum("tsk,sk->ts", leg, normal) / length, 0)
    turn = np.arccos(np.clip(-(leg @ way) / length, -1, 1))
    scattered = np.array(phase.value(floats(turn.ravel()))).reshape(turn.shape)
    light = power * cosine * scattered / length**2
    light *= np.exp(-extinction * (distance[:, np.newaxis] + length))
    free = reached(
        scene, np.broadcast_to(point, leg.shape).reshape(-1, 3), (point + leg).reshape(-1, 3)
    )
    visible = light * free.reshape(light.shape) * (distance < end)[:, np.newaxis]
    return float((light * seen).sum()), float(visible.sum())


def reached(scene: mi.Scene, start: Floats, end: Floats) -> Floats:
    """Whether nothing lies between places, as 0 or 1."""
    leg = end - start
    length = np.linalg.norm(leg, axis=-1)
    ray = mi.Ray3f(
        mi.Point3f(vectors(start.T)), mi.Vector3f(vectors((leg / length[:, np.newaxis]).T))
    )
    ray.maxt = floats(length)
    return ~np.array(scene.ray_test(ray))


def test_what_is_left_is_interpolated_along_the_track(tank: Tank, paths: HaloPaths) -> None:
    """Between the places where it is known, halo and veil alike."""
    light = gathered(tank)
    known = [light._shares_left(number * LEFT_APART_MM) for number in (13, 14)]
    between = light._shares_left(13.25 * LEFT_APART_MM)
    assert len(between) == 1 + len(tank.sheets)
    for here, there, found in zip(*known, between, strict=True):
        assert np.abs(there - here).max() > 1e-3, "it differs"
        np.testing.assert_allclose(found, 0.75 * here + 0.25 * there, rtol=1e-5)
    own = paths.left(tank.mitsuba_scene, pose_of(tank, 13 * LEFT_APART_MM))
    np.testing.assert_array_equal(known[0][0], own)
