"""Meshes against the nominal shapes they are made from."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from drawn_examples import examples
from hypothesis import given, strategies as st
from places import SCENES

from lscan.config.board import Board, Grid
from lscan.config.targets import GroovedBlock, Sandwave
from lscan.errors import InputError
from lscan.files.meshes import load_mesh
from sim.meshes import Finish, reflectance_at, scene_parts, target_parts
from sim.meshes.parts import (
    WAVE_STEP_MM,
    grooved_block_mesh,
    luminance,
    sanded_sandwave_mesh,
    sandwave_parts,
)
from sim.meshes.target import CIRCLE_CORNERS, board_parts
from sim.scene import Scene, load_scene
from sim.scene.matter import Sand, Texture
from tests.validation.light.gallery import scene_files

GALLERY = SCENES
SCENES = GALLERY / "paper"
FILES = scene_files(GALLERY)
# With a = pi / corners a polygon whose corners lie 1 + a²/3 times as far out as the circle has
# the circle's area times (1 - 2a²/3 + 2a⁴/15)(1 + a²/3)² = 1 - a⁴/5, and rings likewise.
FOURTH_ORDER = (np.pi / CIRCLE_CORNERS) ** 4 / 4
PAIRS = ((500.0, 0.1), (600.0, 0.3), (650.0, 0.7))


def with_target(name: str, **changes: object) -> Scene:
    """The paper's scene of this name with other fields of its target."""
    scene = load_scene(SCENES / f"{name}.toml")
    target = scene.tank.target.model_copy(update=changes)
    return replace(scene, tank=scene.tank.model_copy(update={"target": target}))


def circle_area(diameter: float) -> float:
    """Area of a circle, which the polygon that stands for it keeps."""
    return np.pi * (diameter / 2) ** 2


def test_board_marks_have_the_areas_of_the_board_file() -> None:
    """Every dot, mark and ring is there once, and holes and marks fill the plate exactly."""
    scene = load_scene(SCENES / "board.toml")
    board = scene.rig.board
    assert board is not None
    plate, marks, _ = board_parts(board, 0.8, 0.1)
    dots = board.grid.columns * board.grid.rows * circle_area(board.grid.dot_diameter_mm)
    rulers = sum(len(r.points_mm()) * circle_area(r.mark_diameter_mm) for r in board.ruler)
    named = sum(circle_area(d.diameter_mm) for d in board.dot)
    rings = sum(
        circle_area(r.diameter_mm + r.width_mm) - circle_area(r.diameter_mm - r.width_mm)
        for r in board.ring
    )
    assert marks.mesh.area == pytest.approx(dots + rulers + named + rings, rel=FOURTH_ORDER)
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
    # S1 and S3 lie at amplitudes of 2 and 7.5 mm (docs/explanation/physics.md, section 9).
    ends = piece.slices_mm()
    assert ends["S1"][0][1] == pytest.approx(11.6, abs=0.05)
    assert ends["S3"][0][1] == pytest.approx(139.5, abs=0.05)


@pytest.mark.parametrize(("grain", "seed"), [(1.1, 3), (3.0, 4)])
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


def test_a_users_mesh_is_a_target(tmp_path: Path) -> None:
    path = tmp_path / "stone.ply"
    trimesh.creation.icosphere(radius=30).export(path)
    text = (SCENES / "groove.toml").read_text().replace("rig.toml", str(SCENES / "rig.toml"))
    text = text.replace('shape = "workpiece"', 'shape = "mesh"\nfile = "stone.ply"')
    (tmp_path / "scene.toml").write_text(text)
    names = [part.name for part in scene_parts(load_scene(tmp_path / "scene.toml"))]
    assert names == ["mesh", "floor"]


@pytest.mark.parametrize("path", FILES, ids=[str(path.relative_to(GALLERY)) for path in FILES])
def test_every_scene_stands(path: Path) -> None:
    """It loads, all its files are there, and its target has the finish it asks for."""
    scene = load_scene(path)
    parts = target_parts(scene)
    assert parts
    assert {part.finish.kind for part in parts} == {scene.tank.target.finish}
    assert all(0 <= part.albedo <= 1 for part in parts)
    assert path.name in (GALLERY / "README.md").read_text(encoding="utf-8")


def test_the_red_block_is_dark_under_the_green_laser() -> None:
    red, green = (
        target_parts(load_scene(GALLERY / "targets" / f"{name}.toml"))[0].albedo
        for name in ("red", "red-under-green")
    )
    assert (red, green) == (0.65, 0.05)


@given(nm=st.floats(500, 650))
@examples(50)
def test_an_albedo_is_linear_between_its_pairs(nm: float) -> None:
    expected = 0.1 + (nm - 500) * 0.002 if nm <= 600 else 0.3 + (nm - 600) * 0.008
    assert reflectance_at(PAIRS, nm) == pytest.approx(expected, rel=1e-12)
    assert reflectance_at(0.25, nm) == 0.25


@pytest.mark.parametrize("nm", [499.9, 650.1])
def test_an_albedo_is_not_guessed_beyond_its_pairs(nm: float) -> None:
    with pytest.raises(InputError, match=rf"here: albedo.*{nm}.*500 to 650"):
        reflectance_at(PAIRS, nm, where="here")


def test_a_scene_whose_laser_lies_beyond_the_albedo_is_refused() -> None:
    with pytest.raises(InputError, match=r"groove\.toml: target\.albedo.*650.*450 to 600"):
        target_parts(with_target("groove", albedo=((450.0, 0.1), (600.0, 0.3))))


def test_every_part_has_the_targets_finish_and_the_floor_none() -> None:
    scene = with_target("sandwave", finish="wet", roughness=0.2, coat_index=1.6)
    *target, floor = scene_parts(scene)
    assert {part.finish for part in target} == {Finish("wet", 0.2, 1.6)}
    assert floor.finish == Finish()


@examples(20)
@given(
    corner=st.tuples(st.floats(-100, 100), st.floats(-100, 100)),
    size=st.tuples(st.floats(1, 300), st.floats(1, 300)),
    turn=st.floats(-180, 180),
)
def test_a_texture_is_laid_in_the_targets_frame(
    corner: tuple[float, float], size: tuple[float, float], turn: float
) -> None:
    """Vertices at corner + uv size, wherever the target stands; 0 to 1 are 0 to 255."""
    checks = GALLERY / "targets" / "checks.png"
    texture = Texture(file=str(checks), corner_mm=corner, size_mm=size)
    scene = with_target("groove", texture=texture, turn_deg=turn)
    block = grooved_block_mesh(GroovedBlock())
    paint = scene_parts(scene)[0].paint
    assert paint is not None
    np.testing.assert_allclose(np.array(corner) + paint.uv * size, block.vertices[:, :2], atol=1e-9)
    assert paint.levels.shape == (32, 32)
    # 10 mm checks of grey 230 and 70, a bright one at the upper left.
    assert paint.levels[0, 0] == paint.levels[-1, -1] == pytest.approx(230 / 255)
    assert paint.levels[-1, 0] == paint.levels[0, -1] == pytest.approx(70 / 255)


def test_a_texture_covers_a_boards_plate_but_not_its_marks() -> None:
    checks = GALLERY / "targets" / "checks.png"
    texture = Texture(file=str(checks), corner_mm=(-30.0, -480.0), size_mm=(510.0, 510.0))
    plate, marks, body = target_parts(with_target("board", texture=texture))
    assert marks.paint is None
    assert plate.paint is not None
    assert body.paint is not None
    # The plate reaches 30 mm beyond a grid of 450 by 450 mm: the picture fits it exactly.
    np.testing.assert_allclose(plate.paint.uv.min(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(plate.paint.uv.max(axis=0), 1, atol=1e-12)


def test_grey_is_the_luminance_of_a_colour() -> None:
    """Equal components are their own grey level, and BT.709 weighs the others."""
    grey = np.arange(256, dtype=np.uint8)
    np.testing.assert_allclose(luminance(np.stack([grey] * 3, axis=-1)), grey, rtol=1e-12)
    colours = np.array([[100, 0, 0], [0, 100, 0], [0, 0, 100]], dtype=np.uint8)
    np.testing.assert_allclose(luminance(colours), [21.26, 71.52, 7.22])
    np.testing.assert_array_equal(luminance(grey.reshape(16, 16)), grey.reshape(16, 16))


def test_vertex_colours_are_levels_of_a_ramp() -> None:
    """The mound's bands: two colours, whose luminances the ramp gives back."""
    (mound,) = target_parts(load_scene(GALLERY / "targets" / "coloured-mesh.toml"))
    assert mound.paint is not None
    (low, high), u = mound.paint.levels[0], mound.paint.uv[:, 0]
    levels = low + (high - low) * (u - 0.25) / 0.5
    bands = luminance(np.array([[120, 90, 60], [240, 230, 220]], dtype=np.uint8)) / 255
    np.testing.assert_allclose(np.unique(levels.round(9)), bands, atol=1e-9)


def test_a_mesh_whose_faces_are_coloured_is_as_bright_as_they_are(tmp_path: Path) -> None:
    """Half of grey 128 and white: each triangle is of one level."""
    path = tmp_path / "two.off"
    path.write_text(
        "OFF\n4 2 0\n0 0 0\n9 0 0\n9 9 0\n0 9 0\n3 0 1 2 128 128 128\n3 0 2 3 255 255 255\n"
    )
    (part,) = target_parts(with_target("groove", shape="mesh", file=str(path)))
    assert part.paint is not None
    levels = (part.paint.uv[part.mesh.faces, 0] - 0.25) / 0.5
    np.testing.assert_allclose(levels, [[128 / 255] * 3, [1.0] * 3], atol=1e-12)


def test_a_mesh_whose_materials_are_not_read_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "cad.obj"
    path.write_text("mtllib cad.mtl\nusemtl steel\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(InputError, match=r"target\.file: .*cad\.obj: .*mtllib cad\.mtl, usemtl st"):
        target_parts(with_target("groove", shape="mesh", file=str(path)))


def test_a_mesh_does_not_take_colours_and_a_texture() -> None:
    mound = GALLERY / "targets" / "mound.ply"
    texture = Texture(file=str(GALLERY / "targets" / "checks.png"), size_mm=(10.0, 10.0))
    scene = with_target("groove", shape="mesh", file=str(mound), texture=texture)
    with pytest.raises(InputError, match=r"texture.*vertex colours.*mound\.ply"):
        target_parts(scene)


def test_a_mesh_without_colours_is_merged_and_takes_a_texture(tmp_path: Path) -> None:
    """An STL file repeats every vertex for every triangle; 12 of a box are 8 corners."""
    path = tmp_path / "box.stl"
    trimesh.creation.box(extents=[10, 20, 30]).export(path)
    texture = Texture(file=str(GALLERY / "targets" / "checks.png"), size_mm=(10.0, 10.0))
    (part,) = target_parts(with_target("groove", shape="mesh", file=str(path), texture=texture))
    assert len(part.mesh.vertices) == 8
    assert part.mesh.is_watertight
    assert part.paint is not None
    np.testing.assert_allclose(np.abs(part.paint.uv), [[0.5, 1.0]] * 8)


def test_a_mesh_with_a_vertex_at_infinity_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "far.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv nan 1 0\nv 0 1 0\nf 1 2 3\nf 1 2 4\n")
    with pytest.raises(InputError, match=r"far\.obj: has vertices that are not finite"):
        load_mesh(path)


@pytest.mark.parametrize("name", ["groove", "board"])
def test_sand_goes_with_a_sandwave_only(name: str) -> None:
    with pytest.raises(InputError, match=r"sand goes with a sandwave only"):
        target_parts(with_target(name, sand=Sand()))
