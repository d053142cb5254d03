"""Meshes against the nominal shapes they are made from."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from lscan.board import Board, Grid
from lscan.errors import InputError
from lscan.targets import GroovedBlock, Sandwave
from sim.meshes import (
    CIRCLE_CORNERS,
    WAVE_STEP_MM,
    board_parts,
    grooved_block_mesh,
    load_mesh,
    sanded_sandwave_mesh,
    sandwave_parts,
    scene_parts,
    target_mesh,
)
from sim.scene import Sand, load_scene

SCENES = Path(__file__).resolve().parents[2] / "scenes" / "paper"


def polygon_area(diameter: float) -> float:
    """Area of the regular polygon that stands for a circle."""
    n = CIRCLE_CORNERS
    return n / 2 * (diameter / 2) ** 2 * np.sin(2 * np.pi / n)


def test_board_marks_have_the_areas_of_the_board_file() -> None:
    """Every dot, mark and ring is there once, and holes and marks fill the plate exactly."""
    scene = load_scene(SCENES / "board.toml")
    board = scene.rig.board
    assert board is not None
    plate, marks, _ = board_parts(board, 0.8, 0.1)
    dots = board.grid.columns * board.grid.rows * polygon_area(board.grid.dot_diameter_mm)
    rulers = sum(len(r.points_mm()) * polygon_area(r.mark_diameter_mm) for r in board.ruler)
    named = sum(polygon_area(d.diameter_mm) for d in board.dot)
    rings = sum(
        polygon_area(r.diameter_mm + r.width_mm) - polygon_area(r.diameter_mm - r.width_mm)
        for r in board.ring
    )
    assert marks.mesh.area == pytest.approx(dots + rulers + named + rings, rel=1e-9)
    left, right, bottom, top = board.outline_mm()
    assert plate.mesh.area + marks.mesh.area == pytest.approx((right - left) * (top - bottom))
    for part in (plate, marks):
        np.testing.assert_allclose(part.mesh.face_normals, [[0, -1, 0]] * len(part.mesh.faces))
        np.testing.assert_array_equal(part.mesh.vertices[:, 1], 0)


def test_bright_marks_swap_the_albedos() -> None:
    board = Board(marks="bright", grid=Grid(columns=3, rows=3, pitch_mm=20, dot_diameter_mm=5))
    plate, marks, _ = board_parts(board, 0.8, 0.1)
    assert (plate.albedo, marks.albedo) == (0.1, 0.8)


def test_grooved_block_is_watertight_and_has_its_volume() -> None:
    """Volume = cross-section, by the shoelace formula, times length."""
    block = GroovedBlock()
    mesh = grooved_block_mesh(block)
    x, z = block.outline_mm().T
    section = 0.5 * abs(np.dot(x, np.roll(z, -1)) - np.dot(z, np.roll(x, -1)))
    assert mesh.is_watertight
    assert abs(mesh.volume) == pytest.approx(section * block.length_mm, rel=1e-9)
    assert mesh.bounds[:, 1] == pytest.approx([-60, 60])


def test_wave_lies_on_equation_4_within_its_chord_error() -> None:
    """Facet centres are off by at most step^2/8 (|z_xx| + 2|z_xy| + |z_yy|) at its largest."""
    piece = Sandwave()
    wave = sandwave_parts(piece, 0.5)[0]
    centres = wave.mesh.triangles_center
    error = centres[:, 2] - piece.height_mm(centres[:, 0], centres[:, 1])
    amplitude = piece.a_mm + piece.b * piece.side_mm
    slope_y = piece.d_rad * piece.e_per_mm
    curvature = (
        amplitude * (piece.c_per_mm + slope_y) ** 2
        + 2 * piece.b * (piece.c_per_mm + slope_y)
        + amplitude * piece.d_rad * piece.e_per_mm**2
    )
    assert np.abs(error).max() <= WAVE_STEP_MM**2 / 8 * curvature
    np.testing.assert_array_equal(
        wave.mesh.vertices[:, 2],
        piece.height_mm(wave.mesh.vertices[:, 0], wave.mesh.vertices[:, 1]),
    )


def test_wave_normals_are_perpendicular_to_the_wave() -> None:
    piece = Sandwave()
    wave = sandwave_parts(piece, 0.5)[0]
    normals = np.asarray(wave.mesh.vertex_normals)
    x, y, _ = wave.mesh.vertices.T
    h = 1e-4
    z_x = (piece.height_mm(x + h, y) - piece.height_mm(x - h, y)) / (2 * h)
    z_y = (piece.height_mm(x, y + h) - piece.height_mm(x, y - h)) / (2 * h)
    # Central differences: error h^2/6 |z'''| < 1e-9.
    np.testing.assert_allclose(normals[:, 0] + z_x * normals[:, 2], 0, atol=1e-8)
    np.testing.assert_allclose(normals[:, 1] + z_y * normals[:, 2], 0, atol=1e-8)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1)


def test_wedges_stand_where_the_nominal_shape_says() -> None:
    piece = Sandwave()
    block = sandwave_parts(piece, 0.5)[1].mesh
    top = block.vertices[np.isclose(block.vertices[:, 2], piece.wedge.height_mm)]
    for tip in piece.wedge_tips_mm():
        assert np.isclose(top[:, :2], tip).all(axis=1).any()
    # S1 and S3 lie at amplitudes of 2 and 7.5 mm (paper-notes 1).
    ends = piece.slices_mm()
    assert ends["S1"][0][1] == pytest.approx(11.6, abs=0.05)
    assert ends["S3"][0][1] == pytest.approx(139.5, abs=0.05)


@settings(max_examples=5, deadline=None, derandomize=True)
@given(grain=st.floats(0.8, 3.0), seed=st.integers(0, 100))
def test_sand_lies_on_the_block_no_thicker_than_its_grains(grain: float, seed: int) -> None:
    piece, sand = Sandwave(), Sand(grain_mm=grain, seed=seed)
    coated = sanded_sandwave_mesh(piece, sand)
    x, y, z = coated.vertices.T
    calm = (x > 1) & (x < 149) & (y > 1) & (y < 149) & (z > -piece.body_mm)
    height = z[calm] - piece.height_mm(x[calm], y[calm])
    assert height.min() >= -1e-9
    assert height.max() <= grain / 2 * (1 + sand.spread) + 1e-9
    # Half-sunk spheres on a square pack: an envelope between a quarter and a half grain.
    assert 0.2 * grain < height.mean() < 0.5 * grain


@settings(max_examples=20, deadline=None, derandomize=True)
@given(turn=st.floats(-180, 180), tilt=st.floats(-20, 20), x=st.floats(-100, 100))
def test_placing_a_target_is_rigid(turn: float, tilt: float, x: float) -> None:
    scene = load_scene(SCENES / "groove.toml")
    target = scene.tank.target.model_copy(
        update={"turn_deg": turn, "tilt_x_deg": tilt, "position_mm": (x, 2.0, -3.0)}
    )
    moved = target_mesh(replace(scene, tank=scene.tank.model_copy(update={"target": target})))
    bare = grooved_block_mesh(GroovedBlock())
    assert abs(moved.volume) == pytest.approx(abs(bare.volume), rel=1e-9)
    np.testing.assert_allclose(
        np.linalg.norm(np.diff(moved.vertices[:20], axis=0), axis=1),
        np.linalg.norm(np.diff(bare.vertices[:20], axis=0), axis=1),
        atol=1e-9,
    )


def test_a_users_mesh_is_a_target(tmp_path: Path) -> None:
    path = tmp_path / "stone.ply"
    trimesh.creation.icosphere(radius=30).export(path)
    text = (SCENES / "groove.toml").read_text().replace("rig.toml", str(SCENES / "rig.toml"))
    text = text.replace('shape = "workpiece"', 'shape = "mesh"\nfile = "stone.ply"')
    (tmp_path / "scene.toml").write_text(text)
    names = [part.name for part in scene_parts(load_scene(tmp_path / "scene.toml"))]
    assert names == ["mesh", "floor"]


@pytest.mark.parametrize("content", [b"", b"not a mesh", b"ply\nformat ascii 1.0\nend_header\n"])
def test_a_broken_mesh_is_one_clear_error(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "broken.ply"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"broken\.ply"):
        load_mesh(path)


def test_a_missing_mesh_is_one_clear_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nowhere\.stl"):
        load_mesh(tmp_path / "nowhere.stl")
