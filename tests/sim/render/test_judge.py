"""The judge of the renderers: its cells, the light it holds together, and each of its families."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from integrator_cases import (
    DRY,
    differ,
    floor_scene,
    groove_scene,
    make_sheet,
    one_lobe,
    parts,
    render,
)

from lscan.records import Floats
from sim.render.layers import W_PER_M2_IN_MW_PER_MM2
from sim.render.plugins.arrays import floats, indices
from sim.render.sampled.multiple import MultipleIntegrator
from sim.render.tank import Tank
from sim.scene import Laser, Pose
from sim.scene.poses import rotation
from sim.water import Optics
from tests.validation.light.judge import JudgeEffort, judge
from tests.validation.light.judgedphotons import (
    SLIVER,
    CellRecords,
    PhotonRecords,
    SurfaceCells,
    Waters,
    shoot,
)

COUNT = 1 << 20


def triangles(corners: Floats) -> mi.Mesh:
    """A mesh of (T, 3, 3) corners."""
    mesh = mi.Mesh("triangles", vertex_count=3 * len(corners), face_count=len(corners))
    values = mi.traverse(mesh)
    values["vertex_positions"] = floats(corners)
    values["faces"] = indices(np.arange(3 * len(corners)))
    values.update()
    return mesh


def test_cells_hold_points_by_their_area() -> None:
    """Points strewn evenly over a few triangles, one a sliver, near a sheet and far from it:
    each cell's share of them is its area's, and all areas together are the triangles'."""
    corners = np.array(
        [
            [[0, 0, 0], [60, 0, 0], [10, 45, 0]],
            [[100, 0, 0], [100, 3, 0], [180, 1, 0]],
            [[0, 60, 0], [180, 60, 0], [90, 300, 0]],
        ],
        dtype=float,
    )
    scene = mi.load_dict({"type": "scene", "mesh": triangles(corners)})
    sheet = make_sheet(Laser(power_mw=1, apex_mm=(90, 0, 300)))  # along y = 0
    cells = SurfaceCells(scene, [sheet], 1.0)
    generator = np.random.default_rng(3)
    x, y = generator.uniform([0, 0], [180, 300], (COUNT, 2)).T
    start = mi.Point3f(floats(x), floats(y), 10)
    si = scene.ray_intersect(mi.Ray3f(start, mi.Vector3f(0, 0, -1)))
    key, area = cells.find(si, mi.Vector3f(0, 0, 1), si.is_valid())
    met = np.array(si.is_valid())
    keys, place, counts = np.unique(np.array(key)[met], return_index=True, return_counts=True)
    areas = np.array(area, dtype=float)[met][place]
    sides = corners[:, 1:] - corners[:, :1]
    whole = 0.5 * np.abs(np.cross(sides[:, 0], sides[:, 1])[:, 2]).sum()
    assert areas.sum() == pytest.approx(whole, rel=2e-3), "cells never hit lack"
    assert areas[counts > 5].min() < 1 and areas.max() > 100, "they grow with the distance"
    expected = COUNT * areas / (180 * 300)
    kind = 4 * np.array(si.prim_index)[met][place] + keys // 2 % 4  # triangle and size
    whole = np.zeros(12)
    np.maximum.at(whole, kind.astype(int), areas)
    told = (expected > 20) & (areas > 1.01 * SLIVER * whole[kind.astype(int)])
    z = (counts - expected)[told] / np.sqrt(expected[told])
    assert np.abs(z).max() < 5 and z.var() == pytest.approx(1, abs=5 * np.sqrt(2 / len(z)))


def test_facets_finer_than_joined_cells_keep_their_area() -> None:
    """A square of facets of half a cell, so far from the sheet that 64 cells a side may be one:
    each is a cell of its own, as large as the facet."""
    x, y = np.meshgrid(np.arange(20.0), np.arange(20.0))
    corner = np.stack([x, y + 2000, 0 * x], axis=-1).reshape(-1, 1, 3)
    below, above = [[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[1, 1, 0], [0, 1, 0], [1, 0, 0]]
    # A wave, for facets that tile a plane are cut as one.
    corners = np.concatenate([corner + below, corner + above])
    corners[..., 2] = 0.3 * np.sin(corners[..., 0] + corners[..., 1])
    sheet = make_sheet(Laser(power_mw=1, apex_mm=(10, 0, 300)))  # along y = 0
    scene = mi.load_dict({"type": "scene", "mesh": triangles(corners)})
    cells = SurfaceCells(scene, [sheet], 2.0)
    middle = corners.mean(axis=1) + np.array([0, 0, 10])
    ray = mi.Ray3f(mi.Point3f(np.float32(middle.T)), mi.Vector3f(0, 0, -1))
    si = scene.ray_intersect(ray)
    key, area = cells.find(si, mi.Vector3f(0, 0, 1), si.is_valid())
    sides = corners[:, 1:] - corners[:, :1]
    whole = 0.5 * np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    assert len(np.unique(np.array(key))) == len(corners)
    assert np.all(np.array(key) // 2 % 4 == 3), "64 cells a side are one"
    np.testing.assert_allclose(np.array(area), whole, rtol=1e-4)


@pytest.mark.parametrize("turned", [False, True])
def test_slivers_that_tile_a_rectangle_are_cut_as_one(turned: bool) -> None:
    """Sixty by forty, half of it of triangles half a cell wide and up to 400 times as long:
    points strewn evenly fall into cells as these are large, and no cell is smaller than the
    others that are as far from the sheet, but for those at two edges.  A triangle above its plane
    is still cut as one."""
    width, height = 60.0, 40.0
    edge = np.vstack(
        [
            np.column_stack([np.full(301, width), np.linspace(0, height, 301)]),
            np.column_stack([np.linspace(width, 30, 301)[1:], np.full(300, height)]),
        ]
    )
    slivers = np.stack([np.tile([30.0, 0.0], (600, 1)), edge[:-1], edge[1:]], axis=1)
    large = np.array([[[0, 0], [30, 0], [30, height]], [[0, 0], [30, height], [0, height]]])
    flat = np.vstack([slivers, large])
    above = np.array([[[80, 0, 5], [110, 0, 5], [80, 40, 5]]], dtype=float)
    corners = np.vstack([np.pad(flat, ((0, 0), (0, 0), (0, 1))), above])
    pose = rotation("ZYX", [20.0, -30.0, 50.0]) if turned else np.eye(3)
    scene = mi.load_dict({"type": "scene", "mesh": triangles(corners @ pose.T)})
    sheet = make_sheet(Laser(power_mw=1, apex_mm=(90, 0, 300)), Pose(pose, np.zeros(3)))
    cells = SurfaceCells(scene, [sheet], 0.25)
    x, y = np.random.default_rng(4).uniform([0, 0], [110, 40], (COUNT, 2)).T
    start, down = np.column_stack([x, y, 0 * x + 10]) @ pose.T, -pose[:, 2]
    ray = mi.Ray3f(mi.Point3f(np.float32(start.T)), mi.Vector3f(*down.tolist()))
    si = scene.ray_intersect(ray)
    key, area = cells.find(si, mi.Vector3f(*(-down).tolist()), si.is_valid())
    met = np.array(si.is_valid())
    keys, place, counts = np.unique(np.array(key)[met], return_index=True, return_counts=True)
    areas = np.array(area, dtype=float)[met][place]
    tiles = np.array(si.prim_index)[met][place] < len(flat)
    for level in range(2):
        same = areas[tiles & (keys // 2 % 4 == level)]
        assert np.mean(same > 0.999 * same.max()) > 0.9
        assert same.min() > same.max() / 17, "the last one, of 4 by 4 at most, is cut off"
    assert areas[tiles].sum() == pytest.approx(width * height, rel=1e-3)
    assert areas[~tiles].sum() == pytest.approx(600, rel=1e-2)
    expected = COUNT * areas / (110 * 40)
    z = (counts - expected)[tiles] / np.sqrt(expected[tiles])
    assert np.abs(z).max() < 5 and z.var() == pytest.approx(1, abs=5 * np.sqrt(2 / len(z)))


@dr.syntax
def write(records: CellRecords, count: int) -> None:
    """Add records of cells 3 + k2 mod 4, k their number, which is z, and of the power k + 1."""
    number, active = dr.arange(mi.UInt32, count), dr.full(mi.Bool, True, count)
    while active:
        back = mi.Vector3f(0, 0, mi.Float(number))
        key = mi.UInt64(3 + number * number % 4)
        records.write(key, back, mi.Float(number) + 1, mi.Float(7), active)
        active = mi.Bool(False)
    dr.eval(number)


def test_records_are_drawn_from_their_own_cell() -> None:
    """As many as there are, each as often; none where there are none."""
    records = CellRecords(64)
    write(records, 30)
    assert records.sort()
    keys = 3 + np.arange(30) ** 2 % 4
    for wanted in range(8):
        held = np.flatnonzero(keys == wanted)
        sample = floats((np.arange(600) + 0.5) / 600)
        found = records.draw(mi.UInt64(wanted), sample, mi.Bool(True))
        assert int(found.count[0]) == len(held)
        if len(held):
            each, often = np.unique(np.array(found.towards.z), return_counts=True)
            assert each.tolist() == held.tolist()
            assert np.ptp(often) <= 1
            assert np.array_equal(np.array(found.power), np.array(found.towards.z) + 1)
    write(records, 40)
    assert not records.sort(), "70 records have no room"


def test_photons_bring_the_lasers_power() -> None:
    """Nothing is lost in a box of water that only scatters: all arrivals on its walls together
    are the power over (1 - albedo); those in clear water are a geometric series."""
    albedo, laser = (
        0.4,
        Laser(power_mw=5, apex_mm=(30, -20, 60), waist_mm=12, fan_half_angle_deg=40),
    )
    matt = {"type": "diffuse", "reflectance": {"type": "spectrum", "value": albedo}}
    walls = {"type": "cube", "to_world": mi.ScalarTransform4f().scale(200)}
    walls["bsdf"] = {"type": "twosided", "bsdf": matt}
    sheet = make_sheet(laser)
    scene = mi.load_dict({"type": "scene", "walls": walls, "sheet": sheet})
    for water in (DRY, one_lobe(0.0, 4e-3, 0.6)):
        integrator = MultipleIntegrator(mi.Properties())
        integrator.configure(water, [sheet], 0.0)
        waters = Waters(scene, integrator, 10.0, 20.0)
        sums = []
        for seed in range(8):
            records = PhotonRecords(1 << 17)
            shoot(waters, sheet, 1 << 14, seed, records)
            assert records.sort()
            sums.append(records.landed.powers().sum())
        half = np.radians(laser.fan_half_angle_deg)
        phi = (np.arange(4000) + 0.5) * half / 2000 - half
        path = np.minimum(260 / np.cos(phi), (200 - np.sign(phi) * 30) / np.abs(np.sin(phi)))
        straight = laser.power_mw * np.exp(-water.extinction_per_mm * path).mean()
        expected = laser.power_mw / (1 - albedo) - straight
        error = np.std(sums, ddof=1) / np.sqrt(len(sums))
        # Student's t of 7 degrees of freedom passes 5.4 once in 1000 tests.
        assert error < 3e-3 * expected
        assert abs(np.mean(sums) - expected) < 5.4 * error + 1e-4 * expected


def in_parts(pictures: Floats) -> Floats:
    """(runs, 4) sums over strips of rows, from the veil down to the floor."""
    return parts(pictures.swapaxes(1, 2), 4)


def configured(tank: Tank, water: Optics) -> Tank:
    for integrator in (tank.integrator, tank.higher):
        integrator.configure(water, tank.sheets, 0.0)
    return tank


@pytest.mark.slow
def test_the_judge_and_the_renderer_agree() -> None:
    """All families together are what ``multiple`` finds in water where it converges; without
    any one of them they are not."""
    tank = configured(Tank(floor_scene()), one_lobe(4e-4, 1e-3, 0.7))
    effort = JudgeEffort(photons=1 << 16, walks=64, batches=12, cell_mm=5.0, voxel_mm=10.0)
    found = judge(tank, 0.0, effort=effort)
    pictures = render(tank, tank.make_camera(jitter=True), tank.higher, 128, range(12))
    pictures *= W_PER_M2_IN_MW_PER_MM2
    assert not differ(in_parts(found.total), in_parts(pictures))
    for name in ("laser", "camera", "both", "veil"):
        lacking = found.total - found.families[name]
        assert differ(in_parts(lacking), in_parts(pictures)), f"{name} is missed"


@pytest.mark.slow
def test_interreflection_agrees_too() -> None:
    """In clear water it is all there is of higher orders."""
    tank = configured(Tank(groove_scene()), DRY)
    effort = JudgeEffort(photons=1 << 16, walks=64, batches=12, cell_mm=0.5)
    found = judge(tank, 0.0, effort=effort)
    pictures = render(tank, tank.make_camera(jitter=True), tank.higher, 128, range(12))
    pictures *= W_PER_M2_IN_MW_PER_MM2
    assert not differ(parts(found.total, 4), parts(pictures, 4))
    assert differ(0.95 * parts(found.total, 4), parts(pictures, 4)), "5 % less is seen"
    assert np.all(found.total == found.families["interreflection"])
