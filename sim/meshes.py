"""Meshes of what stands in the tank, exact to the nominal shapes, in mm.

Each shape is a few parts; a part is a triangle mesh of one diffuse albedo.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from shapely.geometry import MultiPolygon, Point, Polygon, box
from shapely.ops import unary_union

from lscan.board import Board
from lscan.errors import InputError
from lscan.records import Floats, Ints
from lscan.targets import GroovedBlock, Sandwave
from sim.scene import FLOOR_HALF_SIDE_MM, Floor, Pose, Sand, Scene, target_pose

# A circle of 96 corners deviates from the true one by 5e-4 of its radius: 1.3 µm on a dot.
CIRCLE_CORNERS = 96
# Chord error of the sandwave's facets: step² · max|z''| / 8 = 0.25 · 0.22 / 8 = 7 µm.
WAVE_STEP_MM = 0.5
# Facets a grain: fewer would flatten the caps.
FACETS_PER_GRAIN = 3


@dataclass(frozen=True)
class Part:
    """A mesh of one material; smooth: shade it with interpolated vertex normals."""

    name: str
    mesh: trimesh.Trimesh
    albedo: float
    smooth: bool = False


def scene_parts(scene: Scene) -> list[Part]:
    """All parts that stand in the tank, in the world frame."""
    pose = target_pose(scene)
    parts = [_moved(part, pose) for part in target_parts(scene)]
    if scene.tank.floor is not None:
        parts.append(floor_part(scene.tank.floor))
    return parts


def target_mesh(scene: Scene) -> trimesh.Trimesh:
    """The whole target, without the floor, as one mesh in the world frame."""
    pose = target_pose(scene)
    meshes = [_moved(part, pose).mesh for part in target_parts(scene)]
    return trimesh.util.concatenate(meshes) if meshes else trimesh.Trimesh()


def target_parts(scene: Scene) -> list[Part]:
    """The target's parts in its own frame (workpiece, board or mesh file)."""
    target, rig = scene.tank.target, scene.rig
    if target.sand is not None and not isinstance(rig.workpiece, Sandwave):
        raise InputError("target.sand goes with a sandwave only", where=scene.source)
    if target.shape == "none":
        return []
    if target.shape == "mesh":
        return [Part("mesh", load_mesh(Path(target.file or "")), target.albedo)]
    if target.shape == "board":
        assert rig.board is not None  # sim.scene has checked it
        return board_parts(rig.board, target.albedo, target.mark_albedo)
    if isinstance(rig.workpiece, GroovedBlock):
        return [Part("grooved-block", grooved_block_mesh(rig.workpiece), target.albedo)]
    assert isinstance(rig.workpiece, Sandwave)
    if target.sand is not None:
        coated = sanded_sandwave_mesh(rig.workpiece, target.sand)
        return [Part("sand", coated, target.albedo)]
    return sandwave_parts(rig.workpiece, target.albedo)


def load_mesh(path: Path) -> trimesh.Trimesh:
    """A user's mesh file, in mm; InputError where it cannot be read or has no triangles."""
    try:
        mesh = trimesh.load_mesh(path)
    except Exception as error:  # trimesh raises whatever its format readers raise
        raise InputError(f"is not a mesh that can be read: {error}", where=path) from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise InputError("holds no triangles", where=path)
    if not np.isfinite(mesh.vertices).all():
        raise InputError("has vertices that are not finite", where=path)
    return mesh


def floor_part(floor: Floor) -> Part:
    """The tank's floor, a level square in the world frame."""
    s = FLOOR_HALF_SIDE_MM
    corners = [[-s, -s], [s, -s], [s, s], [-s, s]]
    vertices = np.column_stack([corners, np.full(4, floor.z_mm)])
    return Part("floor", _mesh(vertices, np.array([[0, 1, 2], [0, 2, 3]])), floor.albedo)


def board_parts(board: Board, plate_albedo: float, mark_albedo: float) -> list[Part]:
    """The board in the head frame: plate with holes, marks in the holes, and the plate's back.

    The face lies in y = 0 and looks towards the camera (-y); marks are flush with it, as
    drilled holes filled with clay are.
    """
    marks = unary_union(_mark_polygons(board))
    left, right, bottom, top = board.outline_mm()
    plate = box(left, bottom, right, top)
    outside = marks.difference(plate)
    if not outside.is_empty:
        raise InputError("board: marks reach beyond the plate", allowed="a larger margin_mm")
    albedos = {"dark": (plate_albedo, mark_albedo), "bright": (mark_albedo, plate_albedo)}
    ground, ink = albedos[board.marks]
    body = trimesh.creation.box(
        bounds=[[left, 1e-3, bottom], [right, board.plate.thickness_mm, top]]
    )
    return [
        Part("plate", _face_mesh(plate.difference(marks)), ground),
        Part("marks", _face_mesh(marks), ink),
        Part("plate-body", body, ground),
    ]


def _mark_polygons(board: Board) -> list[Polygon]:
    discs = [(point, board.grid.dot_diameter_mm) for point in board.grid.points_mm()]
    for ruler in board.ruler:
        discs += [(point, ruler.mark_diameter_mm) for point in ruler.points_mm()]
    discs += [(np.array([dot.x_mm, dot.z_mm]), dot.diameter_mm) for dot in board.dot]
    polygons = [_disc(centre, diameter) for centre, diameter in discs]
    for ring in board.ring:
        centre = np.array([ring.x_mm, ring.z_mm])
        outer = _disc(centre, ring.diameter_mm + ring.width_mm)
        polygons.append(outer.difference(_disc(centre, ring.diameter_mm - ring.width_mm)))
    return polygons


def _disc(centre: Floats, diameter_mm: float) -> Polygon:
    return Point(*centre).buffer(diameter_mm / 2, quad_segs=CIRCLE_CORNERS // 4)


def _face_mesh(shape: Polygon | MultiPolygon) -> trimesh.Trimesh:
    """Triangles of a plane shape in (x, z), laid in y = 0 and facing -y."""
    polygons = shape.geoms if isinstance(shape, MultiPolygon) else [shape]
    meshes = []
    for polygon in polygons:
        plan, faces = trimesh.creation.triangulate_polygon(polygon, engine="earcut")
        vertices = np.column_stack([plan[:, 0], np.zeros(len(plan)), plan[:, 1]])
        meshes.append(_facing(vertices, faces, np.array([0.0, -1.0, 0.0])))
    return trimesh.util.concatenate(meshes)


def grooved_block_mesh(block: GroovedBlock) -> trimesh.Trimesh:
    """The grooved block in its workpiece frame."""
    prism = trimesh.creation.extrude_polygon(Polygon(block.outline_mm()), block.length_mm)
    x, z, along = prism.vertices.T
    turned = np.column_stack([x, block.length_mm / 2 - along, z])
    return _mesh(turned, prism.faces)


def sandwave_parts(piece: Sandwave, albedo: float) -> list[Part]:
    """The sandwave block in its workpiece frame: wave, curtain to the rim, rim, body, wedges."""
    wave, border = _wave_patch(piece)
    rest = [_curtain(border), _rim(piece), _body(piece), *_wedges(piece)]
    return [
        Part("sandwave", wave, albedo, smooth=True),
        Part("block", trimesh.util.concatenate(rest), albedo),
    ]


def _wave_patch(piece: Sandwave) -> tuple[trimesh.Trimesh, Floats]:
    """The wave's mesh and its border, (N, 3), counter-clockwise and closed."""
    count = int(np.ceil(piece.side_mm / WAVE_STEP_MM)) + 1
    axis = np.linspace(0.0, piece.side_mm, count)
    x, y = np.meshgrid(axis, axis)
    z = piece.height_mm(x, y)
    points = np.stack([x, y, z], axis=-1)
    mesh = _mesh(points.reshape(-1, 3), _grid_faces(count, count))
    mesh.vertex_normals = _wave_normals(piece, x.ravel(), y.ravel())
    sides = [points[0], points[:, -1], points[-1, ::-1], points[::-1, 0]]
    return mesh, np.concatenate(sides)


def _wave_normals(piece: Sandwave, x: Floats, y: Floats) -> Floats:
    """(N, 3) unit normals of eq. (4) from its derivatives."""
    phase = piece.c_per_mm * x + piece.d_rad * np.sin(piece.e_per_mm * y)
    amplitude = piece.a_mm + piece.b * y
    z_x = amplitude * piece.c_per_mm * np.cos(phase)
    phase_y = piece.d_rad * piece.e_per_mm * np.cos(piece.e_per_mm * y)
    z_y = piece.b * np.sin(phase) + amplitude * phase_y * np.cos(phase)
    normals = np.column_stack([-z_x, -z_y, np.ones_like(z_x)])
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def _curtain(border: Floats) -> trimesh.Trimesh:
    """The upright strip between the wave's border and the rim's level z = 0."""
    count = len(border)
    foot = border * [1.0, 1.0, 0.0]
    i = np.arange(count - 1)
    faces = np.vstack(
        [np.column_stack([i, i + 1, i + count]), np.column_stack([i + 1, i + count + 1, i + count])]
    )
    return _mesh(np.vstack([border, foot]), faces)


def _rim(piece: Sandwave) -> trimesh.Trimesh:
    low, high = -piece.rim_mm, piece.side_mm + piece.rim_mm
    ring = box(low, low, high, high).difference(box(0, 0, piece.side_mm, piece.side_mm))
    plan, faces = trimesh.creation.triangulate_polygon(ring, engine="earcut")
    return _facing(np.column_stack([plan, np.zeros(len(plan))]), faces, np.array([0, 0, 1.0]))


def _body(piece: Sandwave) -> trimesh.Trimesh:
    """Sides and underside: a box without its lid."""
    low, high = -piece.rim_mm, piece.side_mm + piece.rim_mm
    body = trimesh.creation.box(bounds=[[low, low, -piece.body_mm], [high, high, 0.0]])
    return body.submesh([body.face_normals[:, 2] < 0.5], append=True)


def _wedges(piece: Sandwave) -> list[trimesh.Trimesh]:
    return [
        trimesh.creation.extrude_polygon(Polygon(plan), piece.wedge.height_mm)
        for plan in piece.wedge_plans_mm()
    ]


def sanded_sandwave_mesh(piece: Sandwave, sand: Sand) -> trimesh.Trimesh:
    """The block's whole upper side under a coat of grains, and its body, workpiece frame.

    The grains lie on a jittered square pack; each is a sphere sunk to its middle, so the
    coat is the upper envelope of their caps.
    """
    step = sand.grain_mm / FACETS_PER_GRAIN
    low, high = -piece.rim_mm, piece.side_mm + piece.rim_mm
    count = int(np.ceil((high - low) / step)) + 1
    axis = np.linspace(low, high, count)
    x, y = np.meshgrid(axis, axis)
    z = _bare_height(piece, x, y) + _coat_height(sand, x - low, y - low)
    top = _mesh(np.column_stack([x.ravel(), y.ravel(), z.ravel()]), _grid_faces(count, count))
    return trimesh.util.concatenate([top, _body(piece)])


def _bare_height(piece: Sandwave, x: Floats, y: Floats) -> Floats:
    """Height of the uncoated block at (x, y): wave, rim or wedge."""
    inside = (x >= 0) & (x <= piece.side_mm) & (y >= 0) & (y <= piece.side_mm)
    z = np.where(inside, piece.height_mm(x, y), 0.0)
    wedge, middle = piece.wedge, piece.side_mm / 2
    share = 1 - np.abs(y - middle) / (wedge.base_mm / 2)
    from_side = np.minimum(x + piece.rim_mm, piece.side_mm + piece.rim_mm - x)
    return np.where(from_side <= wedge.reach_mm * share, wedge.height_mm, z)


def _coat_height(sand: Sand, x: Floats, y: Floats) -> Floats:
    """Height of the grains' envelope at (x, y), both from 0 upwards."""
    generator = np.random.default_rng(sand.seed)
    cells = int(np.ceil(max(x.max(), y.max()) / sand.grain_mm)) + 3
    jitter = generator.uniform(-0.25, 0.25, (2, cells, cells))
    radius = sand.grain_mm / 2 * generator.uniform(1 - sand.spread, 1 + sand.spread, (cells, cells))
    column, row = (x / sand.grain_mm).astype(int) + 1, (y / sand.grain_mm).astype(int) + 1
    height = np.zeros_like(x)
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            i, j = row + down, column + right
            centre_x = (j - 0.5 + jitter[0, i, j]) * sand.grain_mm
            centre_y = (i - 0.5 + jitter[1, i, j]) * sand.grain_mm
            cap = radius[i, j] ** 2 - (x - centre_x) ** 2 - (y - centre_y) ** 2
            height = np.maximum(height, np.sqrt(np.maximum(cap, 0.0)))
    return height


def _grid_faces(rows: int, columns: int) -> Ints:
    """Two triangles a cell of a grid of vertices laid row by row, facing up."""
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b = index[:-1, :-1].ravel(), index[:-1, 1:].ravel()
    c, d = index[1:, 1:].ravel(), index[1:, :-1].ravel()
    return np.vstack([np.column_stack([a, b, c]), np.column_stack([a, c, d])])


def _facing(vertices: Floats, faces: Ints, towards: Floats) -> trimesh.Trimesh:
    """The mesh with every triangle wound so that its normal looks ``towards``."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    away = np.einsum("ij,j->i", np.cross(b - a, c - a), towards) < 0
    wound = np.where(away[:, None], faces[:, ::-1], faces)
    return _mesh(vertices, wound)


def _mesh(vertices: Floats, faces: Ints) -> trimesh.Trimesh:
    return trimesh.Trimesh(vertices, faces, process=False)


def _moved(part: Part, pose: Pose) -> Part:
    mesh = part.mesh.copy()
    normals = mesh.vertex_normals @ pose.rotation.T if part.smooth else None
    mesh = _mesh(pose.apply(np.asarray(mesh.vertices)), mesh.faces)
    if normals is not None:
        mesh.vertex_normals = normals
    return Part(part.name, mesh, part.albedo, part.smooth)
