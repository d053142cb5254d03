"""The surfaces of a scene: each can be cut by the laser sheet, and can block a line of sight.

A scene is a list of surfaces; the index of a surface in that list is its face number.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import shapely
from scipy.linalg import null_space

from lscan.records import Floats, Ints, Mask
from sim.scene import Pose
from sim.truth.bow import Bow, bowed_pieces

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
    return (origin + clipped(pieces, outline) @ plane)[..., [0, 2]]


def clipped(pieces: Floats, outline: Floats) -> Floats:
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
