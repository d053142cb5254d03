"""The veil of higher orders: against quadrature, against the judge, and what must not change it."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from integrator_cases import DRY, INDEX, make_sheet, one_lobe
from truth_scenes import tank as scene_with

from lscan.records import Floats
from sim.render.firstorder import HEAD, HeadRays, head_rays
from sim.render.gathered.picture import _mean_normal
from sim.render.gathered.veil import (
    LEAST_SLOPE,
    STEP,
    HigherVeil,
    _level,
    field_of_view,
    smooth_field,
)
from sim.render.gathered.veilphotons import BATCH, COLUMNS, KEPT, ROWS, veil_counts
from sim.render.layers import W_PER_M2_IN_MW_PER_MM2
from sim.render.plugins.sheet import LaserSheet
from sim.render.tank import Tank
from sim.scene import Laser, Pose, head_pose, load_scene
from sim.water import HenyeyGreensteinMixture, Optics
from tests.validation.light.gallery import shrunk

WIDTH, HEIGHT = 64, 48
RIG: dict[str, Any] = {
    "camera": {"width_px": WIDTH, "height_px": HEIGHT},
    "lens": {"focal_px": 90.0, "centre_px": [31.5, 23.5]},
    "head": {"camera_mm": [0.0, -500.0, 250.0], "depression_deg": 40.0},
    "laser": {
        "power_mw": 10.0, "apex_mm": [0.0, 0.0, 400.0], "waist_mm": 0.5,
        "fan_half_angle_deg": 60.0,
    },
}  # fmt: skip
EVEN = one_lobe(1e-3, 1e-5, 0.0)  # light of the third order is 1 % of the second's or less
PHOTONS = 2**18
OPEN = np.full((HEIGHT, WIDTH), np.inf, np.float32)


@pytest.fixture(autouse=True)
def cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache of this run alone, the same in all tests."""
    folder = tmp_path_factory.getbasetemp() / "veil-cache"
    monkeypatch.setenv("XDG_CACHE_HOME", str(folder))
    return folder


@pytest.fixture(scope="module")
def tank() -> Tank:
    return Tank(scene_with(**RIG))


@pytest.fixture(scope="module")
def rays(tank: Tank) -> HeadRays:
    return head_rays(tank._camera, tank.integrator, tank.scene.tank.head, (WIDTH, HEIGHT))


def sheet_of(power_mw: float) -> LaserSheet:
    return make_sheet(Laser(**{**RIG["laser"], "power_mw": power_mw}))


def inner(rays: HeadRays, values: Floats) -> Floats:
    """(H, W, ...) of the picture's own rays, from those with the margin."""
    return np.reshape(values, (HEIGHT + 2, WIDTH + 2, -1))[1:-1, 1:-1].astype(float)


def test_veil_needs_water(rays: HeadRays) -> None:
    veil = HigherVeil(DRY, [sheet_of(10.0)], rays)
    assert not veil.picture(OPEN).any()


def test_veil_is_the_sheets_power(rays: HeadRays) -> None:
    """Twice the power is twice the light, and so are two sheets in one place."""
    one, double, two = (
        HigherVeil(EVEN, [sheet_of(power) for power in powers], rays, photons=PHOTONS).picture(OPEN)
        for powers in ([10.0], [20.0], [10.0, 10.0])
    )
    np.testing.assert_allclose(double, 2 * one, rtol=1e-5)
    np.testing.assert_allclose(two, 2 * one, rtol=1e-5)


def test_surfaces_hide_the_veil(rays: HeadRays) -> None:
    """The farther a surface, the more is seen; nothing before the port.  Where light is turned by
    18 degrees at a time, hardly any of it gets from the sheet halfway to the camera: a wall there
    hides nine tenths, and one just behind the sheet half or less."""
    forward = HenyeyGreensteinMixture((1.0,), (0.95,))
    water = Optics(INDEX, 1e-3, 2e-4, forward, molecular_weight=0.0)
    veil = HigherVeil(water, [sheet_of(10.0)], rays, photons=PHOTONS)
    crossing = inner(rays, np.array(rays.veils[0].crossing))[..., 0]
    lights = [
        veil.picture((share * crossing).astype(np.float32))
        for share in (0.0, 0.3, 0.5, 0.9, 1.0, 1.1, 1.5, np.inf)
    ]
    assert all(np.all(far >= near) for near, far in pairwise(lights))
    assert not lights[0].any()
    assert lights[2].sum() < 0.1 * lights[-1].sum()
    assert lights[5].sum() > 0.5 * lights[-1].sum()


def test_lattice_is_laid_on_pixels(rays: HeadRays) -> None:
    """A surface that hides one half of the picture hides the veil there, to a lattice's step."""
    veil = HigherVeil(EVEN, [sheet_of(10.0)], rays, photons=PHOTONS)
    distance = OPEN.copy()
    distance[:, : WIDTH // 2] = 0.0
    light, whole = veil.picture(distance), veil.picture(OPEN)
    left, right = light[:, : WIDTH // 2 - STEP], light[:, WIDTH // 2 + STEP :]
    assert not left.any()
    np.testing.assert_allclose(right, whole[:, WIDTH // 2 + STEP :], rtol=1e-5)


def test_smoothing_keeps_the_sum_and_an_edge() -> None:
    """Counts of a field that falls tenfold across an edge: their sum stays, the field is found to
    less than half of the counts' own deviation, and the edge is not blurred."""
    across, down = np.meshgrid(np.arange(32), np.arange(24))
    lit = across < 12 + down // 4
    field = 50.0 * np.exp(-down / 20 - across / 40) * np.where(lit, 1.0, 0.1)
    counts = np.random.default_rng(4).poisson(field).astype(float)
    found = smooth_field(counts, counts, lit)
    assert found.sum() == pytest.approx(counts.sum(), rel=1e-3)
    deviation = np.sqrt(np.mean((found - field)[lit] ** 2 / field[lit]))
    assert deviation < 0.5
    beside = lit ^ np.roll(lit, 1, axis=1)
    beside[:, 0] = False
    assert np.abs(found / field - 1)[beside].mean() < 0.3


@pytest.mark.parametrize("level", [-60.0, 40.0])
def test_planes_across_the_depth_leave_all(rays: HeadRays, level: float) -> None:
    """There the table's own condition is the truth: light counts whose deepest place lies above."""
    plane = mi.ScalarTransform4f().translate([0, 0, level]).scale(1e5)
    scene = mi.load_dict({"type": "scene", "plane": {"type": "rectangle", "to_world": plane}})
    veil = HigherVeil(EVEN, [sheet_of(10.0)], rays, photons=PHOTONS)
    (left,) = veil.left(scene, Pose(np.eye(3), np.zeros(3)))
    # Places within rounding, 1e-4 mm, of the plane are few.
    np.testing.assert_allclose(left, 1, atol=1e-3)


def test_a_wall_before_the_sheet_leaves_nothing(rays: HeadRays) -> None:
    """The table alone has light from behind it, no deeper than the places at which rays meet it."""
    wall = mi.ScalarTransform4f().translate([0, -100, 0]).rotate([1, 0, 0], 90.0).scale(1e5)
    scene = mi.load_dict({"type": "scene", "wall": {"type": "rectangle", "to_world": wall}})
    veil = HigherVeil(EVEN, [sheet_of(10.0)], rays, photons=PHOTONS)
    origin, way = (inner(rays, np.array(v).T) for v in (rays.origin, rays.direction))
    distance = ((-100 - origin[..., 1]) / way[..., 1]).astype(np.float32)
    left = veil.left(scene, Pose(np.eye(3), np.zeros(3)))
    hidden, plain, whole = (
        veil.picture(*to).sum() for to in ((distance, left), (distance,), (OPEN,))
    )
    # One path is added in each cell; twice that, for the light differs from cell to cell.
    assert hidden / plain < 2 * ROWS * COLUMNS / (KEPT * plain / whole) < 0.15


def test_kept_paths_stand_for_the_light(rays: HeadRays) -> None:
    """Their shares add up to the number asked for, within three times what the light of the first
    photons scatters by, 11 % (over eight seeds), and are of cells as the light is."""
    sheet, view = sheet_of(10.0), field_of_view(rays)
    sheet.place(HEAD)
    counts = veil_counts(sheet, EVEN, view, np.array([0, 0, -1.0]), 4 * BATCH, 1, lambda *_: None)
    share, place = counts.paths[:, 0], counts.paths[:, -3:]
    assert share.sum() == pytest.approx(KEPT, rel=0.33)
    right, down = view.tangents(place - view.pinhole_mm)
    kept = np.histogram2d(
        down,
        right,
        bins=[3, 4],
        range=np.transpose([view.low[::-1], view.high[::-1]]),
        weights=share,
    )[0]
    light = counts.light.sum(axis=(0, 1)).reshape(3, ROWS // 3, 4, COLUMNS // 4).sum(axis=(1, 3))
    np.testing.assert_allclose(kept / kept.sum(), light / light.sum(), rtol=0.05)


# What the judge finds in eight strips of rows, W/(m2 sr), with its standard errors, and in all:
# judge(tank, 120.0, (60, 0, 40, 120), JudgeEffort(1 << 19, 64, 6), seed=8).families["veil"]
JUDGED = np.array([21.96, 18.39, 15.59, 13.57, 11.65, 9.804, 7.123, 2.558]) * 1e-6
ERRORS = np.array([8.4, 11.9, 9.3, 21.0, 10.6, 6.8, 3.3, 6.8]) * 1e-8
WHOLE, WHOLE_ERROR = 1.2580e-5, 4.8e-8


def test_veil_is_the_judges() -> None:
    """The paper's tank at 1 NTU with its block in the last two of eight strips of rows: within
    three standard errors and 3 %, where its edge is, 6 %, for what planes leave steps by 12 %
    there, and cells show the mean of both sides; the whole within 2 %.  The last strip, on the
    block, is within three standard errors: planes in place of the surfaces have it too dark."""
    scene = load_scene("paper/groove").with_tank(
        water={
            "kind": "tank",
            "turbidity_ntu": 1.0,
            "particle_absorption_per_m": None,
            "particle_scattering_per_m": None,
        }
    )
    tank = Tank(shrunk(scene, 4))
    width, height = tank.scene.rig.camera.size_px
    assert tank._sparse is not None
    tank._sparse.look(tank.scene.tank.head)
    rays = tank._sparse.rays
    veil = HigherVeil(tank.water, tank.sheets, rays)
    head = head_pose(tank.scene.tank.head, 120.0)
    seen = rays.seen_from(head)
    distance = np.array(tank.mitsuba_scene.ray_intersect_preliminary(seen, coherent=True).t)
    distance = distance.reshape(height + 2, width + 2)[1:-1, 1:-1]
    allowed = 3 * ERRORS + JUDGED * ([0.03] * 6 + [0.06, 0])
    for left in (veil.left(tank.mitsuba_scene, head), None):
        picture = veil.picture(distance, left)[:, 60:100] * W_PER_M2_IN_MW_PER_MM2
        off = np.abs(picture.reshape(8, -1).mean(axis=1) - JUDGED)
        if left is None:
            assert off[-1] > allowed[-1]
        else:
            assert np.all(off < allowed)
            assert picture.mean() == pytest.approx(WHOLE, abs=0.02 * WHOLE + 3 * WHOLE_ERROR)


def test_depth_is_measured_into_what_the_camera_sees(tank: Tank, rays: HeadRays) -> None:
    """A plane that leans back by 50 degrees fills the picture: its normal is known to rounding, in
    the head's frame, wherever the head stands; without surfaces depth goes along the fan's axis."""
    turn = mi.ScalarTransform4f().rotate([1, 0, 0], 50.0).scale(1e4)
    plane = mi.load_dict({"type": "scene", "plane": {"type": "rectangle", "to_world": turn}})
    places = [head_pose(tank.scene.tank.head, x) for x in (0.0, 20.0)]
    upright = _mean_normal(plane, rays, places)
    assert upright is not None
    lean = np.radians(50.0)
    np.testing.assert_allclose(upright, [0, -np.sin(lean), np.cos(lean)], atol=1e-5)
    assert _mean_normal(mi.load_dict({"type": "scene"}), rays, places) is None
    sheet, view = sheet_of(10.0), field_of_view(rays)
    np.testing.assert_allclose(_level(sheet, rays, view, upright), -upright)
    np.testing.assert_allclose(_level(sheet, rays, view, None), [0, 0, -1], atol=1e-6)
    # Depth behind what rays graze would not say where they end.
    grazed = _level(sheet, rays, view, view.axes[0])
    assert (grazed @ np.array(rays.direction)).min() > LEAST_SLOPE
