"""A triangle mesh as a surface: sections by trimesh, lines of sight by a grid in plan."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import trimesh

from lscan.records import Floats, Ints, Mask
from sim.scene import Pose
from sim.truth.bow import Bow, bowed_pieces
from sim.truth.target.surfaces import spread, stretch

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
        """(M, 2, 2) pieces of the section, in no particular order; one a triangle if flat."""
        if bow is not None:
            vertices = sheet.invert(np.asarray(self.mesh.vertices))
            return bowed_pieces(vertices, np.asarray(self.mesh.faces), bow)[..., [0, 2]]
        pieces = trimesh.intersections.mesh_plane(
            self.mesh, plane_normal=sheet.rotation[:, 1], plane_origin=sheet.origin_mm
        )
        corners = np.asarray(pieces, dtype=float).reshape(-1, 3)
        return sheet.invert(corners)[:, [0, 2]].reshape(-1, 2, 2)

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
        return plan_grid(self._corners)


@dataclass(frozen=True)
class Cells:
    """Square cells of the (x, y) plane.  shape: how many along x and y."""

    low_mm: Floats
    side_mm: float
    shape: tuple[int, int]

    @property
    def count(self) -> int:
        """Number of cells."""
        return self.shape[0] * self.shape[1]

    def under(self, low: Floats, high: Floats) -> tuple[Ints, Ints]:
        """Pairs (box, cell) that touch, for N upright boxes given by two corners, (N, 3)."""
        last = np.array(self.shape) - 1
        i, j = self._index(low, last).T
        wide, deep = (self._index(high, last) - self._index(low, last) + 1).T
        box, step = spread(wide * deep)
        column = i[box] + step // deep[box]
        return box, column * self.shape[1] + j[box] + step % deep[box]

    def _index(self, corner: Floats, last: Ints) -> Ints:
        place = (corner[:, :2] - self.low_mm[:2]) / self.side_mm
        return np.clip(np.floor(place).astype(int), 0, last)


@dataclass(frozen=True)
class PlanGrid:
    """Triangles sorted into cells of the (x, y) plane.

    low_mm, high_mm: (3,) corners of the box that holds all.
    triangle: those that may touch cell 0, then cell 1 ...: cell k has
    ``triangle[first[k]:first[k + 1]]``, and their z lie in bottom_mm[k] to top_mm[k].
    """

    low_mm: Floats
    high_mm: Floats
    cells: Cells
    first: Ints
    triangle: Ints
    bottom_mm: Floats
    top_mm: Floats

    def along(self, here: Floats, there: Floats) -> tuple[Ints, Ints]:
        """Pairs (line, triangle) that may meet, for (N, 3) ends of lines inside the box."""
        length = np.abs(there - here)[:, :2].max(axis=1)
        count = np.ceil(length / self.cells.side_mm).astype(int) + 1
        line, step = spread(count)
        piece = (there - here)[line] / count[line, np.newaxis]
        start = here[line] + step[:, np.newaxis] * piece
        low, high = np.minimum(start, start + piece), np.maximum(start, start + piece)
        box, cell = self.cells.under(low - ROUNDING_MM, high + ROUNDING_MM)
        level = (low[box, 2] <= self.top_mm[cell]) & (high[box, 2] >= self.bottom_mm[cell])
        box, triangle = self._in_cells(box[level], cell[level])
        return line[box], triangle

    def around(self, places: Floats) -> tuple[Ints, Ints]:
        """Pairs (place, triangle) of (N, 3) places and all triangles of the cells they lie in."""
        return self._in_cells(*self.cells.under(places - ROUNDING_MM, places + ROUNDING_MM))

    def _in_cells(self, owner: Ints, cell: Ints) -> tuple[Ints, Ints]:
        """Pairs (owner, triangle) for pairs (owner, cell)."""
        pair, entry = spread(self.first[cell + 1] - self.first[cell])
        return owner[pair], self.triangle[self.first[cell[pair]] + entry]


def plan_grid(corners: Floats) -> PlanGrid:
    """The grid of (T, 3, 3) triangles' corners, mm."""
    lowest, highest = corners.min(axis=1), corners.max(axis=1)
    low, high = lowest.min(axis=0) - ROUNDING_MM, highest.max(axis=0) + ROUNDING_MM
    size = (high - low)[:2]
    side = max(CELL_TRIANGLES * np.sqrt(size.prod() / len(corners)), size.max() / MOST_CELLS)
    columns, rows = np.ceil(size / side).astype(int)
    cells = Cells(low, side, (int(columns), int(rows)))
    triangle, cell = cells.under(lowest, highest)
    bottom, top = np.full(cells.count, np.inf), np.full(cells.count, -np.inf)
    np.minimum.at(bottom, cell, lowest[triangle, 2] - ROUNDING_MM)
    np.maximum.at(top, cell, highest[triangle, 2] + ROUNDING_MM)
    order = np.argsort(cell, kind="stable")
    first = np.searchsorted(cell[order], np.arange(cells.count + 1))
    return PlanGrid(low, high, cells, first, triangle[order], bottom, top)


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
