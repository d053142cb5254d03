"""The surfaces of a scene: each can be cut by the laser sheet, and can block a line of sight.

A scene is a list of surfaces; the index of a surface in that list is its face number.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
import shapely
import trimesh
from scipy.linalg import null_space
from scipy.optimize.elementwise import find_root
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from lscan.config.targets import GroovedBlock, Sandwave
from lscan.errors import InputError
from lscan.records import Floats, Ints, Mask
from sim.meshes import target_mesh
from sim.meshes.parts import plain_mesh
from sim.meshes.target import plate_mesh
from sim.scene import Pose, Scene, floor_corners_mm, target_pose
from sim.scene.errors import TrueBoard
from sim.truth.sheet import Bow, bowed_pieces

# A line of sight ends on a surface: what it meets this close to its end is that surface.
SELF_MM = 1e-3
# A line of sight that leaves a polygon's plane by less lies in it: it has no place where it
# meets it.  Rounding of places a metre away is 1e-13 mm.
LEVEL_MM = 1e-9

# What lies this close to a sheet lies in it; trimesh's own measure.
TOUCHING_MM = 1e-8


class TankSurface(Protocol):
    """One surface in the world frame, mm."""

    def cut(self, sheet: Pose, bow: Bow | None = None) -> Floats:
        """(M, 2, 2) straight pieces of the section: two ends of (x, z) in the sheet's plane.

        sheet: frame of the sheet's plane to world frame; the plane is its y = 0.
        bow: how far the sheet lies off the plane, None where it lies in it.
        """
        ...

    def blocks(self, start: Floats, end: Floats) -> Mask:
        """(N,) whether the surface comes between (N, 3) starts and ends, world frame, mm."""
        ...

    def normals(self, places: Floats) -> Floats:
        """(N, 3) unit normals, to either side, at (N, 3) places of the surface, world frame."""
        ...


@dataclass(frozen=True)
class Polygon:
    """A plane polygon, by the even-odd rule, so that holes and crossings are allowed.

    corners_mm: (K, 3) in the world frame.  opaque: False where another surface already
    stops every line of sight that this one would.
    """

    corners_mm: Floats
    opaque: bool = True

    def cut(self, sheet: Pose, bow: Bow | None = None) -> Floats:
        """(M, 2, 2) pieces of the section; none where the polygon lies in a flat sheet.

        An edge in the sheet, with the polygon on one side, is one.
        """
        corners = sheet.invert(self.corners_mm)
        if bow is not None:
            return bowed_section(corners, bow)
        following = np.roll(corners, -1, axis=0)
        crosses = (corners[:, 1] < 0) != (following[:, 1] < 0)
        if not crosses.any():
            # It ends at the sheet, or begins there: on that edge its light falls.
            ends = np.stack([corners, following], axis=1)
            touches = (np.abs(ends[..., 1]) < TOUCHING_MM).all(axis=1)
            return ends[touches & ~touches.all()][..., [0, 2]]
        here, there = corners[crosses], following[crosses]
        part = here[:, 1] / (here[:, 1] - there[:, 1])
        points = (here + part[:, np.newaxis] * (there - here))[:, [0, 2]]
        line = np.cross(newell_normal(corners), [0.0, 1.0, 0.0])[[0, 2]]
        return points[np.argsort(points @ line)].reshape(-1, 2, 2)

    def blocks(self, start: Floats, end: Floats) -> Mask:
        """(N,) whether the polygon comes between starts and ends."""
        if not self.opaque:
            return np.zeros(len(start), dtype=bool)
        normal = newell_normal(self.corners_mm)
        ray = end - start
        approach = ray @ normal
        level = np.abs(approach) < LEVEL_MM
        part = (self.corners_mm[0] - start) @ normal / np.where(level, 1.0, approach)
        left = (1 - part) * np.linalg.norm(ray, axis=1)
        hit = ~level & (part > 0) & (left > SELF_MM)
        plan = np.delete(np.arange(3), np.argmax(np.abs(normal)))
        places = start[hit] + part[hit, np.newaxis] * ray[hit]
        hit[hit] = shapely.intersects_xy(area(self.corners_mm[:, plan]), *places[:, plan].T)
        return hit

    def normals(self, places: Floats) -> Floats:
        """(N, 3) the polygon's normal."""
        return np.broadcast_to(newell_normal(self.corners_mm), places.shape)


def bowed_section(corners: Floats, bow: Bow) -> Floats:
    """(M, 2, 2) section of a (K, 3) plane polygon by a bowed sheet, (x, z) in its plane.

    The rectangle around the polygon is cut, then what lies outside the polygon cut off.
    """
    origin, plane = corners[0], null_space([newell_normal(corners)]).T
    outline = (corners - origin) @ plane.T
    (left, bottom), (right, top) = outline.min(axis=0), outline.max(axis=0)
    rectangle = np.array([[left, bottom], [right, bottom], [right, top], [left, top]])
    halves = np.array([[0, 1, 2], [0, 2, 3]])
    pieces = (bowed_pieces(origin + rectangle @ plane, halves, bow) - origin) @ plane.T
    return (origin + clip(pieces, outline) @ plane)[..., [0, 2]]


def clip(pieces: Floats, outline: Floats) -> Floats:
    """(L, 2, 2) the parts of straight pieces (M, 2, 2) inside a (K, 2) polygon."""
    parts = shapely.get_parts(shapely.intersection(shapely.linestrings(pieces), area(outline)))
    lines = parts[shapely.get_type_id(parts) == shapely.GeometryType.LINESTRING]
    return np.asarray(shapely.get_coordinates(lines)).reshape(-1, 2, 2)


def area(outline: Floats) -> shapely.Geometry:
    """The inside of a (K, 2) polygon by the even-odd rule."""
    return shapely.make_valid(shapely.Polygon(outline)).buffer(0.0)  # without lines left over


def cross(a: Floats, b: Floats) -> Floats:
    """(...,) cross products of (..., 2) vectors in a plane."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def stretch(
    start: Floats, end: Floats, low: Floats, high: Floats, short_mm: float = SELF_MM
) -> tuple[Floats, Floats]:
    """Where straight lines run inside a box: from, to, each (N,), as parts of the line.

    start, end: (N, 3); low, high: (3,) corners of the box.  The last ``short_mm`` before the
    end are left out.  ``to`` is smaller than ``from`` where a line misses the box.
    """
    ray = end - start
    safe = np.where(ray == 0, np.finfo(float).tiny, ray)
    with np.errstate(over="ignore"):
        faces = np.stack([(low - start) / safe, (high - start) / safe])
    last = 1 - short_mm / np.linalg.norm(ray, axis=1)
    first = np.maximum(faces.min(axis=0).max(axis=1), 0.0)
    return first, np.minimum(faces.max(axis=0).min(axis=1), last)


def between(start: Floats, end: Floats, part: Floats) -> Floats:
    """(N, K) points at parts (N,) of the ways from ``start`` to ``end``; exact at 0 and 1."""
    return start * (1 - part)[:, np.newaxis] + end * part[:, np.newaxis]


def spread(count: Ints) -> tuple[Ints, Ints]:
    """Item i repeated count[i] times: (sum,) owner i, and (sum,) 0, 1, ... within the item."""
    owner = np.repeat(np.arange(len(count)), count)
    return owner, np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)


def newell_normal(corners: Floats) -> Floats:
    """(3,) unit normal of a (K, 3) plane polygon (Newell's sum; of its net area)."""
    area = np.cross(corners - corners[0], np.roll(corners, -1, axis=0) - corners[0]).sum(axis=0)
    return area / np.linalg.norm(area)


def extrusion(base: Floats, along: Floats) -> list[Floats]:
    """The faces of a prism: base, far end, then a side for each edge of the base.

    base: (K, 3) corners; along: (3,) from base to far end; each face (., 3) corners.
    """
    far = base + along
    sides = [np.array([base[i - 1], base[i], far[i], far[i - 1]]) for i in range(len(base))]
    return [base, far, *sides]


# A triangle mesh as a surface: sections by trimesh, lines of sight by a grid in plan.


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
        box, triangle = self._pairs_in_cells(box[level], cell[level])
        return line[box], triangle

    def around(self, places: Floats) -> tuple[Ints, Ints]:
        """Pairs (place, triangle) of (N, 3) places and all triangles of the cells they lie in."""
        return self._pairs_in_cells(*self._under(places - ROUNDING_MM, places + ROUNDING_MM))

    def _under(self, low: Floats, high: Floats) -> tuple[Ints, Ints]:
        """Pairs (box, cell) that touch, for N upright boxes given by two corners, (N, 3)."""
        corners = (np.stack([low, high])[..., :2] - self.low_mm[:2]) / self._side
        first, last = np.clip(np.floor(corners).astype(int), 0, self._shape - 1)
        wide, deep = (last - first + 1).T
        box, step = spread(wide * deep)
        column = first[box, 0] + step // deep[box]
        return box, column * self._shape[1] + first[box, 1] + step % deep[box]

    def _pairs_in_cells(self, owner: Ints, cell: Ints) -> tuple[Ints, Ints]:
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


# The sandwave block: a height field over a square, its rims, wedges and sides.


SAMPLE_MM = 0.05  # of the section: its chords stay within 1e-4 mm of eq. (4)
MARCH_MM = 0.25  # along lines of sight: a crest they cut by less than 3 um may be missed


@dataclass(frozen=True)
class Wave:
    """The surface of eq. (4) over its square.  pose: workpiece frame to world frame."""

    shape: Sandwave
    pose: Pose

    def cut(self, sheet: Pose, bow: Bow | None = None) -> Floats:
        """(M, 2, 2) chords of the section, each at most 0.05 mm wide in x.

        Raises InputError where block or sheet are tilted so far that the sheet may cut the
        surface more than once in the same x.

        Parameters
        ----------
        sheet : Pose, frame of the sheet's plane to world frame
        bow : Bow or None, how far the sheet lies off the plane
        """
        inner = Pose(self.pose.rotation.T @ sheet.rotation, self.pose.invert(sheet.origin_mm))

        def place(z: Floats, x: Floats) -> Floats:
            """(N, 3) points of the sheet in the workpiece frame."""
            y = np.zeros_like(x) if bow is None else bow.offset_mm(x, z)
            return inner.apply(np.column_stack([x, y, z]))

        def clearance(z: Floats, x: Floats) -> Floats:
            at = place(z, x)
            return at[:, 2] - self.shape.height_mm(at[:, 0], at[:, 1])

        x = self._reach(sheet)
        level = -place(np.zeros_like(x), x)[:, 2] / inner.rotation[2, 2]
        up = (place(level + 1, x) - place(level - 1, x)) / 2  # tangents of lines of one x
        self._check_mild(up)
        # Beyond the square eq. (4) may run higher; twice the amplitude still brackets it
        # wherever the result is used, which is over the square.
        span = (2 * self._amplitude() + 2 * np.abs(place(level, x)[:, 2])) / up[:, 2]
        z = find_root(clearance, (level - span, level + span), args=(x,)).x
        points, at = np.column_stack([x, z]), place(z, x)
        low, high = np.array([0, 0, -np.inf]), np.array([self.shape.side_mm] * 2 + [np.inf])
        parts = stretch(at[:-1], at[1:], low, high, short_mm=0.0)
        over = parts[0] < parts[1]
        ends = [between(points[:-1][over], points[1:][over], part[over]) for part in parts]
        return np.stack(ends, axis=1)

    def blocks(self, start: Floats, end: Floats) -> Mask:
        """(N,) whether the surface comes between starts and ends.

        A point of the surface that faces away is blocked exactly; a cast shadow is found by
        marching.  Lines that would pass through the square's vertical walls count as well.

        Parameters
        ----------
        start, end : (N, 3) array, mm, world frame
        """
        here, there = self.pose.invert(start), self.pose.invert(end)
        blocked = self._faces_away(here, there)
        rays = np.flatnonzero(~blocked)
        top, side = self._amplitude(), self.shape.side_mm
        low, high = np.array([0, 0, -top]), np.array([side, side, top])
        first, last = stretch(here[rays], there[rays], low, high)
        length = np.linalg.norm(there[rays] - here[rays], axis=1) * (last - first)
        rays, first, last = rays[length > 0], first[length > 0], last[length > 0]
        steps = int(np.ceil(length.max(initial=0.0) / MARCH_MM)) + 1
        for part in np.linspace(0, 1, steps):
            open_ = ~blocked[rays]
            rays, first, last = rays[open_], first[open_], last[open_]
            at = (first + part * (last - first))[:, np.newaxis]
            place = here[rays] + at * (there[rays] - here[rays])
            height = self.shape.height_mm(place[:, 0], place[:, 1])
            blocked[rays] = place[:, 2] < height - SELF_MM
        return blocked

    def normals(self, places: Floats) -> Floats:
        """(N, 3) unit normals of eq. (4), upwards, world frame.

        Parameters
        ----------
        places : (N, 3) array, mm, of the surface, world frame
        """
        x, y, _ = self.pose.invert(places).T
        return self.shape.normals(x, y) @ self.pose.rotation.T

    def _reach(self, sheet: Pose) -> Floats:
        """Samples of the sheet's x that hold the whole square."""
        side, top = self.shape.side_mm, self._amplitude()
        box = np.array([(x, y, z) for x in (0, side) for y in (0, side) for z in (-top, top)])
        x = sheet.invert(self.pose.apply(box))[:, 0]
        return np.linspace(x.min(), x.max(), int(np.ceil(np.ptp(x) / SAMPLE_MM)) + 1)

    def _amplitude(self) -> float:
        return self.shape.a_mm + self.shape.b * self.shape.side_mm

    def _check_mild(self, up: Floats) -> None:
        """Refuse a tilt for which a line up the sheet could meet the surface twice.

        up: (N, 3) tangents of such lines.
        """
        s, highest = self.shape, self._amplitude()
        steepest_y = s.b + highest * abs(s.d_rad * s.e_per_mm)
        lean = highest * s.c_per_mm * np.abs(up[:, 0]) + steepest_y * np.abs(up[:, 1])
        if np.any((up[:, 2] <= 0) | (lean >= up[:, 2] / 2)):
            upright = (up[:, 2] / np.linalg.norm(up, axis=1)).min()
            raise InputError(
                "target: the sandwave is tilted too far against the sheet for its slopes",
                value=f"{np.degrees(np.arccos(np.clip(upright, -1, 1))):.1f} degrees",
                allowed="tilt times slope below one half",
            )

    def _faces_away(self, here: Floats, there: Floats) -> Mask:
        """(N,) whether ``there`` is a point of the surface seen from its underside."""
        x, y, z = there.T
        over = np.all((there[:, :2] >= 0) & (there[:, :2] <= self.shape.side_mm), axis=1)
        on = over & (np.abs(z - self.shape.height_mm(x, y)) < SELF_MM)
        return on & (np.einsum("ij,ij->i", self.shape.normals(x, y), here - there) <= 0)


def sandwave_surfaces(shape: Sandwave, pose: Pose) -> list[TankSurface]:
    """The block's surfaces: wave, rim, sides and underside, the wave's walls, the wedges."""
    outer = square(-shape.rim_mm, shape.side_mm + shape.rim_mm)
    inner = square(0.0, shape.side_mm)
    rim = np.vstack([outer, outer[:1], inner, inner[:1]])  # a slit joins hole and outline
    underside, _, *sides = extrusion(outer - [0, 0, shape.body_mm], np.array([0, 0, shape.body_mm]))
    wedges = [
        face
        for plan in shape.wedge_plans_mm()
        for face in extrusion(
            np.column_stack([plan, np.zeros(3)]), np.array([0, 0, shape.wedge.height_mm])
        )
    ]
    faces = [rim, underside, *sides, *wedges]
    return [
        Wave(shape, pose),
        *(Polygon(pose.apply(face)) for face in faces),
        *(Polygon(pose.apply(wall), opaque=False) for wall in walls(shape)),
    ]


def square(low: float, high: float) -> Floats:
    """(4, 3) corners of a level square at z = 0, counter-clockwise."""
    return np.array([[low, low, 0], [high, low, 0], [high, high, 0], [low, high, 0.0]])


def walls(shape: Sandwave) -> list[Floats]:
    """The four vertical faces between the wave's border and the rim, each (K, 3) corners.

    Wave.blocks already stops lines of sight at them: it samples where they enter and leave
    the square.
    """
    corners = square(0.0, shape.side_mm)
    part = np.linspace(0, 1, int(np.ceil(shape.side_mm / SAMPLE_MM)) + 1)[:, np.newaxis]
    found = []
    for here, there in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        foot = here + part * (there - here)
        border = foot + 0.0
        border[:, 2] = shape.height_mm(foot[:, 0], foot[:, 1])
        found.append(np.vstack([here, border, there]))
    return found


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
