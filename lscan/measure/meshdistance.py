"""Signed distances of points from a triangle mesh.

The nearest place on the mesh is found exactly: its triangles are cut into pieces of about one
size, whose centroids are kept in a tree.  A point's nearest pieces name the triangles to
look at, and so many pieces are asked for that the next one is farther away than the nearest
place, by more than a piece reaches beyond its centroid.

The sign is that of the side of the triangles' normals.  Where the nearest place lies on an edge
or a corner, several triangles share it; the one decides whose plane is farthest from the point:
at a convex edge a plane may have the point on its back although the point is outside.
"""

from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from lscan.errors import InputError
from lscan.measure.shapefit import ShapeTerms
from lscan.records import Floats, Ints, Mask

MOST_PIECES = 50_000
"""Of a mesh of fewer triangles; memory for some MB."""

FIRST_ASKED = 16
"""Pieces asked for at first: a circle of twice a piece's reach holds about as many."""

AT_ONCE = 20_000
"""Points looked up at a time: 16 triangles of 9 numbers each take 23 MB."""

TIE_MM = 1e-7
"""Triangles nearer to a point than this, beyond the nearest, share its nearest place: rounding of
coordinates of a kilometre is 1e-10 mm."""

ON_EDGE = 1e-9
"""Barycentric coordinate of a place on the edge opposite."""


@dataclass(frozen=True)
class NearestPlaces:
    """The places of a mesh nearest to K points.

    Attributes
    ----------
    distance_mm : (K,) array, mm, positive on the side of the mesh's normals
    place_mm : (K, 3) array, mm, on the mesh
    normal : (K, 3) array, unit vectors along which the distance grows
    border : (K,) mask, of places on the border of an open mesh, beside which there is nothing
    """

    distance_mm: Floats
    place_mm: Floats
    normal: Floats
    border: Mask


class MeshSearch:
    """Finds the places of a mesh that are nearest to points.

    Parameters
    ----------
    mesh : Trimesh, mm; triangles without area do not count

    Raises
    ------
    InputError
        Where no triangle has an area.
    """

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        whole = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
        whole.merge_vertices()
        whole.update_faces(whole.area_faces > 0)
        if len(whole.faces) == 0:
            raise InputError("the mesh has no triangle with an area", where="mesh")
        self._corners: Floats = np.asarray(whole.triangles, dtype=float)
        self._normals: Floats = np.asarray(whole.face_normals, dtype=float)
        self._border = _border_edges(whole)
        centroids, self._owner, self._reaches = _pieces(self._corners)
        self._reach = float(self._reaches.max())
        self._tree = cKDTree(centroids)

    def nearest(self, points_mm: Floats, within_mm: float = np.inf) -> NearestPlaces:
        """The nearest places to points.

        Parameters
        ----------
        points_mm : (K, 3) array, mm, frame of the mesh
        within_mm : float, mm; of points farther off no more is looked for than that they are
        """
        parts = [
            self._nearest(points_mm[first : first + AT_ONCE], within_mm)
            for first in range(0, max(len(points_mm), 1), AT_ONCE)
        ]
        columns = zip(*(vars(part).values() for part in parts), strict=True)
        return NearestPlaces(*map(np.concatenate, columns))

    def _nearest(self, points: Floats, within_mm: float) -> NearestPlaces:
        triangle = np.zeros(len(points), dtype=np.int64)
        place = np.zeros((len(points), 3))
        side = np.zeros(len(points))
        left, asked = np.arange(len(points)), FIRST_ASKED
        while len(left):
            asked = min(asked, self._tree.n)
            sure = np.zeros(len(points), dtype=bool)
            for some in np.array_split(left, -(-len(left) * asked // (AT_ONCE * FIRST_ASKED))):
                found = self._among(points[some], asked, within_mm)
                triangle[some], place[some], side[some], sure[some] = found
            left, asked = left[~sure[left]], 4 * asked
        away = points - place
        distance = np.linalg.norm(away, axis=1)
        sign = np.where(side < 0, -1.0, 1.0)
        off = distance > TIE_MM  # nearer, the direction is rounding
        normal = self._normals[triangle].copy()
        normal[off] = sign[off, None] * away[off] / distance[off, None]
        border = self._on_border(triangle, place)
        return NearestPlaces(sign * distance, place, normal, border)

    def _among(
        self, points: Floats, asked: int, within_mm: float
    ) -> tuple[Ints, Floats, Floats, Mask]:
        """Of each point the nearest of the triangles that so many nearest pieces belong to.

        Triangle, place (K, 3), how far the triangle's plane lies beneath the point (K,), and
        whether no other triangle can be nearer, or none is within reach.
        """
        found = self._tree.query(points, k=np.arange(1, asked + 1))
        reached, piece = np.asarray(found[0]), np.asarray(found[1])
        # A centroid lies on its triangle: what cannot be nearer than the first is left out.
        near = reached - self._reaches[piece] <= reached[:, :1] + TIE_MM
        candidates, row = self._owner[piece], np.nonzero(near)[0]
        shape = (len(points), asked)
        places, gap, height = np.zeros((*shape, 3)), np.full(shape, np.inf), np.zeros(shape)
        triangle = candidates[near]
        places[near] = trimesh.triangles.closest_point(self._corners[triangle], points[row])
        away = points[row] - places[near]
        gap[near] = np.linalg.norm(away, axis=-1)
        height[near] = np.einsum("ia,ia->i", away, self._normals[triangle])
        nearest = gap.min(axis=1)
        decisive = np.where(gap <= nearest[:, None] + TIE_MM, np.abs(height), -1.0).argmax(axis=1)
        rows = np.arange(len(points))
        sure = (nearest + self._reach < reached[:, -1]) | (asked == self._tree.n)
        sure |= reached[:, 0] - self._reach > within_mm
        return candidates[rows, decisive], places[rows, decisive], height[rows, decisive], sure

    def _on_border(self, triangle: Ints, place: Floats) -> Mask:
        """(K,) whether places of triangles lie on an edge that is no other triangle's."""
        open_edges = self._border[triangle]
        on_border = np.zeros(len(triangle), dtype=bool)
        asked = np.flatnonzero(open_edges.any(axis=1))
        if len(asked):
            corners = self._corners[triangle[asked]]
            weights = trimesh.triangles.points_to_barycentric(corners, place[asked])
            # Edge e joins corners e and e + 1, and lies opposite to corner e + 2.
            opposite = np.roll(weights, -2, axis=1)
            on_border[asked] = (open_edges[asked] & (opposite < ON_EDGE)).any(axis=1)
        return on_border


def _border_edges(mesh: trimesh.Trimesh) -> Mask:
    """(T, 3) which edges belong to one triangle alone; edge e joins corners e and e + 1."""
    border: Mask = np.zeros(3 * len(mesh.faces), dtype=bool)
    border[trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1)] = True
    return border.reshape(-1, 3)


def _pieces(corners: Floats) -> tuple[Floats, Ints, Floats]:
    """Centroids (Q, 3) of pieces of (T, 3, 3) triangles, the triangle of each, the reach of each.

    The largest are halved across their longest side, again and again, until there are enough.
    reach: of the farthest of a piece's corners from its centroid.
    """
    owner: Ints = np.arange(len(corners))
    most = max(MOST_PIECES, 2 * len(corners))
    while True:
        length = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=-1)
        cut = length.max(axis=1) > length.max() / 2
        if len(corners) + int(cut.sum()) > most:
            break
        # Corners a and b at the ends of the longest side, c opposite.
        turned = (length[cut].argmax(axis=1)[:, None] + np.arange(3)) % 3
        a, b, c = np.moveaxis(np.take_along_axis(corners[cut], turned[..., None], axis=1), 1, 0)
        middle = (a + b) / 2
        halves = [np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)]
        corners = np.concatenate([corners[~cut], *halves])
        owner = np.concatenate([owner[~cut], owner[cut], owner[cut]])
    centroids = corners.mean(axis=1)
    return centroids, owner, np.linalg.norm(corners - centroids[:, None], axis=-1).max(axis=1)


@dataclass(frozen=True)
class PlacedMesh:
    """A mesh somewhere in space; its parameters are a turn about the pivot (rad) and a shift (mm).

    Attributes
    ----------
    search : MeshSearch, of the mesh in its own frame
    rotation : (3, 3) array, from the mesh's frame to that of the points
    translation_mm : (3,) array, mm
    within_mm : float, mm; points farther off the mesh are of something else
    pivot_mm : (3,) array, mm, frame of the points
    """

    search: MeshSearch
    rotation: Floats
    translation_mm: Floats
    within_mm: float
    pivot_mm: Floats

    def nearest(self, xyz_mm: Floats) -> NearestPlaces:
        """The places of the mesh nearest to points, in the points' frame.

        Parameters
        ----------
        xyz_mm : (K, 3) array, mm
        """
        in_mesh = (xyz_mm - self.translation_mm) @ self.rotation
        own = self.search.nearest(in_mesh, self.within_mm)
        return NearestPlaces(
            own.distance_mm,
            own.place_mm @ self.rotation.T + self.translation_mm,
            own.normal @ self.rotation.T,
            own.border,
        )

    def terms(self, xyz_mm: Floats) -> ShapeTerms:
        """As of FittedShape; points beyond the mesh's border, or far off it, have no distance."""
        found = self.nearest(xyz_mm)
        about = np.cross(found.place_mm - self.pivot_mm, found.normal)
        return ShapeTerms(
            distance_mm=found.distance_mm,
            normal=found.normal,
            design=np.column_stack([-about, -found.normal]),
            usable=~found.border & (np.abs(found.distance_mm) <= self.within_mm),
        )

    def moved(self, step: Floats) -> "PlacedMesh":
        """As of FittedShape."""
        turn: Floats = Rotation.from_rotvec(step[:3]).as_matrix()
        shift = turn @ (self.translation_mm - self.pivot_mm) + self.pivot_mm + step[3:]
        return PlacedMesh(self.search, turn @ self.rotation, shift, self.within_mm, self.pivot_mm)
