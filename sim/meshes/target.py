"""The target of a scene, and everything else that stands in the tank, as parts."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh

from lscan.config.targets import GroovedBlock, Sandwave
from lscan.errors import InputError
from lscan.files.meshes import MM_PER_UNIT, UNREAD, load_mesh
from sim.meshes.board import board_parts
from sim.meshes.parts import (
    Finish,
    MeshPart,
    move_part,
    picture_paint,
    plain_mesh,
    reflectance_at,
    vertex_paint,
)
from sim.meshes.workpieces import (
    grooved_block_mesh,
    rough_block_mesh,
    sanded_sandwave_mesh,
    sandwave_parts,
)
from sim.scene import Scene, floor_corners_mm, target_pose
from sim.scene.matter import Texture

MARKS = "marks"  # the one part of a board that a texture leaves as it is


def scene_parts(scene: Scene) -> list[MeshPart]:
    """All parts that stand in the tank, in the world frame, mm.

    Parameters
    ----------
    scene : Scene, its target and its floor

    Raises
    ------
    InputError
        As ``target_parts``.
    """
    pose = target_pose(scene)
    parts = [move_part(part, pose) for part in target_parts(scene)]
    if (floor := scene.tank.floor) is not None:
        square = plain_mesh(floor_corners_mm(scene), np.array([[0, 1, 2], [0, 2, 3]]))
        parts.append(MeshPart("floor", square, floor.albedo))
    return parts


def target_mesh(scene: Scene) -> trimesh.Trimesh:
    """The whole target, without the floor, as one mesh in the world frame, mm.

    Parameters
    ----------
    scene : Scene, its target

    Raises
    ------
    InputError
        As ``target_parts``.
    """
    pose = target_pose(scene)
    meshes = [move_part(part, pose).mesh for part in target_parts(scene)]
    return trimesh.util.concatenate(meshes) if meshes else trimesh.Trimesh()


def target_parts(scene: Scene) -> list[MeshPart]:
    """The target's parts in its own frame (workpiece, board or mesh file), mm, finished.

    Their albedo is the one at the laser's nominal wavelength: a drift of some nm does not
    change it.

    Parameters
    ----------
    scene : Scene, its target

    Raises
    ------
    InputError
        Sand does not go with the target, a mesh or a picture cannot be read, or the albedo is not
        given at that wavelength.
    """
    target = scene.tank.target
    if target.shape == "none":
        return []
    where = f"{scene.source}: target.albedo"
    albedo = reflectance_at(target.albedo, scene.tank.laser.wavelength_nm, where)
    finish = Finish(target.finish, target.roughness, target.coat_index)
    parts = [replace(part, finish=finish) for part in _bare_parts(scene, albedo)]
    if target.texture is None:
        return parts
    return [_with_texture(part, scene, target.texture) for part in parts]


def _bare_parts(scene: Scene, albedo: float) -> list[MeshPart]:
    """The target's parts as its shape makes them, matt and without a texture."""
    target, rig = scene.tank.target, scene.rig
    is_sandwave = target.shape == "workpiece" and isinstance(rig.workpiece, Sandwave)
    if target.sand is not None and not is_sandwave:
        raise InputError("target.sand goes with a sandwave only", where=scene.source)
    if target.shape == "mesh":
        with _naming_file(scene, "target.file"):
            mesh = load_mesh(Path(target.file or ""), MM_PER_UNIT[target.unit or "mm"])
            if UNREAD in mesh.metadata:
                raise InputError(
                    "states a reflectance that is not read: take it out of the file, or colour "
                    "the vertices or faces by it",
                    where=target.file,
                    value=mesh.metadata[UNREAD],
                    allowed="colours of a PLY, OBJ or OFF file's vertices or faces",
                )
        return [MeshPart("mesh", mesh, albedo, paint=vertex_paint(mesh))]
    if target.rough is not None:
        return [MeshPart("rough", rough_block_mesh(target.rough), albedo)]
    if target.shape == "board":
        assert rig.board is not None  # sim.scene has checked it
        return board_parts(rig.board, albedo, target.mark_albedo, scene.tank.board_errors)
    if isinstance(rig.workpiece, GroovedBlock):
        return [MeshPart("grooved-block", grooved_block_mesh(rig.workpiece), albedo)]
    assert isinstance(rig.workpiece, Sandwave)
    if target.sand is not None:
        return [MeshPart("sand", sanded_sandwave_mesh(rig.workpiece, target.sand), albedo)]
    return sandwave_parts(rig.workpiece, albedo)


def _with_texture(part: MeshPart, scene: Scene, texture: Texture) -> MeshPart:
    """The part with the texture laid over it, seen along -y where it is a board, else from z."""
    if part.name == MARKS:
        return part
    target = scene.tank.target
    if part.paint is not None:
        what = "target.texture does not go with a mesh that has vertex colours"
        raise InputError(what, where=scene.source, value=target.file)
    plane = (0, 2) if target.shape == "board" else (0, 1)
    with _naming_file(scene, "target.texture.file"):
        paint = picture_paint(texture, part.mesh.vertices[:, plane])
    return replace(part, paint=paint)


@contextmanager
def _naming_file(scene: Scene, key: str) -> Iterator[None]:
    """Put the scene and the key before an InputError about the file that the key names."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{key}: {error}", where=scene.source) from error
