"""The paper's test pieces as meshes in their workpiece frames."""

import numpy as np
import trimesh
from shapely.geometry import Polygon, box

from lscan.config.targets import GroovedBlock, Sandwave
from lscan.records import Floats
from sim.meshes.parts import MeshPart, grid_faces, plain_mesh, plane_mesh

# Chord error of the sandwave's facets: step² · max|z''| / 8 = 0.25 · 0.22 / 8 = 7 µm.
WAVE_STEP_MM = 0.5


def grooved_block_mesh(block: GroovedBlock) -> trimesh.Trimesh:
    """The grooved block in its workpiece frame."""
    prism = trimesh.creation.extrude_polygon(Polygon(block.outline_mm()), block.length_mm)
    x, z, along = prism.vertices.T
    turned = np.column_stack([x, block.length_mm / 2 - along, z])
    return plain_mesh(turned, prism.faces)


def sandwave_parts(piece: Sandwave, albedo: float) -> list[MeshPart]:
    """The sandwave block in its workpiece frame: wave, curtain to the rim, rim, body, wedges."""
    wave, border = _wave_patch(piece)
    rest = [_curtain(border), _rim(piece), sandwave_body(piece), *_wedges(piece)]
    return [
        MeshPart("sandwave", wave, albedo, smooth=True),
        MeshPart("block", trimesh.util.concatenate(rest), albedo),
    ]


def _wave_patch(piece: Sandwave) -> tuple[trimesh.Trimesh, Floats]:
    """The wave's mesh and its border, (N, 3), counter-clockwise and closed."""
    count = int(np.ceil(piece.side_mm / WAVE_STEP_MM)) + 1
    axis = np.linspace(0.0, piece.side_mm, count)
    x, y = np.meshgrid(axis, axis)
    z = piece.height_mm(x, y)
    points = np.stack([x, y, z], axis=-1)
    mesh = plain_mesh(points.reshape(-1, 3), grid_faces(count, count))
    mesh.vertex_normals = piece.normals(x.ravel(), y.ravel())
    sides = [points[0], points[:, -1], points[-1, ::-1], points[::-1, 0]]
    return mesh, np.concatenate(sides)


def _curtain(border: Floats) -> trimesh.Trimesh:
    """The upright strip between the wave's border and the rim's level z = 0."""
    count = len(border)
    foot = border * [1.0, 1.0, 0.0]
    i = np.arange(count - 1)
    faces = np.vstack(
        [np.column_stack([i, i + 1, i + count]), np.column_stack([i + 1, i + count + 1, i + count])]
    )
    return plain_mesh(np.vstack([border, foot]), faces)


def _rim(piece: Sandwave) -> trimesh.Trimesh:
    low, high = -piece.rim_mm, piece.side_mm + piece.rim_mm
    ring = box(low, low, high, high).difference(box(0, 0, piece.side_mm, piece.side_mm))
    return plane_mesh(ring, (0, 1))


def sandwave_body(piece: Sandwave) -> trimesh.Trimesh:
    """Sides and underside of the sandwave block: a box without its lid."""
    low, high = -piece.rim_mm, piece.side_mm + piece.rim_mm
    body = trimesh.creation.box(bounds=[[low, low, -piece.body_mm], [high, high, 0.0]])
    return body.submesh([body.face_normals[:, 2] < 0.5], append=True)


def _wedges(piece: Sandwave) -> list[trimesh.Trimesh]:
    return [
        trimesh.creation.extrude_polygon(Polygon(plan), piece.wedge.height_mm)
        for plan in piece.wedge_plans_mm()
    ]
