"""The calibration board as meshes, exact to the board file but for its circles' corners."""

import numpy as np
import trimesh
from shapely.geometry import Point, Polygon, box
from shapely.ops import unary_union

from lscan.config.board import Board
from lscan.errors import InputError
from lscan.records import Floats
from sim.meshes.parts import MeshPart, plane_mesh

# A polygon of so many corners departs from its circle by 3e-4 of the radius: 1 µm on a dot.
CIRCLE_CORNERS = 96
# Its corners lie that much farther out than the circle, so that its area and the mean radius
# of its outline are the circle's, to the fourth order of pi / corners.
CORNERS_OUT = 1 + (np.pi / CIRCLE_CORNERS) ** 2 / 3


def board_parts(board: Board, plate_albedo: float, mark_albedo: float) -> list[MeshPart]:
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
        MeshPart("plate", plane_mesh(plate.difference(marks), (0, 2)), ground),
        MeshPart("marks", plane_mesh(marks, (0, 2)), ink),
        MeshPart("plate-body", body, ground),
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
    return Point(*centre).buffer(diameter_mm / 2 * CORNERS_OUT, quad_segs=CIRCLE_CORNERS // 4)
