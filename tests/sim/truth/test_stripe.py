"""The true stripe and what is lit and seen: pencil and paper, symmetries, other algorithms."""

from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from drawn_examples import examples
from hypothesis import given, strategies as st
from truth_scenes import BOARD, block_mesh, in_head, tank

from lscan.config.documents import merge
from lscan.config.targets import GroovedBlock, Sandwave
from lscan.errors import InputError
from lscan.records import Status
from sim.scene import Pose, Scene, head_pose, target_pose
from sim.truth import StripeTruth, project, slice_visibility, stripe_truth, stripe_truths
from sim.truth.camera import entry_points
from sim.truth.stripe import ColumnCrossings, edge_distance, is_continued
from sim.truth.surfaces import SELF_MM, Mesh, grooved_block_surfaces, surfaces_of
from sim.truth.visibility import is_blocked, passing_mm

FEW = examples(10)
LOW = {"camera_mm": [75.0, -700.0, 180.0], "depression_deg": 15.0}
LASER = {"power_mw": 10.0, "apex_mm": [75.0, 0.0, 500.0], "fan_half_angle_deg": 40.0}


def sandwave(target: dict[str, Any] | None = None, **sections: dict[str, Any]) -> Scene:
    """The sandwave from so low a camera that its steep flanks hide themselves."""
    base = {
        "head": LOW,
        "laser": LASER,
        "workpiece": {"kind": "sandwave"},
        "target": {"shape": "workpiece", **(target or {})},
        "floor": {"z_mm": -40.0},
    }
    return tank(**merge(base, sections))


def block(**head: Any) -> Scene:
    """The grooved block on the floor, from (-100, 0) in the sheet."""
    return tank(
        workpiece={"kind": "grooved-block"},
        target={"shape": "workpiece", "position_mm": [-100.0, 0.0, -100.0]},
        floor={"z_mm": -100.0},
        head={"yaw_deg": 0.0, **head},
    )


def screen(y_mm: float) -> Scene:
    """A board as a screen, its face at y, upright on a floor 300 mm below O."""
    return tank(
        board=BOARD,
        target={"shape": "board", "position_mm": [-75.0, y_mm, -170.0]},
        floor={"z_mm": -300.0},
    )


def same(a: StripeTruth, b: StripeTruth, within: float) -> None:
    """Assert that two truths agree but for the track position."""
    for name in (f.name for f in fields(a) if f.name not in ("position_mm", "axis")):
        here, there = getattr(a, name), getattr(b, name)
        assert np.allclose(here, there, rtol=0, atol=within, equal_nan=True), name


@FEW
@given(yaw=st.floats(-5, 5), s=st.floats(0, 150), turn=st.floats(-10, 10))
def test_a_stripe_point_is_seen_where_it_is_said_to_be(yaw, s, turn):
    scene = sandwave({"turn_deg": turn}, head={"yaw_deg": yaw})
    truth = stripe_truth(scene, s)
    there = truth.status != Status.NO_PEAK
    pixels = project(scene, in_head(truth.xz_mm[there]))
    # Between the ends of a piece of 0.05 mm the projection is taken as straight: its second
    # derivative is f / distance2 = 2e-3 px/mm2, times 0.05 mm squared over 8: 1e-6 px.
    assert np.abs(pixels[:, 0] - np.flatnonzero(there)).max() < 2e-6
    assert np.abs(pixels[:, 1] - truth.centre_px[there]).max() < 2e-6
    assert np.array_equal(there, ~np.isnan(truth.centre_px))
    assert np.array_equal(there, truth.face >= 0)
    good = truth.status == Status.OK
    assert np.array_equal(good, truth.lit & truth.seen)
    assert np.array_equal(good, ~np.isnan(truth.edge_px))


@FEW
@given(d=st.floats(-40, 40), yaw=st.floats(-5, 5))
def test_moving_the_target_on_is_moving_the_head_back(d, yaw):
    here = sandwave({"position_mm": [0.0, 20.0, 0.0]}, head={"yaw_deg": yaw})
    there = sandwave({"position_mm": [0.0, 20.0 + d, 0.0]}, head={"yaw_deg": yaw})
    # 1e-6 px: where shadows end, the same to rounding; no column may change its status.
    same(stripe_truth(here, 60.0), stripe_truth(there, 60.0 + d), within=1e-6)


def test_many_positions_are_each_on_its_own():
    scene = block()
    for truth, s in zip(stripe_truths(scene, [-10.0, 30.0]), [-10.0, 30.0], strict=True):
        assert truth.position_mm == s
        same(truth, stripe_truth(scene, s), within=0)


def test_the_laser_s_shadow_of_a_step_is_as_long_as_drawn():
    scene = block()
    truth = stripe_truth(scene, 0.0)
    floor = len(surfaces_of(scene)) - 1
    right = -100.0 + GroovedBlock().edges_mm()[-1]
    # By similar triangles from the apex (0, 500) over the edge (right, top) to the floor.
    tip = right * (500 + 100) / (500 - (-100 + GroovedBlock().height_mm))
    x = truth.xz_mm[:, 0]
    beside = (truth.face == floor) & (x > right)
    assert np.array_equal(truth.lit[beside], x[beside] > tip)
    assert (beside & ~truth.lit).sum() > 10
    assert (beside & truth.lit).sum() > 10


def test_the_fan_ends_where_its_angle_says():
    scene = tank(laser={"fan_half_angle_deg": 12.0, "aim_deg": 5.0}, floor={"z_mm": -100.0})
    truth = stripe_truth(scene, 0.0)
    x = truth.xz_mm[:, 0]
    low, high = 600 * np.tan(np.radians([5 - 12, 5 + 12]))
    assert np.array_equal(truth.lit, (x > low) & (x < high))
    assert np.array_equal(truth.status == Status.OCCLUDED, ~truth.lit)


@pytest.mark.parametrize("y_mm", [-150.0, -80.0, -30.0])
def test_the_camera_s_shadow_of_a_screen_is_that_of_a_box(y_mm):
    scene = screen(y_mm)
    truth = stripe_truth(scene, 0.0)
    floor = len(surfaces_of(scene)) - 1
    on = truth.face == floor
    points = in_head(truth.xz_mm[on])
    entry = entry_points(scene, points)
    # A box: the line of sight is inside it where it is between all three pairs of planes.
    low, high = np.array([-105, y_mm, -300.0]), np.array([105, y_mm + 8, -140.0])
    with np.errstate(divide="ignore"):
        ends = np.sort(np.stack([low - entry, high - entry]) / (points - entry), axis=0)
    hit = ends[0].max(axis=1) < np.minimum(ends[1].min(axis=1), 1)
    assert np.array_equal(truth.seen[on], ~hit)


def test_walls_that_face_laser_and_camera_carry_the_line():
    # A groove's side, seen from the middle of the picture leaning in: some column holds it.
    scene = block()
    truth = stripe_truth(scene, 0.0)
    x, z = truth.xz_mm.T
    edges = -100 + GroovedBlock().edges_mm()
    walls = (truth.status == Status.OK) & np.any(np.abs(x[:, None] - edges) < 1e-9, axis=1)
    assert walls.any()
    assert np.all(z[walls] < -100 + GroovedBlock().height_mm)


def test_two_lines_in_a_column_give_the_upper_one_and_say_so():
    # A small plate off to the right, lit from the far left: its shadow falls beyond, and the
    # floor right behind it in the same columns is lit too.
    small = {"grid": {"columns": 3, "rows": 3, "pitch_mm": 10.0, "dot_diameter_mm": 2.0}}
    scene = tank(
        board={**small, "plate": {"margin_mm": 4.0}},
        target={"shape": "board", "position_mm": [150.0, -4.0, 0.0]},
        floor={"z_mm": -120.0},
        laser={"apex_mm": [-600.0, 0.0, 300.0], "aim_deg": 60.0, "fan_half_angle_deg": 50.0},
    )
    truth = stripe_truth(scene, 0.0)
    floor = len(surfaces_of(scene)) - 1
    two = truth.multiple
    assert two.sum() > 10
    assert np.all(truth.face[two] != floor)
    assert np.all(truth.status[two] == Status.OK)
    assert np.all(truth.centre_px[two] < np.nanmin(truth.centre_px[truth.face == floor]))


def test_no_laser_or_no_target_no_line():
    for scene in (tank(), tank(laser={"on": False}, floor={"z_mm": -100.0})):
        truth = stripe_truth(scene, 0.0)
        assert np.all(truth.status == Status.NO_PEAK)
        assert np.isnan(truth.centre_px).all()
        assert np.isnan(truth.xz_mm).all()
        assert not truth.multiple.any()


def test_rows_are_columns_of_a_camera_rolled():
    # Roll the camera by 90 degrees and swap the picture's sides: rows are the columns.
    upright = tank(
        floor={"z_mm": -100.0},
        lens={"centre_px": [319.0, 239.0], "focal_px": 600.0},
        camera={"width_px": 639, "height_px": 479},
    )
    rolled = tank(
        floor={"z_mm": -100.0},
        lens={"centre_px": [239.0, 319.0], "focal_px": 600.0},
        camera={"width_px": 479, "height_px": 639},
        head={"roll_deg": 90.0},
        stripe={"axis": "rows"},
    )
    a, b = stripe_truth(upright, 0.0), stripe_truth(rolled, 0.0)
    # The camera's x now points where its y did: u' = v, v' = 638 - u.
    assert b.axis == "rows"
    assert np.allclose(b.centre_px[::-1], a.centre_px, rtol=0, atol=1e-9, equal_nan=True)
    assert np.array_equal(b.status[::-1], a.status)


def test_edge_distance():
    status = np.array([0, 0, 0, 7, 0, 0, 0, 0, 1])
    continues = np.array([1, 1, 0, 0, 0, 1, 1, 0, 0], dtype=bool)
    expected = [0, 1, 0, np.nan, 0, 0, 1, 0, np.nan]
    assert np.array_equal(edge_distance(status, continues), expected, equal_nan=True)


def height(shape: Sandwave, x: np.ndarray, y: np.ndarray, wider_mm: float = 0.0) -> np.ndarray:
    """Top of the sandwave block over (x, y), written anew: wave, rim and wedges.

    wider_mm: by which the wedges reach farther inwards.
    """
    z = np.full_like(x, -shape.body_mm - 1e3)
    z[(np.abs(x - 75) <= 105) & (np.abs(y - 75) <= 105)] = 0.0
    wave = (x >= 0) & (x <= 150) & (y >= 0) & (y <= 150)
    z[wave] = ((1.5 + 0.043 * y) * np.sin(0.167 * x + 2.0 * np.sin(0.042 * y)))[wave]
    from_side = 105 - np.abs(x - 75)
    wedge = (from_side >= 0) & (from_side <= 26 * (1 - np.abs(y - 75) / 30) + wider_mm)
    z[wedge] = 10.0
    return z


@pytest.mark.parametrize(("s", "turn"), [(100.0, 0.0), (110.0, 4.0)])  # crests cast shadows
def test_what_hides_the_sandwave_is_found_by_brute_force(s, turn):
    scene = sandwave({"turn_deg": turn})
    truth = stripe_truth(scene, s)
    floor = len(surfaces_of(scene)) - 1
    on = (truth.face >= 0) & (truth.face < floor) & truth.lit
    points = in_head(truth.xz_mm[on])
    sheet, pose = head_pose(scene.tank.head, s), target_pose(scene)
    start = pose.invert(sheet.apply(entry_points(scene, points)))
    end = pose.invert(sheet.apply(points))
    length = np.linalg.norm(end - start, axis=1)
    away = np.linspace(0.0, 90.0, 4501)  # 0.02 mm apart; the line is above the block by 90 mm
    depth = np.empty((len(end), 2))
    for k in range(len(end)):
        x, y, z = (end[k] + away[:, None] * (start[k] - end[k]) / length[k]).T
        for side, wider in enumerate((-0.02, 0.02)):
            depth[k, side] = np.max((height(scene.rig.workpiece, x, y, wider) - z)[3:])
    # Nearer than 0.01 mm to grazing neither answer is certain (steps of 0.02 mm; the march's
    # 3 um), nor where the line starts along the surface, nor within a step of a wedge's side.
    hidden = depth > 0
    sure = (np.abs(depth) > 0.01).all(axis=1) & (hidden[:, 0] == hidden[:, 1])
    assert sure.mean() > 0.5
    assert np.array_equal(truth.seen[on][sure], ~hidden[sure, 0])


def test_the_low_camera_leaves_flanks_unseen():
    hidden = [
        np.count_nonzero((t.face == 0) & t.lit & ~t.seen)
        for t in stripe_truths(sandwave(), [80.0, 100.0, 120.0])
    ]
    assert max(hidden) > 10  # else the test above would test nothing


@FEW
@given(seed=st.integers(0, 2**31))
def test_polygons_hide_what_their_mesh_hides(seed):
    rng = np.random.default_rng(seed)
    scene = block()
    pose = target_pose(scene)
    start = rng.uniform([-300, -300, -100], [300, 300, 200], (300, 3))
    end = rng.uniform([-150, -80, -100], [150, 80, 0], (300, 3))
    ours = is_blocked(grooved_block_surfaces(GroovedBlock(), pose), start, end)
    assert np.array_equal(ours, Mesh(block_mesh(GroovedBlock(), pose)).blocks(start, end))
    assert 30 < ours.sum() < 300


@FEW
@given(seed=st.integers(0, 2**31))
def test_a_rough_mesh_hides_what_trimesh_says(seed):
    rng = np.random.default_rng(seed)
    axis = np.linspace(0, 20, 41)
    x, y = np.meshgrid(axis, axis, indexing="ij")
    vertices = np.stack([x, y, rng.uniform(0, 3, x.shape)], axis=-1).reshape(-1, 3)
    corner = (np.arange(40)[:, None] * 41 + np.arange(40)).ravel()
    faces = corner[:, None] + np.array([[0, 41, 42], [0, 42, 1]])[:, None]
    mesh = trimesh.Trimesh(vertices, faces.reshape(-1, 3), process=False)
    start = rng.uniform([-40, -40, 0], [60, 60, 40], (200, 3))
    end = rng.uniform([-5, -5, -1], [25, 25, 5], (200, 3))
    ray = end - start
    places, line, _ = mesh.ray.intersects_location(start, ray)
    left = np.linalg.norm(ray[line], axis=1) - np.linalg.norm(places - start[line], axis=1)
    expected = np.bincount(line[left > SELF_MM], minlength=200) > 0
    assert np.array_equal(Mesh(mesh).blocks(start, end), expected)
    assert 20 < expected.sum() < 180


def test_a_mesh_file_is_scanned_like_its_shape(tmp_path):
    scene = block()
    path = tmp_path / "block.obj"
    block_mesh(GroovedBlock(), Pose(np.eye(3), np.zeros(3))).export(path)  # eight decimals
    target = {"shape": "mesh", "file": str(path), "position_mm": [-100.0, 0.0, -100.0]}
    from_file = tank(target=target, floor={"z_mm": -100.0}, head={"yaw_deg": 0.0})
    a, b = stripe_truth(scene, 0.7), stripe_truth(from_file, 0.7)
    inner = (a.edge_px >= 1) | (a.status != Status.OK)
    assert np.array_equal(a.status[inner], b.status[inner])
    good = a.status == Status.OK
    assert np.abs(a.centre_px - b.centre_px)[good & inner].max() < 1e-6
    # An edge that falls on a column's middle may count for either side.
    assert np.abs(a.edge_px - b.edge_px)[good & (b.status == Status.OK)].max() <= 1


def sphere_on_plate(folder: Path, **sections: Any) -> Scene:
    """A ball of 30 mm that comes out of a plate 3 mm beneath its middle: one mesh, in one file."""
    ball = trimesh.creation.icosphere(subdivisions=5, radius=30.0)
    plate = trimesh.creation.box(bounds=[[-90, -60, -8], [90, 60, -3]])
    trimesh.util.concatenate([ball, plate]).export(folder / "ball.ply")
    target = {"shape": "mesh", "file": str(folder / "ball.ply"), "position_mm": [0, 0, -60.0]}
    return tank(target=target, **sections)


@pytest.mark.parametrize("position_mm", [0.0, -7.0, -25.0])
def test_edges_inside_a_mesh_are_edges(tmp_path, position_mm):
    """Where the line leaves the ball for the plate it jumps; on ball and plate it runs smoothly."""
    scene = sphere_on_plate(tmp_path)
    truth = stripe_truth(scene, position_mm)
    ok = truth.status == Status.OK
    on_plate = ok & (np.abs(truth.xz_mm[:, 1] + 63) < 1e-9)
    on_ball = ok & ~on_plate
    assert on_ball.sum() > 30 and on_plate.sum() > 60
    assert np.all(truth.face[ok] == 0)
    step = np.abs(np.diff(truth.centre_px))
    jumps = np.flatnonzero(ok[:-1] & ok[1:] & (on_plate[:-1] != on_plate[1:]))
    assert len(jumps) == 2 and np.all(step[jumps] > 6)
    assert np.all(truth.edge_px[jumps] == 0) and np.all(truth.edge_px[jumps + 1] == 0)
    assert np.all(step[np.isfinite(step) & (truth.edge_px[1:] > 0) & (truth.edge_px[:-1] > 0)] < 4)
    # No edge but where the kind of surface or the status changes: facets are none.
    kind = np.where(on_plate, 1, np.where(on_ball, 2, 0))
    starts = np.flatnonzero(np.diff(kind, prepend=-1))
    ends = np.append(starts[1:], len(kind)) - 1
    for start, end in zip(starts.tolist(), ends.tolist(), strict=True):
        run = np.arange(end - start + 1)
        if kind[start]:
            expected = np.minimum(run, run[::-1])
            assert np.array_equal(truth.edge_px[start : end + 1], expected)


def test_a_crease_is_an_edge_and_a_facet_is_none(tmp_path):
    """Tubes along the track: of 36 sides, which turn by 10 degrees, and of 8, by 45."""
    for sides, creased in ((36, False), (8, True)):
        tube = trimesh.creation.cylinder(radius=60.0, height=100.0, sections=sides)
        tube.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
        tube.export(tmp_path / "tube.ply")
        target = {"shape": "mesh", "file": str(tmp_path / "tube.ply"), "position_mm": [0, 0, -120]}
        truth = stripe_truth(tank(target=target), 0.0)
        inside = np.flatnonzero(truth.status == Status.OK)[3:-3]
        assert len(inside) > 60
        assert np.any(truth.edge_px[inside] == 0) == creased


def test_grains_of_sand_are_no_edges():
    # A block of 70 mm: the whole one has five million facets.
    small = {"kind": "sandwave", "side_mm": 60.0, "rim_mm": 5.0, "wedge": {"reach_mm": 4.0}}
    bare, sanded = (
        sandwave({"position_mm": [30.0, 0.0, 0.0], **coat}, workpiece=small)
        for coat in ({}, {"sand": {"grain_mm": 0.6}})
    )
    for scene in (bare, sanded):
        truth = stripe_truth(scene, 20.0)
        assert np.nanmax(truth.edge_px) > 30


def test_a_line_that_folds_over_jumps():
    """Two pieces of one chain in neighbouring columns, too far apart for their slopes."""
    folded = ColumnCrossings(
        column=np.array([0, 1, 2, 3]),
        centre_px=np.array([10.0, 11.0, 20.0, 21.2]),
        slope=np.array([1.0, 1.0, 1.0, 1.4]),
        xz_mm=np.zeros((4, 2)),
        face=np.zeros(4, dtype=int),
        chain=np.zeros(4, dtype=int),
    )
    continues = is_continued(folded, np.arange(4), np.full(4, int(Status.OK)))
    assert continues.tolist() == [True, False, True, False]


GRAZING = {"apex_mm": [-220.0, 0.0, 60.0], "aim_deg": 75.0, "fan_half_angle_deg": 40.0}


@FEW
@given(s=st.floats(5, 145), turn=st.floats(-5, 5), yaw=st.floats(-4, 4))
def test_slices_and_stripes_see_the_same(s, turn, yaw):
    """The slice's laser visibility marches in space; the stripe's sweeps in the sheet."""
    target = {"turn_deg": turn, "tilt_x_deg": 1.0}
    for laser in (LASER, GRAZING):  # from above, and along the crests
        scene = sandwave(target, laser=laser, head={"yaw_deg": yaw})
        truth = stripe_truth(scene, s)
        on = truth.face == 0  # the wave
        world = head_pose(scene.tank.head, s).apply(in_head(truth.xz_mm[on]))
        assert passing_mm(scene.tank.head, world) == pytest.approx(np.full(on.sum(), s), abs=1e-9)
        place = target_pose(scene).invert(world)
        found = slice_visibility(scene, place[:, :2])
        # Apart at most where a shadow's edge falls within the march's 3 um: a column or two.
        assert np.count_nonzero(found != (truth.status == Status.OK)[on]) <= 2


def test_the_grazing_laser_leaves_troughs_dark():
    truth = stripe_truth(sandwave(laser=GRAZING), 120.0)
    assert np.count_nonzero((truth.face == 0) & ~truth.lit) > 50  # else nothing was compared


def test_the_sheet_passes_where_yaw_says():
    head = sandwave(head={"yaw_deg": 10.0}).tank.head
    # The sheet through (0, s) runs along (cos 10, sin 10): at x = 100 it is 17.6 mm on.
    found = passing_mm(head, np.array([[100.0, 50.0, 3.0]]))
    assert found[0] == pytest.approx(50 - 100 * np.tan(np.radians(10)), abs=1e-12)


def test_slices_outside_the_picture_are_unseen():
    away = sandwave({"position_mm": [600.0, 0.0, 0.0]})
    assert not slice_visibility(away, np.array([[75.0, 75.0]])).any()
    assert slice_visibility(sandwave(), np.array([[75.0, 20.0]])).all()


def test_slices_of_sand_are_those_of_the_bare_shape():
    points = np.column_stack([np.linspace(1, 149, 50), np.full(50, 120.0)])
    sanded = sandwave({"sand": {"grain_mm": 0.4}})
    assert np.array_equal(slice_visibility(sanded, points), slice_visibility(sandwave(), points))


def test_slices_need_a_sandwave_and_finite_points():
    with pytest.raises(InputError, match="no sandwave"):
        slice_visibility(block(), np.array([[1.0, 1.0]]))
    with pytest.raises(InputError, match="slice points"):
        slice_visibility(sandwave(), np.array([[1.0, np.nan]]))
    with pytest.raises(InputError, match="slice points"):
        slice_visibility(sandwave(), np.zeros((2, 3)))
