"""The section: everything in the tank, cut by the laser sheet."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from lscan.config.targets import GroovedBlock, Sandwave
from lscan.records import Floats, Ints, Mask
from sim.meshes import target_mesh
from sim.meshes.parts import plain_mesh
from sim.meshes.target import plate_mesh
from sim.scene import Pose, Scene, floor_corners_mm, target_pose
from sim.scene.errors import TrueBoard
from sim.truth.sheet import Bow
from sim.truth.surfaces import (
    Mesh,
    Polygon,
    TankSurface,
    between,
    extrusion,
    sandwave_surfaces,
    spread,
)

# Which pieces of a section make up one smooth line, without gap or crease.


JOINED_MM = 1e-6  # ends of two pieces as near as this are one: rounding is 1e-12 mm
# A line that turns by more has an edge there, one that turns by less is a round surface in
# facets: the feature angle that mesh tools take by default lies between 20 and 40 degrees.
CREASE_DEG = 30.0


def chains(ends_mm: Floats, face: Ints, creased: Mask) -> Ints:
    """Which pieces of a section lie on one smooth line.

    Parameters
    ----------
    ends_mm
        (M, 2, 2) two ends of (x, z) of each straight piece, in the sheet's plane.
    face
        (M,) surface of each; a line does not go from one to another.
    creased
        (M,) whether an edge is seen where the piece meets the next at an angle.

    Returns
    -------
    (M,) the number of the line that each piece is part of.
    """
    count = len(ends_mm)
    if count == 0:
        return np.empty(0, dtype=int)
    pairs = cKDTree(ends_mm.reshape(-1, 2)).query_pairs(JOINED_MM, output_type="ndarray")
    away = (ends_mm[:, ::-1] - ends_mm).reshape(-1, 2)  # from either end to the other
    length = np.linalg.norm(away, axis=1)
    first, second = pairs[np.all(length[pairs] > JOINED_MM, axis=1)].T
    turn = np.einsum("ij,ij->i", away[first], away[second]) / (length[first] * length[second])
    smooth = -turn >= np.cos(np.radians(CREASE_DEG))
    a, b = first // 2, second // 2
    kept = (face[a] == face[b]) & (smooth | ~creased[a])
    links = coo_array((np.ones(kept.sum()), (a[kept], b[kept])), shape=(count, count))
    return np.asarray(connected_components(links, directed=False)[1], dtype=int)


# The section: everything in the tank, cut by the laser sheet.


@dataclass(frozen=True)
class TargetSection:
    """A section as straight pieces, in no particular order.

    ends_mm: (M, 2, 2) two ends of (x, z) of each piece, in the sheet's plane (sim.truth.sheet).
    face: (M,) index of the surface it belongs to, in the list of ``surfaces_of``.
    chain: (M,) number of the smooth line without gap or crease that it is part of.
    """

    ends_mm: Floats
    face: Ints
    chain: Ints

    def only(self, kept: Mask) -> "TargetSection":
        """The pieces where ``kept``, (M,), is true."""
        return TargetSection(self.ends_mm[kept], self.face[kept], self.chain[kept])


def surfaces_of(scene: Scene) -> list[TankSurface]:
    """All surfaces of the scene in the world frame: the target's, then the floor if any.

    Parameters
    ----------
    scene : Scene, its target and its floor

    Raises
    ------
    InputError
        The target's mesh cannot be made.
    """
    surfaces = target_surfaces(scene)
    floor = scene.tank.floor
    return surfaces if floor is None else [*surfaces, Polygon(floor_corners_mm(scene))]


def target_surfaces(scene: Scene) -> list[TankSurface]:
    """The target's surfaces: analytic where its shape is, else its mesh.

    Parameters
    ----------
    scene : Scene, its target
    """
    target, rig, pose = scene.tank.target, scene.rig, target_pose(scene)
    if target.shape == "none":
        return []
    if target.shape in ("mesh", "rough") or target.sand is not None:
        return [Mesh(target_mesh(scene), creased=target.shape == "mesh")]
    if target.shape == "board":
        return board_surfaces(scene.true_board(), pose)
    if isinstance(rig.workpiece, GroovedBlock):
        return grooved_block_surfaces(rig.workpiece, pose)
    assert isinstance(rig.workpiece, Sandwave)
    return sandwave_surfaces(rig.workpiece, pose)


def board_surfaces(true: TrueBoard, pose: Pose) -> list[TankSurface]:
    """The plate: its face, with the marks, in y = 0 of its frame, its body behind.

    A bent one is a mesh of its facets, those that are rendered.
    """
    if true.is_bent:
        plate = plate_mesh(true)
        return [Mesh(plain_mesh(pose.apply(np.asarray(plate.vertices)), plate.faces))]
    left, right, bottom, top = true.board.outline_mm()
    outline = np.array([[left, bottom], [right, bottom], [right, top], [left, top]])
    return prism(outline, 0.0, true.board.plate.thickness_mm, pose)


def grooved_block_surfaces(block: GroovedBlock, pose: Pose) -> list[TankSurface]:
    """The block's two ends, then its long faces in the order of its outline."""
    half = block.length_mm / 2
    return prism(block.outline_mm(), -half, half, pose)


def prism(outline: Floats, front_mm: float, back_mm: float, pose: Pose) -> list[TankSurface]:
    """The faces of a (K, 2) outline in (x, z) drawn out along y from front to back."""
    base = np.column_stack([outline[:, 0], np.full(len(outline), front_mm), outline[:, 1]])
    faces = extrusion(base, np.array([0.0, back_mm - front_mm, 0.0]))
    return [Polygon(pose.apply(face)) for face in faces]


def section_at(
    surfaces: Sequence[TankSurface], sheet: Pose, bow: Bow | None = None
) -> TargetSection:
    """The section of the surfaces by a sheet; sheet: frame of its plane to world frame.

    A flat sheet cuts polygons exactly, the sandwave within 1e-4 mm, meshes as their triangles
    lie; a bowed one polygons and meshes within 1e-4 mm (sim.truth.sheet.FACET_MM).
    Faces that lie in a flat sheet have no section.
    """
    pieces = [surface.cut(sheet, bow) for surface in surfaces]
    face = np.repeat(np.arange(len(pieces)), [len(piece) for piece in pieces])
    ends = np.concatenate([np.empty((0, 2, 2)), *pieces])
    creased = np.array([isinstance(surface, Mesh) and surface.creased for surface in surfaces])
    return TargetSection(ends, face, chains(ends, face, creased[face]))


def split(section: TargetSection, longest_mm: float) -> TargetSection:
    """The same section in pieces no longer than ``longest_mm``."""
    start, end = section.ends_mm[:, 0], section.ends_mm[:, 1]
    count = np.ceil(np.linalg.norm(end - start, axis=1) / longest_mm).astype(int)
    count = np.maximum(count, 1)
    owner, step = spread(count)
    parts = np.stack([step, step + 1]) / count[owner]
    ends = [between(start[owner], end[owner], part) for part in parts]
    return TargetSection(np.stack(ends, axis=1), section.face[owner], section.chain[owner])
