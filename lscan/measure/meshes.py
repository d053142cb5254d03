"""A surface against a mesh: signed distances, their summary, histogram and coloured points.

The nearest place on the mesh is found exactly: its triangles, the largest cut into pieces, have
their centroids in a tree.  A point's nearest pieces name the triangles to look at, and so many
pieces are asked for that the next one is farther away than the nearest place, by more than a piece
reaches beyond its centroid.

The sign is that of the side of the triangles' normals.  Where the nearest place lies on an edge
or a corner, several triangles share it, and each normal counts by the angle of its triangle there:
of any closed mesh the sum points outwards from that place [1].

References
----------
.. [1] J. A. Baerentzen and H. Aanaes, "Signed distance computation using the angle weighted
   pseudonormal", IEEE Transactions on Visualization and Computer Graphics 11, 243 (2005).
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import trimesh
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from lscan.errors import InputError, MeasurementError
from lscan.figures.style import FIRST, INK, SECOND, WIDTH_IN, png, styled
from lscan.files.disk import write_atomically
from lscan.files.meshes import weld_mesh
from lscan.measure.shapes import ShapeFit, ShapeTerms, fit_shape, measured_points
from lscan.records import Floats, Ints, Mask, Surface

# Signed distances of points from a triangle mesh.

MOST_PIECES = 50_000
"""Of a mesh of fewer triangles; memory for some MB.  Of one of more, a quarter more than those."""

FIRST_ASKED = 16
"""Pieces asked for at first: a circle of twice a piece's reach holds about as many."""

AT_ONCE = 20_000
"""Points looked up at a time: 16 triangles of 9 numbers each take 23 MB."""

TIE_MM = 1e-7
"""Triangles nearer to a point than this, beyond the nearest, share its nearest place: rounding of
coordinates of a kilometre is 1e-10 mm."""

ON_EDGE = 1e-9
"""Barycentric coordinate of a place on the edge opposite."""

CHUNK = 500_000
"""Triangles of which corners are written out at a time: 36 MB."""


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
    mesh : Trimesh, mm; triangles without area, and copies of others, do not count

    Raises
    ------
    InputError
        Where no triangle has an area.
    """

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        self._vertices, joined, _ = weld_mesh(np.asarray(mesh.vertices, dtype=float), mesh.faces)
        faces: NDArray[np.int32] = joined.astype(np.int32)
        del joined  # 120 MB of five million triangles
        area = np.concatenate([trimesh.triangles.area(self._vertices[f]) for f in _chunks(faces)])
        if not area.any():
            raise InputError("the mesh has no triangle with an area", where="mesh")
        # Edges are counted of all: one without area still joins its neighbours.
        self._border = _border_edges(faces)[area > 0]
        self._faces = faces[area > 0]
        centroids, self._owner, self._reaches = _pieces(self._vertices, self._faces)
        self._reach = float(self._reaches.max())
        # Neither balanced nor compact: built three times as fast, asked nearly as fast.
        self._tree = cKDTree(centroids, leafsize=32, balanced_tree=False, compact_nodes=False)

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
        place, side = np.zeros((len(points), 3)), np.zeros(len(points))
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
        normal = _normals(self._corners(triangle))
        normal[off] = sign[off, None] * away[off] / distance[off, None]
        border = self._is_on_border(triangle, place)
        return NearestPlaces(sign * distance, place, normal, border)

    def _corners(self, triangle: Ints) -> Floats:
        """(K, 3, 3) corners of triangles, mm."""
        return np.asarray(self._vertices[self._faces[triangle]])

    def _among(
        self, points: Floats, asked: int, within_mm: float
    ) -> tuple[Ints, Floats, Floats, Mask]:
        """Of each point the nearest of the triangles that so many nearest pieces belong to.

        Triangle, place (K, 3), how far the point lies along the normals there, each by its angle
        (K,), and whether no other triangle can be nearer, or none is within reach.
        """
        found = self._tree.query(points, k=np.arange(1, asked + 1))
        reached, piece = np.asarray(found[0]), np.asarray(found[1])
        # A centroid lies on its triangle: what cannot be nearer than the first is left out.
        near = reached - self._reaches[piece] <= reached[:, :1] + TIE_MM
        # Pieces of one triangle are looked at once.
        pairs = np.nonzero(near)[0] * len(self._faces) + self._owner[piece[near]]
        row, triangle = np.divmod(np.unique(pairs), len(self._faces))
        corners = self._corners(triangle)
        places = trimesh.triangles.closest_point(corners, points[row])
        away = points[row] - places
        gap = np.linalg.norm(away, axis=1)
        first = np.searchsorted(row, np.arange(len(points)))
        nearest = np.minimum.reduceat(gap, first)
        tied = np.flatnonzero(gap <= nearest[row] + TIE_MM)
        height = np.einsum("ka,ka->k", _normals(corners[tied]), away[tied])
        of_point = np.searchsorted(row[tied], np.arange(len(points)))
        side = np.add.reduceat(height * _angles(corners[tied], places[tied]), of_point)
        exact = np.flatnonzero(gap == nearest[row])
        best = exact[np.searchsorted(row[exact], np.arange(len(points)))]
        sure = (nearest + self._reach < reached[:, -1]) | (asked == self._tree.n)
        sure |= reached[:, 0] - self._reach > within_mm
        return triangle[best], places[best], side, sure

    def _is_on_border(self, triangle: Ints, place: Floats) -> Mask:
        """(K,) whether places of triangles lie on an edge that is no other triangle's."""
        open_edges = self._border[triangle]
        on_border = np.zeros(len(triangle), dtype=bool)
        asked = np.flatnonzero(open_edges.any(axis=1))
        if len(asked):
            corners = self._corners(triangle[asked])
            weights = trimesh.triangles.points_to_barycentric(corners, place[asked])
            # Edge e joins corners e and e + 1, and lies opposite to corner e + 2.
            opposite = np.roll(weights, -2, axis=1)
            on_border[asked] = (open_edges[asked] & (opposite < ON_EDGE)).any(axis=1)
        return on_border


def _chunks(faces: Ints | NDArray[np.int32]) -> list[Ints]:
    return np.array_split(faces, -(-len(faces) // CHUNK) or 1)


def _normals(corners: Floats) -> Floats:
    """(K, 3) unit normals of (K, 3, 3) triangles."""
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.asarray(across / np.linalg.norm(across, axis=1)[:, None])


def _angles(corners: Floats, places: Floats) -> Floats:
    """(K,) the angle of each triangle about a place of it, rad: half a turn on an edge."""
    weights = trimesh.triangles.points_to_barycentric(corners, places)
    on_edge = (weights < ON_EDGE).any(axis=1)
    angle = np.where(on_edge, np.pi, 2 * np.pi)
    at = np.flatnonzero((weights < ON_EDGE).sum(axis=1) == 2)
    corner = weights[at].argmax(axis=1)[:, None] + np.arange(3)
    a, b, c = np.moveaxis(np.take_along_axis(corners[at], corner[..., None] % 3, axis=1), 1, 0)
    aside = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    angle[at] = np.arctan2(aside, np.einsum("ka,ka->k", b - a, c - a))
    return angle


def _border_edges(faces: NDArray[np.int32]) -> Mask:
    """(T, 3) which edges belong to one triangle alone; edge e joins corners e and e + 1."""
    ends = np.roll(faces, -1, axis=1)
    edge = np.minimum(faces, ends).astype(np.int64)
    edge *= int(faces.max()) + 1
    edge += np.maximum(faces, ends)
    known = np.sort(edge, axis=None)
    new = np.concatenate([[True], known[1:] != known[:-1], [True]])
    lone = known[new[1:] & new[:-1]]
    if len(lone) == 0:
        return np.zeros(edge.shape, dtype=bool)
    found = [lone[np.searchsorted(lone[:-1], part)] == part for part in _chunks(edge)]
    return np.concatenate(found)


def _pieces(vertices: Floats, faces: NDArray[np.int32]) -> tuple[Floats, Ints, Floats]:
    """Centroids (Q, 3) of pieces of (T, 3) triangles, the triangle of each, the reach of each.

    The largest are halved across their longest side, again and again, until there are enough.
    reach: of the farthest of a piece's corners from its centroid.
    """
    longest = np.concatenate([_sides(vertices[part]).max(axis=1) for part in _chunks(faces)])
    whole = np.ones(len(faces), dtype=bool)
    pieces, owner = np.empty((0, 3, 3)), np.empty(0, dtype=np.int64)
    most = max(MOST_PIECES, len(faces) + len(faces) // 4)
    while True:
        length = _sides(pieces).max(axis=1)
        limit = max(longest[whole].max(initial=0.0), length.max(initial=0.0)) / 2
        fresh, cut = np.flatnonzero(whole & (longest > limit)), length > limit
        count = int(whole.sum()) + len(pieces) + len(fresh) + int(cut.sum())
        if count > most:
            break
        whole[fresh] = False
        halved = np.concatenate([pieces[cut], vertices[faces[fresh]]])
        halved_owner = np.concatenate([owner[cut], fresh])
        # Corners a and b at the ends of the longest side, c opposite.
        turned = (_sides(halved).argmax(axis=1)[:, None] + np.arange(3)) % 3
        a, b, c = np.moveaxis(np.take_along_axis(halved, turned[..., None], axis=1), 1, 0)
        middle = (a + b) / 2
        halves = [np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)]
        pieces = np.concatenate([pieces[~cut], *halves])
        owner = np.concatenate([owner[~cut], halved_owner, halved_owner])
    uncut = np.flatnonzero(whole)
    found = [_centroids(vertices[part]) for part in _chunks(faces[uncut])] + [_centroids(pieces)]
    centroids, reaches = map(np.concatenate, zip(*found, strict=True))
    return centroids, np.concatenate([uncut, owner]), reaches


def _centroids(corners: Floats) -> tuple[Floats, Floats]:
    """Centroids (K, 3) of (K, 3, 3) triangles, and how far the farthest corner lies from each."""
    centroids = corners.mean(axis=1)
    return centroids, np.linalg.norm(corners - centroids[:, None], axis=-1).max(axis=1)


def _sides(corners: Floats) -> Floats:
    """(K, 3) lengths of the sides of (K, 3, 3) triangles; side k joins corners k and k + 1."""
    return np.asarray(np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=-1))


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


# A surface against a mesh: signed distances, their summary, histogram and coloured points.


WITHIN_MM = 10.0
"""Points farther off the mesh are of something else, such as the floor it stands on."""

MOST_FITTED = 2_000
"""Points the mesh is fitted to, evenly picked: six parameters need no more."""

MISFIT = 5.0
"""Times the points' uncertainty, from which a fit's rms is said: parts differ from drawings."""

TURN_RAD, NOTHING = 1e-6, 1e-13
"""Step for differences, and a share of the largest variance that is rounding."""

LIMIT = 0.98
"""Share of the distances that the colours and the histogram span; the rest lie at their ends."""

BARS = 80
"""Of the histogram, from one limit to the other."""


@dataclass(frozen=True)
class MeshPose:
    """Where a mesh lies: p = rotation @ mesh + translation_mm.

    Attributes
    ----------
    rotation : (3, 3) array, from the mesh's frame to the surface's
    translation_mm : (3,) array, mm, frame of the surface
    """

    rotation: Floats
    translation_mm: Floats

    @classmethod
    def at(cls, position_mm: tuple[float, float, float], turn_deg: float) -> "MeshPose":
        """The mesh turned about z, then shifted.

        Parameters
        ----------
        position_mm : tuple of float, mm, where the mesh's origin lies, frame of the surface
        turn_deg : float, degrees, about z
        """
        rotation: Floats = Rotation.from_euler("z", turn_deg, degrees=True).as_matrix()
        return cls(rotation, np.array(position_mm))

    @property
    def turns_deg(self) -> Floats:
        """(3,) degrees, about x, y and z, one after the other, as a scene file states them."""
        return np.asarray(Rotation.from_matrix(self.rotation).as_euler("xyz", degrees=True))


def _pose_sigma(fit: ShapeFit, pose: MeshPose, pivot_mm: Floats, reach_mm: float) -> Floats:
    """(6,) as MeshComparison.pose_sigma; reach_mm: how far the points lie from the pivot."""
    ways = Rotation.from_rotvec(TURN_RAD * np.eye(3)).as_matrix() @ pose.rotation
    turned = np.array([MeshPose(way, pivot_mm).turns_deg for way in ways]) - pose.turns_deg
    gradient = np.eye(6)
    gradient[:3, :3] = turned.T / TURN_RAD
    gradient[3:, :3] = np.cross(np.eye(3), pose.translation_mm - pivot_mm).T
    # Where the covariance is 0 the points hold nothing: such ways are a null space of it.
    units = np.repeat([reach_mm, 1.0], 3)
    known, axes = np.linalg.eigh(fit.covariance * np.outer(units, units))
    in_units = gradient / units / np.linalg.norm(gradient / units, axis=1, keepdims=True)
    held = np.square(in_units @ axes[:, known > NOTHING * known.max()]).sum(axis=1)
    return np.where(held > 0.5, fit.sigma(gradient), np.inf)


@dataclass(frozen=True)
class MeshComparison:
    """The points of a surface against a mesh.

    Attributes
    ----------
    xyz_mm : (K, 3) array, mm, the points compared, frame of the surface
    distance_mm : (K,) array, mm, positive on the side of the mesh's normals
    sigma_mm : (K,) array, mm, standard uncertainty of the distance, all causes together; those of
        a fitted pose too
    mean_sigma_mm : float, mm, standard uncertainty of the mean distance
    far : int, number of points not compared, because they are too far off the mesh
    beside : int, number of points not compared, because they lie beside an open mesh
    pose : MeshPose, of the mesh
    pose_sigma : (6,) array or None, standard uncertainties of a fitted pose: of MeshPose.turns_deg
        and of translation_mm; infinite where the points do not hold the mesh
    """

    xyz_mm: Floats
    distance_mm: Floats
    sigma_mm: Floats
    mean_sigma_mm: float
    far: int
    beside: int
    pose: MeshPose
    pose_sigma: Floats | None = None

    @property
    def doubt(self) -> str:
        """What a user should know of a fitted pose; "" where there is nothing to say."""
        if self.pose_sigma is None:
            return ""
        rms, sigma = np.sqrt(np.mean(self.distance_mm**2)), np.median(self.sigma_mm)
        words = []
        if rms > MISFIT * sigma:
            words.append(
                f"the mesh fits to {rms:.2g} mm rms only, {rms / sigma:.0f} times the points' "
                "uncertainty: another shape or unit, or a start (--at, --turn) too far off"
            )
        if not np.isfinite(self.pose_sigma).all():
            words.append("nothing holds the mesh some ways: there its pose is that of the start")
        return "; ".join(words)

    @property
    def limit_mm(self) -> float:
        """The distance, mm, that LIMIT of the points keep within."""
        return max(float(np.quantile(np.abs(self.distance_mm), LIMIT)), 1e-6)

    def as_json(self) -> dict[str, Any]:
        """Counts, distances and the mesh's pose."""
        low, middle, high = np.quantile(self.distance_mm, [0.025, 0.5, 0.975]).tolist()
        within = np.abs(self.distance_mm) <= 2 * self.sigma_mm
        return {
            "points": len(self.distance_mm),
            "far": self.far,
            "beside": self.beside,
            "mean_mm": {"value": float(self.distance_mm.mean()), "sigma": self.mean_sigma_mm},
            "rms_mm": float(np.sqrt(np.mean(self.distance_mm**2))),
            "median_mm": middle,
            "central_95_mm": [low, high],
            "min_mm": float(self.distance_mm.min()),
            "max_mm": float(self.distance_mm.max()),
            "within_2_sigma": float(within.mean()),
            "pose": {
                "fitted": self.pose_sigma is not None,
                "rotation": self.pose.rotation,
                "translation_mm": self.pose.translation_mm,
                "sigma": self.pose_sigma,
                "doubt": self.doubt,
            },
        }


def compare_mesh(
    surface: Surface,
    mesh: trimesh.Trimesh,
    pose: MeshPose,
    fit: bool = False,
    within_mm: float = WITHIN_MM,
) -> MeshComparison:
    """The signed distances of a surface's points from a mesh.

    Parameters
    ----------
    surface : Surface, mm
    mesh : Trimesh, mm, in a frame of its own
    pose : MeshPose, of the mesh; where it is fitted, to within about ``within_mm``
    fit : bool, whether the pose is found from the points: the one of least squares
    within_mm : float, mm; points farther off the mesh than this are not compared

    Raises
    ------
    InputError
        Where the mesh has no triangle with an area.
    MeasurementError
        Where no point lies so near to the mesh, or the fit does not settle.

    References
    ----------
    The fit brings points to the tangent planes of the mesh: Y. Chen and G. Medioni, Image and
    Vision Computing 10, 145 (1992).

    Examples
    --------
    >>> import lscan, trimesh
    >>> surface = lscan.load_surface("surface.nc")
    >>> block = trimesh.creation.box(bounds=[[117, -60, -410], [332, 60, -330]])
    >>> pose = MeshPose.at((0.0, 0.0, 0.0), turn_deg=0.0)
    >>> compare_mesh(surface, block, pose).limit_mm < 10
    True
    """
    points = measured_points(surface)
    pivot = points.xyz_mm.mean(axis=0) if len(points.xyz_mm) else np.zeros(3)
    placed = PlacedMesh(MeshSearch(mesh), pose.rotation, pose.translation_mm, within_mm, pivot)
    terms = placed.terms(points.xyz_mm)
    _require_points(terms.usable, within_mm)
    covariance, modes = np.zeros((6, 6)), np.zeros((6, points.modes_mm.shape[2]))
    pose_sigma = None
    if fit:
        near = np.flatnonzero(terms.usable)
        some = near[:: -(-len(near) // MOST_FITTED)]
        found = fit_shape(placed, points.only(some), "the mesh")
        assert isinstance(found.shape, PlacedMesh)
        placed, covariance, modes = found.shape, found.covariance, found.modes
        pose = MeshPose(placed.rotation, placed.translation_mm)
        reach_mm = float(np.linalg.norm(points.xyz_mm[near] - pivot, axis=1).max())
        pose_sigma = _pose_sigma(found, pose, pivot, reach_mm)
        terms = placed.terms(points.xyz_mm)
        _require_points(terms.usable, within_mm)
    used = terms.usable
    common = (terms.by_modes(points) + terms.design @ modes)[used]
    design = terms.design[used]
    own = terms.sigma_mm(points)[used] ** 2 + np.einsum("kp,pq,kq->k", design, covariance, design)
    mean = design.mean(axis=0)
    of_mean = own.sum() / len(own) ** 2 + mean @ covariance @ mean
    far = np.abs(terms.distance_mm) > within_mm
    return MeshComparison(
        xyz_mm=points.xyz_mm[used],
        distance_mm=terms.distance_mm[used],
        sigma_mm=np.sqrt(own + np.square(common).sum(axis=1)),
        mean_sigma_mm=float(np.sqrt(of_mean + np.square(common.mean(axis=0)).sum())),
        far=int(far.sum()),
        beside=int((~used & ~far).sum()),
        pose=pose,
        pose_sigma=pose_sigma,
    )


def _require_points(usable: Mask, within_mm: float) -> None:
    if not usable.any():
        raise MeasurementError(
            f"no point of the surface lies within {within_mm:g} mm of the mesh: is its position "
            "that in the surface's frame, and its unit right?"
        )


def save_coloured_points(path: Path, comparison: MeshComparison) -> None:
    """Write the points compared to a binary PLY file, coloured by their distance.

    Blue lies beneath the mesh and red above it, white on it.  Each vertex carries
    ``distance_mm`` and ``sigma_mm`` too.

    Parameters
    ----------
    path : Path, of the file
    comparison : MeshComparison, of a surface with a mesh

    Raises
    ------
    InputError
        Where the file cannot be written.
    """
    scaled = 0.5 + 0.5 * np.clip(comparison.distance_mm / comparison.limit_mm, -1.0, 1.0)
    colours = matplotlib.colormaps["coolwarm"](scaled, bytes=True)
    cloud = trimesh.PointCloud(comparison.xyz_mm, colors=colours)
    cloud.vertex_attributes = {
        "distance_mm": comparison.distance_mm.astype(np.float32),
        "sigma_mm": comparison.sigma_mm.astype(np.float32),
    }
    write_atomically(path, cloud.export(file_type="ply"))


@styled
def save_histogram(path: Path, comparison: MeshComparison) -> None:
    """Write a histogram of the distances as a PNG picture.

    Parameters
    ----------
    path : Path, of the file
    comparison : MeshComparison, of a surface with a mesh

    Raises
    ------
    InputError
        Where the file cannot be written.
    """
    limit = comparison.limit_mm
    figure = Figure(figsize=(WIDTH_IN, 2.8), layout="constrained", facecolor="white")
    axes = figure.subplots()
    shown = np.clip(comparison.distance_mm, -limit, limit)
    axes.hist(shown, bins=BARS, range=(-limit, limit), color=SECOND)
    axes.axvline(0.0, color=INK, linewidth=0.8)
    mean = float(comparison.distance_mm.mean())
    axes.axvline(mean, color=FIRST, label=f"mean {mean:+.3f} mm")
    axes.set(xlabel="distance from the mesh, mm", ylabel="points")
    axes.legend()
    write_atomically(path, png(figure))
