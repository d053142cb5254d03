"""The section of the target: closed forms, and trimesh's section of the same shape."""

import numpy as np
import pytest
import shapely
import trimesh
from drawn_examples import examples
from hypothesis import given, strategies as st
from truth_scenes import BOARD, block_mesh, tank

from lscan.config.targets import GroovedBlock, Sandwave
from lscan.errors import InputError
from sim.meshes.parts import grid_faces, plain_mesh
from sim.scene import Pose, head_pose, rotation
from sim.truth.surfaces import (
    Mesh,
    Polygon,
    TargetSection,
    Wave,
    area,
    grooved_block_surfaces,
    sandwave_surfaces,
    section_at,
    split,
    spread,
    surfaces_of,
)

MANY = examples(30)
TILT = st.floats(-8, 8)
POSE = st.builds(
    lambda x, y, z, at: Pose(rotation("ZYX", (z, y, x)), np.array(at)),
    TILT,
    TILT,
    st.floats(-40, 40),
    st.tuples(st.floats(-50, 50), st.floats(-20, 20), st.floats(-400, -100)),
)
SHEET = st.builds(
    lambda yaw, s: Pose(rotation("Z", yaw), np.array([0.0, s, 0.0])), TILT, st.floats(-30, 30)
)


def lengths(ends: np.ndarray) -> np.ndarray:
    """(M,) of pieces (M, 2, 2)."""
    return np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)


def slab() -> trimesh.Trimesh:
    """A level grid from y = 0 to 40, two triangles a cell."""
    x, y = np.meshgrid(np.arange(5) * 10.0, np.arange(5) * 10.0)
    return plain_mesh(np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()]), grid_faces(5, 5))


@pytest.mark.parametrize("y", [0.0, 10.0, 25.0, 40.0])
def test_a_sheet_meets_a_mesh_from_its_first_row_to_its_last(y: float) -> None:
    """Once, on the rows between too; a block's end is an end of its long faces."""
    sheet = Pose(np.eye(3), np.array([0.0, y, 0.0]))
    assert lengths(section_at([Mesh(slab())], sheet).ends_mm).sum() == pytest.approx(40.0)
    corners = np.array([[0.0, 0, 0], [40, 0, 0], [40, 40, 0], [0, 40, 0]])
    assert lengths(section_at([Polygon(corners)], sheet).ends_mm).sum() == pytest.approx(40.0)


@pytest.mark.parametrize("y", [-1e-6, 40.000001])
def test_a_sheet_beyond_a_mesh_does_not_meet_it(y: float) -> None:
    assert len(section_at([Mesh(slab())], Pose(np.eye(3), np.array([0.0, y, 0.0]))).ends_mm) == 0


def test_a_hole_and_what_is_wound_twice_are_outside():
    outer = np.array([[0, 0], [4, 0], [4, 4], [0, 4.0]])
    inner = np.array([[1, 1], [3, 1], [3, 3], [1, 3.0]])
    ring = np.vstack([outer, outer[:1], inner, inner[:1]])
    points = np.array([[0.5, 0.4], [2.0, 2.1], [0.5, 3.6], [5.0, 1.0]])
    assert shapely.contains_xy(area(ring), points).tolist() == [True, False, True, False]
    turns = np.exp(4j * np.pi * np.arange(5) / 5)  # a star drawn in one go
    star = area(np.column_stack([turns.real, turns.imag]))
    assert shapely.contains_xy(star, [[0.0, 0.0], [0.8, 0.0]]).tolist() == [False, True]


@MANY
@given(pose=POSE, sheet=SHEET)
def test_the_block_is_cut_as_trimesh_cuts_it(pose, sheet):
    block = GroovedBlock()
    ours = section_at(grooved_block_surfaces(block, pose), sheet).ends_mm
    theirs = Mesh(block_mesh(block, pose)).cut(sheet)
    # The same curve cut into other pieces: same length, and the same moments of length.
    # 1e-6: trimesh takes vertices within 1e-8 of the plane as in it.
    assert lengths(ours).sum() == pytest.approx(lengths(theirs).sum(), abs=1e-6)
    for power in (1, 2):
        here, there = (
            np.sum(lengths(ends)[:, None] * gauss_mean(ends, power), axis=0)
            for ends in (ours, theirs)
        )
        assert here == pytest.approx(there, rel=1e-9, abs=1e-4)


def gauss_mean(ends: np.ndarray, power: int) -> np.ndarray:
    """(M, 2) mean of x**power and z**power along pieces, by two-point Gauss (exact to 3)."""
    nodes = (0.5 - 0.5 / np.sqrt(3), 0.5 + 0.5 / np.sqrt(3))
    points = [(1 - t) * ends[:, 0] + t * ends[:, 1] for t in nodes]
    return sum(p**power for p in points) / 2


@MANY
@given(pose=POSE, sheet=SHEET)
def test_the_section_of_the_wave_lies_on_it_and_in_the_sheet(pose, sheet):
    shape = Sandwave()
    ends = Wave(shape, pose).cut(sheet)
    points = np.concatenate([ends.reshape(-1, 2), ends.mean(axis=1)])
    world = sheet.apply(np.column_stack([points[:, 0], np.zeros(len(points)), points[:, 1]]))
    x, y, z = pose.invert(world).T
    off = np.abs(z - shape.height_mm(x, y))
    corners = 2 * len(ends)
    # Corners: 1e-10, rounding of places some 400 mm from the origin.  Middles of the chords, and
    # where the square's border cuts one: the sag w2/8 z'', w = 0.05 mm, z'' at most
    # 8 (k + m)2 + ... = 0.6 /mm, twice for the tilt.
    border = np.maximum(np.abs(x - 75), np.abs(y - 75)) > 75 - 1e-9
    assert off[:corners][~border[:corners]].max(initial=0) < 1e-10
    assert off.max(initial=0) < 2 * 0.05**2 / 8 * 0.6
    assert np.all((x > -1e-9) & (x < 150 + 1e-9) & (y > -1e-9) & (y < 150 + 1e-9))


def test_the_sandwave_block_closes():
    # Square to the sheet: outline of the block plus what lies inside the solid (the rim under
    # a wedge, the foot of the wedge): cut through the wedges' tips.
    shape = Sandwave()
    pose = Pose(np.eye(3), np.array([0.0, -75.0, 0.0]))
    section = section_at(sandwave_surfaces(shape, pose), Pose(np.eye(3), np.zeros(3)))
    ends = section.ends_mm
    level = np.all(ends[..., 1] == shape.wedge.height_mm, axis=1)
    assert lengths(ends[level]).sum() == pytest.approx(2 * shape.wedge.reach_mm, abs=1e-10)
    assert [ends[..., 0].min(), ends[..., 0].max()] == pytest.approx([-30, 180], abs=1e-12)
    assert [ends[..., 1].min(), ends[..., 1].max()] == pytest.approx([-32, 10], abs=1e-12)
    # The walls between wave and rim: from eq. (4) at the border to 0.
    for x in (0.0, 150.0):
        height = shape.height_mm(np.array(x), np.array(75.0))
        wall = np.all(np.abs(ends[..., 0] - x) < 1e-12, axis=1)
        assert lengths(ends[wall]).sum() == pytest.approx(abs(height), abs=3e-4)


def test_a_sandwave_on_its_side_is_refused():
    scene = tank(workpiece={"kind": "sandwave"}, target={"shape": "workpiece", "tilt_x_deg": 60.0})
    with pytest.raises(InputError, match=r"tilted too far.*60.0 degrees"):
        section_at(surfaces_of(scene), head_pose(scene.tank.head, 0.0))


def test_nothing_in_the_tank_has_no_section():
    scene = tank()
    assert surfaces_of(scene) == []
    assert section_at([], head_pose(scene.tank.head, 0.0)).ends_mm.shape == (0, 2, 2)


def test_a_face_in_the_sheet_has_no_section():
    square = Polygon(np.array([[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1.0]]))
    assert square.cut(Pose(np.eye(3), np.zeros(3))).shape == (0, 2, 2)


def test_floor_and_board_stand_where_they_should():
    scene = tank(
        board=BOARD,
        target={"shape": "board", "position_mm": [20.0, -3.0, 5.0]},
        floor={"z_mm": -200.0},
    )
    section = section_at(surfaces_of(scene), head_pose(scene.tank.head, 0.0))
    plate = section.ends_mm[section.face < section.face.max()].reshape(-1, 2)
    assert plate.min(axis=0) == pytest.approx([20 - 30, 5 - 100 - 30], abs=1e-12)
    assert plate.max(axis=0) == pytest.approx([20 + 150 + 30, 5 + 30], abs=1e-12)
    floor = section.ends_mm[section.face == section.face.max()]
    assert np.all(floor[..., 1] == -200.0)


@MANY
@given(seed=st.integers(0, 2**31), longest=st.floats(0.05, 3))
def test_split_keeps_the_curve(seed, longest):
    rng = np.random.default_rng(seed)
    whole = TargetSection(rng.uniform(-5, 5, (7, 2, 2)), np.arange(7), np.arange(7))
    parts = split(whole, longest)
    assert lengths(parts.ends_mm).max() <= longest * (1 + 1e-12)
    for face in range(7):
        own = parts.ends_mm[parts.face == face]
        assert np.allclose(own[0, 0], whole.ends_mm[face, 0], atol=1e-12)
        assert np.allclose(own[-1, 1], whole.ends_mm[face, 1], atol=1e-12)
        assert np.allclose(own[1:, 0], own[:-1, 1], atol=1e-12)


def test_spread():
    owner, step = spread(np.array([2, 0, 3]))
    assert owner.tolist() == [0, 0, 2, 2, 2]
    assert step.tolist() == [0, 1, 0, 1, 2]
