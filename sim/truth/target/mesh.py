"""A triangle mesh as a surface: sections by trimesh, lines of sight by a grid in plan."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import trimesh

from lscan.records import Floats, Ints, Mask
from sim.scene import Pose
from sim.truth.bow import Bow, bowed_pieces
from sim.truth.target.surfaces import TOUCHING_MM, spread, stretch

CELL_TRIANGLES = 2.0  # a cell's side over that of a triangle, about
MOST_CELLS = 1000  # along a side of the grid
ROUNDING_MM = 1e-6  # by which boxes are widened
EDGE = 1e-12  # relative: a line through an edge meets one of its two triangles at least


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh in the world frame, mm.

    creased: whether its creases are edges of the line; those of a coat of sand are roughness.
    """

    mesh: trimesh.Trimesh
    creased: bool = True

    def cut(self, sheet: Pose, bow: Bow | None = None) -> Floats:
        """(M, 2, 2) pieces of the section, in no particular order; one a triangle if flat.

        An edge in a flat sheet is one, whichever side of it has triangles.
        """
        if bow is not None:
            vertices = sheet.invert(np.asarray(self.mesh.vertices))
            return bowed_pieces(vertices, np.asarray(self.mesh.faces), bow)[..., [0, 2]]
        pieces = trimesh.intersections.mesh_plane(
            self.mesh, plane_normal=sheet.rotation[:, 1], plane_origin=sheet.origin_mm
        )
        last = self._edges_before(sheet)
        corners = np.concatenate([np.asarray(pieces, dtype=float).reshape(-1, 3), last])
        return sheet.invert(corners)[:, [0, 2]].reshape(-1, 2, 2)

    def _edges_before(self, sheet: Pose) -> Floats:
        """(2 M, 3) ends of the edges in a sheet whose triangles all lie before it.

        Trimesh counts those with a triangle behind.
        """
        height = (np.asarray(self.mesh.vertices) - sheet.origin_mm) @ sheet.rotation[:, 1]
        side = np.where(np.abs(height) <= TOUCHING_MM, 0, np.sign(height))[self.mesh.faces]
        on_edge = (side == 0).sum(axis=1) == 2
        faces, side = np.asarray(self.mesh.faces)[on_edge], side[on_edge]
        edges = np.sort(faces[side == 0].reshape(-1, 2), axis=1)
        behind = side.sum(axis=1) > 0
        known = set(map(tuple, edges[behind].tolist()))
        last = [edge for edge in set(map(tuple, edges[~behind].tolist())) if edge not in known]
        return np.asarray(self.mesh.vertices)[np.array(sorted(last), dtype=int).ravel()]

    def blocks(self, start: Floats, end: Floats) -> Mask:
        """(N,) whether a triangle comes between starts and ends."""
        first, last = stretch(start, end, self._grid.low_mm, self._grid.high_mm)
        inside = np.flatnonzero(first < last)
        first, last = first[inside, np.newaxis], last[inside, np.newaxis]
        ray = end[inside] - start[inside]
        here, there = start[inside] + first * ray, start[inside] + last * ray
        line, triangle = self._grid.along(here, there)
        hit = meets(here[line], there[line], self._corners[triangle])
        blocked = np.zeros(len(start), dtype=bool)
        blocked[inside[line[hit]]] = True
        return blocked

    def normals(self, places: Floats) -> Floats:
        """(N, 3) unit normals of the triangles that places of the world lie on."""
        return np.asarray(self.mesh.face_normals)[self.triangles_at(places)]

    def triangles_at(self, places: Floats) -> Ints:
        """(N,) the triangles that (N, 3) places of the surface, world frame, lie on."""
        place, triangle = self._grid.around(places)
        nearest = trimesh.triangles.closest_point(self._corners[triangle], places[place])
        away = np.linalg.norm(nearest - places[place], axis=1)
        order = np.lexsort([away, place])
        _, first = np.unique(place[order], return_index=True)
        return triangle[order[first]]

    @cached_property
    def _corners(self) -> Floats:
        return np.asarray(self.mesh.triangles, dtype=float)

    @cached_property
    def _grid(self) -> "PlanGrid":
        return PlanGrid(self._corners)


class PlanGrid:
    """Triangles sorted into square cells of the (x, y) plane.

    low_mm, high_mm: (3,) corners of the box that holds all.
    """

    def __init__(self, corners: Floats) -> None:
        """Sort triangles by their (T, 3, 3) corners, mm."""
        lowest, highest = corners.min(axis=1), corners.max(axis=1)
        self.low_mm = lowest.min(axis=0) - ROUNDING_MM
        self.high_mm = highest.max(axis=0) + ROUNDING_MM
        size = (self.high_mm - self.low_mm)[:2]
        side = CELL_TRIANGLES * np.sqrt(size.prod() / len(corners))
        self._side = max(side, size.max() / MOST_CELLS)
        self._shape = np.ceil(size / self._side).astype(int)
        triangle, cell = self._under(lowest, highest)
        count = int(self._shape.prod())
        # The z that a cell's triangles lie between.
        self._bottom, self._top = np.full(count, np.inf), np.full(count, -np.inf)
        np.minimum.at(self._bottom, cell, lowest[triangle, 2] - ROUNDING_MM)
        np.maximum.at(self._top, cell, highest[triangle, 2] + ROUNDING_MM)
        order = np.argsort(cell, kind="stable")
        # Cell k has the triangles [first[k]:first[k + 1]].
        self._first = np.searchsorted(cell[order], np.arange(count + 1))
        self._triangle = triangle[order]

    def along(self, here: Floats, there: Floats) -> tuple[Ints, Ints]:
        """Pairs (line, triangle) that may meet, for (N, 3) ends of lines inside the box."""
        length = np.abs(there - here)[:, :2].max(axis=1)
        count = np.ceil(length / self._side).astype(int) + 1
        line, step = spread(count)
        piece = (there - here)[line] / count[line, np.newaxis]
        start = here[line] + step[:, np.newaxis] * piece
        low, high = np.minimum(start, start + piece), np.maximum(start, start + piece)
        box, cell = self._under(low - ROUNDING_MM, high + ROUNDING_MM)
        level = (low[box, 2] <= self._top[cell]) & (high[box, 2] >= self._bottom[cell])
        box, triangle = self._in_cells(box[level], cell[level])
        return line[box], triangle

    def around(self, places: Floats) -> tuple[Ints, Ints]:
        """Pairs (place, triangle) of (N, 3) places and all triangles of the cells they lie in."""
        return self._in_cells(*self._under(places - ROUNDING_MM, places + ROUNDING_MM))

    def _under(self, low: Floats, high: Floats) -> tuple[Ints, Ints]:
        """Pairs (box, cell) that touch, for N upright boxes given by two corners, (N, 3)."""
        corners = (np.stack([low, high])[..., :2] - self.low_mm[:2]) / self._side
        first, last = np.clip(np.floor(corners).astype(int), 0, self._shape - 1)
        wide, deep = (last - first + 1).T
        box, step = spread(wide * deep)
        column = first[box, 0] + step // deep[box]
        return box, column * self._shape[1] + first[box, 1] + step % deep[box]

    def _in_cells(self, owner: Ints, cell: Ints) -> tuple[Ints, Ints]:
        """Pairs (owner, triangle) for pairs (owner, cell)."""
        pair, entry = spread(self._first[cell + 1] - self._first[cell])
        return owner[pair], self._triangle[self._first[cell[pair]] + entry]


def meets(start: Floats, end: Floats, corners: Floats) -> Mask:
    """(K,) whether lines from start to end, (K, 3), meet triangles (K, 3, 3), edges included.

    Signed volumes: a line meets a triangle where it passes all three edges on one side and
    the triangle's plane lies between its ends.
    """
    a, b, c = (corners[:, k] - start for k in range(3))
    ray = end - start
    sides = np.stack([_volume(ray, a, b), _volume(ray, b, c), _volume(ray, c, a)])
    slack = EDGE * np.abs(sides).max(axis=0)
    around = np.all(sides >= -slack, axis=0) | np.all(sides <= slack, axis=0)
    normal = np.cross(b - a, c - a)
    before, rise = np.sum(normal * a, axis=1), np.sum(normal * ray, axis=1)
    between = np.where(rise > 0, (before >= 0) & (before <= rise), (before <= 0) & (before >= rise))
    return around & between & (rise != 0)


def _volume(a: Floats, b: Floats, c: Floats) -> Floats:
    return np.sum(a * np.cross(b, c), axis=1)
