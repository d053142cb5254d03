"""The target of a scene, and everything else that stands in the tank, as parts."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import shapely
import trimesh
from shapely.geometry import Point, Polygon, box
from shapely.ops import unary_union

from lscan.config.board import Board
from lscan.config.targets import GroovedBlock, Sandwave
from lscan.errors import InputError
from lscan.files.meshes import MM_PER_UNIT, UNREAD, load_mesh
from lscan.records import Floats
from sim.meshes.parts import (
    Finish,
    MeshPart,
    grid_faces,
    grooved_block_mesh,
    move_part,
    picture_paint,
    plain_mesh,
    plane_mesh,
    reflectance_at,
    rough_block_mesh,
    sanded_sandwave_mesh,
    sandwave_parts,
    vertex_paint,
)
from sim.scene import Scene, floor_corners_mm, target_pose
from sim.scene.errors import BoardErrors, TrueBoard
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


# The calibration board as meshes, exact to the board file but for its circles' corners.


# A polygon of so many corners departs from its circle by 3e-4 of the radius: 1 µm on a dot.
CIRCLE_CORNERS = 96
# Its corners lie that much farther out than the circle, so that its area and the mean radius
# of its outline are the circle's, to the fourth order of pi / corners.
CORNERS_OUT = 1 + (np.pi / CIRCLE_CORNERS) ** 2 / 3
BOARD_PARTS = ("plate", "marks", "plate-body")
BEHIND_MM = 1e-3  # that the plate's body lies behind plate and marks


def board_parts(
    board: Board, plate_albedo: float, mark_albedo: float, errors: BoardErrors | None = None
) -> list[MeshPart]:
    """The board in the head frame: plate with holes, marks in the holes, and the plate's back.

    The face lies in y = 0, or is bent about it, and looks towards the camera (-y); marks are flush
    with it, as drilled holes filled with clay are.
    """
    true = TrueBoard(board, errors or BoardErrors())
    marks = unary_union(_mark_polygons(true))
    left, right, bottom, top = board.outline_mm()
    plate = box(left, bottom, right, top)
    outside = marks.difference(plate)
    if not outside.is_empty:
        raise InputError("board: marks reach beyond the plate", allowed="a larger margin_mm")
    albedos = {"dark": (plate_albedo, mark_albedo), "bright": (mark_albedo, plate_albedo)}
    ground, ink = albedos[board.marks]
    face = _face_mesh(true, plate.difference(marks)), _face_mesh(true, marks)
    meshes = *face, plate_mesh(true, BEHIND_MM)
    return [
        MeshPart(*part) for part in zip(BOARD_PARTS, meshes, (ground, ink, ground), strict=True)
    ]


def plate_mesh(true: TrueBoard, front_mm: float = 0.0) -> trimesh.Trimesh:
    """The plate without marks, closed, in the board's frame.

    Parameters
    ----------
    true : TrueBoard, of whose facets front and back are made
    front_mm : float, mm, how far behind the board's face its own lies
    """
    if not true.is_bent:
        left, right, bottom, top = true.board.outline_mm()
        back_mm = true.board.plate.thickness_mm
        return trimesh.creation.box(bounds=[[left, front_mm, bottom], [right, back_mm, top]])
    x, z = true.facets_mm()
    across, up = np.meshgrid(x, z)
    count, index = across.size, np.arange(across.size).reshape(across.shape)
    planes = [
        np.column_stack([across.ravel(), np.full(count, y), up.ravel()])
        for y in (front_mm, true.board.plate.thickness_mm)
    ]
    front = grid_faces(*across.shape)
    here = np.concatenate([index[0, :-1], index[:-1, -1], index[-1, :0:-1], index[:0:-1, 0]])
    there = np.roll(here, -1)
    sides = [(here, here + count, there), (there, here + count, there + count)]
    faces = [front, front[:, ::-1] + count, *(np.column_stack(side) for side in sides)]
    return plain_mesh(true.bent(np.vstack(planes)), np.vstack(faces))


def _face_mesh(true: TrueBoard, shape: shapely.Geometry) -> trimesh.Trimesh:
    """What lies in the board's face within a shape; cut along the facets where that is bent."""
    if not true.is_bent:
        return plane_mesh(shape, (0, 2))
    left, right, bottom, top = true.board.outline_mm()
    x, z = true.facets_mm()
    columns, rows = shapely.box(x[:-1], bottom, x[1:], top), shapely.box(left, z[:-1], right, z[1:])
    pieces = shapely.get_parts(shapely.intersection(shape, columns))
    pieces = shapely.get_parts(shapely.intersection(pieces[:, np.newaxis], rows).ravel())
    mesh = plane_mesh(shapely.MultiPolygon(pieces[shapely.area(pieces) > 0].tolist()), (0, 2))
    mesh.vertices = true.bent(np.asarray(mesh.vertices))
    return mesh


def _mark_polygons(true: TrueBoard) -> list[Polygon]:
    board, (grid, *rulers, dots, rings) = true.board, true.shifts_mm()

    def discs(places: Floats, diameter_mm: float, shifts: Floats) -> list[Polygon]:
        pairs = zip(places, shifts, strict=True)
        return [_printed_outline(true, _disc(place, diameter_mm), shift) for place, shift in pairs]

    polygons = discs(board.grid.points_mm(), board.grid.dot_diameter_mm, grid)
    for ruler, shifts in zip(board.ruler, rulers, strict=True):
        polygons += discs(ruler.points_mm(), ruler.mark_diameter_mm, shifts)
    for dot, shift in zip(board.dot, dots, strict=True):
        polygons += discs(np.array([[dot.x_mm, dot.z_mm]]), dot.diameter_mm, shift[np.newaxis])
    for ring, shift in zip(board.ring, rings, strict=True):
        centre = np.array([ring.x_mm, ring.z_mm])
        outer = _disc(centre, ring.diameter_mm + ring.width_mm)
        milled = outer.difference(_disc(centre, ring.diameter_mm - ring.width_mm))
        polygons.append(_printed_outline(true, milled, shift))
    return polygons


def _printed_outline(true: TrueBoard, mark: Polygon, shift: Floats) -> Polygon:
    """A nominal mark as it is printed."""
    return shapely.transform(mark, lambda places: true.printed_places(places, shift))


def _disc(centre: Floats, diameter_mm: float) -> Polygon:
    return Point(*centre).buffer(diameter_mm / 2 * CORNERS_OUT, quad_segs=CIRCLE_CORNERS // 4)
