"""How much of a uniform sky's light arrives on surfaces, straight and by way of others.

The sky does not move with the head: the light that arrives is worked out once a tank, and not
again for one with the same surfaces and water.  Samples are nodes of the lattice: few where the
open sky varies linearly, more where it does not, at creases and beside what stands on a floor.
From each the same directions are traced, as many to each part of the hemisphere as it counts with
a matt surface.  What a direction meets is kept, so that the light that surfaces send each other
follows without further rays, each bounce from the one before.  What is finer than the lattice, as
the foot of a step of 2 mm, is not resolved.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from math import pi, sqrt

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import ConvexHull, cKDTree

from lscan.records import Floats, Ints, Mask, select
from sim.meshes import MeshPart
from sim.meshes.target import BOARD_PARTS
from sim.render.backend import flushing
from sim.render.plugins.arrays import floats, indices, vectors
from sim.water import Optics

# Nodes on the triangles of a tank, and between which of them a place lies.
#
# A triangle that is larger than the nodes' spacing holds a lattice along two of its sides, in which
# what nodes know is bilinear; a smaller one holds one node.  Triangles that reach far beyond what
# else stands in the tank, as a floor's, have nodes in a box about that alone.


ASIDE_MM, ABOVE_MM = 0.05, 0.01  # of nodes: from their triangle's sides, of rays from nodes
LOOKS, GOLDEN = 8, (sqrt(5) - 1) / 2  # directions that say which side of a triangle is outside


@dataclass(frozen=True)
class SurfaceNodes:
    """Places on surfaces, N of them.

    Attributes
    ----------
    point_mm : (N, 3) array, mm, world frame; not quite on a triangle's sides, along which another
        surface may stand
    start_mm : (N, 3) array, mm, just above them
    normal : (N, 3) array, as the surface is shaded, on the side where more of the sky is open
    part : (N,) array, number of the part that they lie on
    inside : (N,) array, whether the node lies within its triangle: some of a lattice's do not
    """

    point_mm: Floats
    start_mm: Floats
    normal: Floats
    part: Ints
    inside: Mask


@dataclass(frozen=True)
class Neighbours:
    """The nodes about places, and their weights, which sum to 1."""

    index: tuple[mi.UInt32, ...]
    weight: tuple[mi.Float, ...]

    def mean(self, values: mi.Float, active: mi.Bool) -> mi.Float:
        """Of values at the nodes.

        Parameters
        ----------
        values : Float, of all nodes
        active : Bool, for which places it is wanted
        """
        return sum(
            (
                weight * dr.gather(mi.Float, values, index, active)
                for index, weight in zip(self.index, self.weight, strict=True)
            ),
            mi.Float(0),
        )

    def nearest(self) -> mi.UInt32:
        """The node that weighs most."""
        node, most = self.index[0], self.weight[0]
        for index, weight in zip(self.index[1:], self.weight[1:], strict=True):
            node, most = dr.select(weight > most, index, node), dr.maximum(most, weight)
        return node


class NodeLattice:
    """The nodes of a tank's parts, ``nodes``, laid ``spacing_mm`` apart."""

    def __init__(
        self, scene: mi.Scene, parts: Sequence[MeshPart], box_mm: Floats, spacing_mm: float
    ) -> None:
        """Lay nodes.

        Parameters
        ----------
        scene : mi.Scene, whose shapes are the parts, in their order
        parts : sequence of MeshPart
        box_mm : (2, 3) array, mm, least and largest coordinates of where they are laid
        spacing_mm : float, mm, between nodes
        """
        self.spacing_mm = spacing_mm
        self._shapes = scene.shapes()
        self._first = np.cumsum([0, *(len(part.mesh.faces) for part in parts)])
        corners = np.concatenate([_corner_values(part, part.mesh.vertices) for part in parts])
        normals = np.concatenate([_normals(part) for part in parts])
        normals[_faces_inwards(scene, corners, normals)] *= -1
        start, sides = corners[:, 0], corners[:, 1:] - corners[:, :1]
        duals = _duals(sides)
        low, span, steps = _lay_lattices(start, sides, duals, box_mm, spacing_mm)
        part = np.repeat(np.arange(len(parts)), np.diff(self._first))
        self.nodes = _nodes(start, sides, normals, part, low, span, steps)
        begins = np.cumsum([0, *np.prod(steps + 1, axis=1)])[:-1]
        self._start, self._begins = floats(start), indices(begins)
        scale = steps / np.maximum(span, 1e-12)
        self._axes = [
            _LatticeAxis(
                floats(duals[:, k]), floats(low[:, k]), floats(scale[:, k]), indices(steps[:, k])
            )
            for k in (0, 1)
        ]

    def find(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> Neighbours:
        """The nodes about places of surfaces.

        Parameters
        ----------
        si : SurfaceInteraction3f, the places
        active : Bool, for which places they are wanted
        """
        triangle = mi.UInt32(si.prim_index)
        for shape, first in zip(self._shapes, self._first[:-1].tolist(), strict=True):
            triangle += dr.select(si.shape == mi.ShapePtr(shape), mi.UInt32(first), 0)
        offset = si.p - dr.gather(mi.Point3f, self._start, triangle, active)
        (u, right, _), (v, up, along) = (
            axis.place(offset, triangle, active) for axis in self._axes
        )
        corner = dr.gather(mi.UInt32, self._begins, triangle, active) + u[0] * (along + 1) + v[0]
        step = (u[1] - u[0]) * (along + 1), v[1] - v[0]
        return Neighbours(
            tuple(corner + a * step[0] + b * step[1] for a in (0, 1) for b in (0, 1)),
            tuple(a * b for a in (1 - right, right) for b in (1 - up, up)),
        )


@dataclass(frozen=True)
class _LatticeAxis:
    """One of two sides of all triangles: the lattice's beginning and scale along it, its steps."""

    dual: mi.Float
    low: mi.Float
    scale: mi.Float
    steps: mi.UInt32

    def place(
        self, offset: mi.Vector3f, triangle: mi.UInt32, active: mi.Bool
    ) -> tuple[tuple[mi.UInt32, mi.UInt32], mi.Float, mi.UInt32]:
        """The nodes before and behind a place, how far between them it is, and all steps."""
        low, scale = (dr.gather(mi.Float, v, triangle, active) for v in (self.low, self.scale))
        steps = dr.gather(mi.UInt32, self.steps, triangle, active)
        along = dr.dot(offset, dr.gather(mi.Vector3f, self.dual, triangle, active))
        along = dr.clip((along - low) * scale, 0, mi.Float(steps))
        before = dr.minimum(mi.UInt32(along), dr.maximum(steps, 1) - 1)
        return (before, dr.minimum(before + 1, steps)), along - mi.Float(before), steps


def _corner_values(part: MeshPart, values: Floats) -> Floats:
    """(T, 3, 3) what vertices have, of the corners of each face."""
    return np.asarray(np.asarray(values)[part.mesh.faces], dtype=float)


def _normals(part: MeshPart) -> Floats:
    """(T, 3, 3) of the corners of each face, as it is shaded."""
    if part.smooth:
        return _corner_values(part, part.mesh.vertex_normals)
    corners = _corner_values(part, part.mesh.vertices)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.repeat(normal[:, np.newaxis], 3, axis=1)


def _faces_inwards(scene: mi.Scene, corners: Floats, normals: Floats) -> Mask:
    """(T,) triangles whose other side sees more of the sky: of some parts they face inwards."""
    middle, normal = corners.mean(axis=1), normals.mean(axis=1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    seen = []
    for outwards in (normal, -normal):
        ahead = vectors(outwards.T)
        start = mi.Point3f(vectors((middle + ABOVE_MM * outwards).T))
        count = mi.Float(0)
        for k in range(LOOKS):
            sample = mi.Point2f((k + 0.5) / LOOKS, (k * GOLDEN) % 1)
            way = mi.warp.square_to_cosine_hemisphere(sample)
            ray = mi.Ray3f(start, mi.Frame3f(ahead).to_world(way))
            count += dr.select(scene.ray_test(ray), 0.0, 1.0)
        seen.append(np.array(count))
    return np.asarray(seen[1] > seen[0])


def _duals(sides: Floats) -> Floats:
    """(T, 2, 3) whose products with an offset in the plane are its parts along the two sides."""
    across = np.cross(sides[:, 0], sides[:, 1])
    across /= np.maximum(np.sum(across**2, axis=1, keepdims=True), 1e-30)
    return np.stack([np.cross(sides[:, 1], across), np.cross(across, sides[:, 0])], axis=1)


def _lay_lattices(
    start: Floats, sides: Floats, duals: Floats, box_mm: Floats, spacing_mm: float
) -> tuple[Floats, Floats, Ints]:
    """(T, 2) where lattices begin along both sides, how far they go, in how many steps."""
    corners = np.stack(np.meshgrid(*box_mm.T), axis=-1).reshape(-1, 3)
    place = np.einsum("tsk,tck->tsc", duals, corners - start[:, np.newaxis])
    low, high = np.clip(place.min(axis=2), 0, 1), np.clip(place.max(axis=2), 0, 1)
    span = np.maximum(high - low, 0)
    steps = np.ceil(span * np.linalg.norm(sides, axis=2) / spacing_mm).astype(int)
    small = np.all(steps <= 1, axis=1)
    low[small], span[small], steps[small] = 1 / 3, 0, 0
    return low, span, steps


def _nodes(
    start: Floats,
    sides: Floats,
    normals: Floats,
    part: Ints,
    low: Floats,
    span: Floats,
    steps: Ints,
) -> SurfaceNodes:
    """The nodes of all triangles, those of each together."""
    counts = np.prod(steps + 1, axis=1)
    triangle = np.repeat(np.arange(len(start)), counts)
    rank = np.arange(len(triangle)) - np.repeat(np.cumsum(counts) - counts, counts)
    of = np.column_stack(np.divmod(rank, steps[triangle, 1] + 1))
    place = low[triangle] + span[triangle] * of / np.maximum(steps[triangle], 1)
    point = start[triangle] + np.einsum("ns,nsk->nk", place, sides[triangle])
    shares = np.column_stack([1 - place.sum(axis=1), place])
    normal = np.einsum("ns,nsk->nk", shares, normals[triangle])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    inside = place.sum(axis=1) < 1 + 1e-6
    inwards = start[triangle] + sides[triangle].sum(axis=1) / 3 - point
    inwards /= np.maximum(np.linalg.norm(inwards, axis=1, keepdims=True), ASIDE_MM)
    point = point + ASIDE_MM * inwards
    part = part[triangle]
    return SurfaceNodes(point, point + ABOVE_MM * normal, normal, part, inside)


# From samples on surfaces to other nodes of them.


NEAREST, CANDIDATES = 8, 32  # samples for each node, and those of which they are chosen
# How much farther off, mm, a sample counts whose normal differs by 1 (60 degrees), and one of
# another part; and by how many times that it lies before or behind the node's tangent plane.
# A lit sandwave's picture changes by less than 0.1 % where the first is 150 or the last 12.
NORMAL_MM, APART_MM, ABOVE = 60.0, 1e3, 4.0
NEAR_MM = 0.5  # closer ones weigh no more
RIDGE = 1e-3  # samples in one plane do not say how the field varies across it


class Interpolation:
    """Planes fitted to the nearest samples, of which nearer ones weigh more.

    Near is what is close in space, on the same part, and has a like normal.

    Attributes
    ----------
    near : (N, K) array, the samples about each wanted node, counted among the samples
    shares : (N, K) array, of their values in the node's
    """

    def __init__(self, nodes: SurfaceNodes, samples: Ints, wanted: Ints) -> None:
        """Find what values at some nodes are made of.

        Parameters
        ----------
        nodes : SurfaceNodes, N of them
        samples, wanted : arrays, indices of those where values are known, and are wanted
        """
        count = min(CANDIDATES, len(samples))
        with flushing(False):  # the tree cuts at the next number beside 0, and must not find 0
            tree = cKDTree(like_places(nodes, samples))
            found = tree.query(like_places(nodes, wanted), np.arange(1, count + 1))
        distance, near = np.asarray(found[0]), np.asarray(found[1])
        offset = nodes.point_mm[samples][near] - nodes.point_mm[wanted, np.newaxis]
        distance += ABOVE * np.abs(np.einsum("nki,ni->nk", offset, nodes.normal[wanted]))
        nearest = np.argsort(distance, axis=1, kind="stable")[:, :NEAREST]
        self.near, distance = (np.take_along_axis(v, nearest, 1) for v in (near, distance))
        offset = np.take_along_axis(offset, nearest[..., np.newaxis], 1)
        weight = 1 / (distance + NEAR_MM) ** 2
        offset *= np.sqrt(weight.mean(axis=1))[:, np.newaxis, np.newaxis]
        self._terms = np.concatenate([np.ones_like(offset[..., :1]), offset], axis=2)
        weight /= weight.sum(axis=1, keepdims=True)
        self._weighted = (self._terms * weight[..., np.newaxis]).transpose(0, 2, 1)
        ridge = RIDGE * np.diag([0.0, 1.0, 1.0, 1.0])
        self._inverse = np.linalg.inv(self._weighted @ self._terms + ridge)
        self.shares = (self._inverse[:, :1] @ self._weighted)[:, 0]

    def of(self, values: Floats) -> Floats:
        """Values at the wanted nodes, none beyond those of the samples about it.

        Parameters
        ----------
        values : array, at the samples
        """
        near = values[self.near]
        fitted = np.einsum("nk,nk->n", self.shares, near)
        return np.asarray(np.clip(fitted, near.min(axis=1), near.max(axis=1)))

    def matrix(self, samples: int) -> sparse.csr_array:
        """What turns values at so many samples into those at the wanted nodes, unbounded.

        Parameters
        ----------
        samples : int, number of all of them
        """
        rows, count = self.near.shape
        start = np.arange(0, rows * count + 1, count)
        return sparse.csr_array(
            (self.shares.ravel(), self.near.ravel(), start), shape=(rows, samples)
        )

    def residual(self, values: Floats) -> Floats:
        """By how much the samples about each wanted node differ from their plane, at most.

        Parameters
        ----------
        values : array, at the samples
        """
        near = values[self.near][..., np.newaxis]
        plane = self._inverse @ (self._weighted @ near)
        return np.asarray(np.abs(self._terms @ plane - near).max(axis=(1, 2)))


def like_places(nodes: SurfaceNodes, index: Ints) -> Floats:
    """(N, 7) mm, near each other where nodes are, on the same part, and have like normals."""
    point, normal, part = nodes.point_mm[index], nodes.normal[index], nodes.part[index]
    return np.column_stack([point, NORMAL_MM * normal, APART_MM * part])


# How much of a uniform sky's light arrives on surfaces, straight and by way of others.


# From each sample, on a spiral over the disc that a hemisphere is seen as.  Of the sky, what an
# endless wall hides at any distance and in any direction is found to 0.3 %, rms, and 1 % at most.
DIRECTIONS = 512
TURN = pi * (3 - sqrt(5))
BATCH = 2**20  # rays of one launch, and numbers at a time
SETTLED = 1e-4  # of an open surface's light, by which the last bounce changes it
# Of the largest side of what stands in the tank: how far about it the field is known, and the
# lattice's spacing, 5 mm of a block of 220.
BEYOND, SPACING = 1.0, 1 / 44
# Sides of the cells that hold a sample, in spacings, one after the other, where the open sky about
# a node differs from a plane by more than UNEVEN.
CELLS, UNEVEN = (4.0, 2.0, 1.0, 0.5), 0.02
FLAT_MM = 0.1  # what stands out less shades nothing

# Tanks of one process often differ in the laser or the sensor alone: what the last few skies gave
# at the nodes, straight and indirect, by all that it depends on.
_KEPT: dict[str, tuple[NDArray[np.float32], NDArray[np.float32]]] = {}
MOST_KEPT = 4


class OpenSky:
    """What arrives on surfaces of a uniform sky's light where nothing stands before any."""

    def received(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> tuple[mi.Float, mi.Float]:
        """All of the light straight from the sky, and none by way of anything else.

        Parameters
        ----------
        si, active : as of ``AmbientField.received``
        """
        return mi.Float(1), mi.Float(0)


@dataclass(frozen=True)
class AmbientField:
    """What arrives on surfaces of a uniform sky's light, over what an open surface receives.

    Attributes
    ----------
    lattice : NodeLattice
    straight : Float, at its nodes, of the light that comes from the sky itself
    indirect : Float, at its nodes, of the light by way of surfaces and of the water between them
    """

    lattice: NodeLattice
    straight: mi.Float
    indirect: mi.Float

    def received(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> tuple[mi.Float, mi.Float]:
        """Straight and indirect light on places of surfaces.

        Parameters
        ----------
        si : SurfaceInteraction3f, the places
        active : Bool, for which places it is wanted
        """
        about = self.lattice.find(si, active)
        return about.mean(self.straight, active), about.mean(self.indirect, active)


def sky_of(scene: mi.Scene, parts: Sequence[MeshPart], water: Optics) -> AmbientField | OpenSky:
    """How a uniform sky lights what stands in a tank.

    Parameters
    ----------
    scene : mi.Scene, its shapes are the parts
    parts : sequence of MeshPart, matt
    water : Optics, between them
    """
    if is_convex(parts):
        return OpenSky()
    box_mm, spacing_mm = box_about(parts)
    lattice = NodeLattice(scene, parts, box_mm, spacing_mm)
    name = _name(lattice.nodes, parts, water)
    if name not in _KEPT:
        while len(_KEPT) >= MOST_KEPT:
            del _KEPT[next(iter(_KEPT))]
        _KEPT[name] = _node_light(scene, lattice, water)
    straight, indirect = _KEPT[name]
    return AmbientField(lattice, floats(straight), floats(indirect))


def _name(nodes: SurfaceNodes, parts: Sequence[MeshPart], water: Optics) -> str:
    """A checksum of all that the light which arrives at nodes depends on."""
    told = hashlib.sha256(repr((water.extinction_per_mm, water.scattering_per_mm)).encode())
    arrays = list(vars(nodes).values())
    for part in parts:
        told.update(repr((part.albedo, part.smooth, part.finish, part.paint is None)).encode())
        arrays += [part.mesh.vertices, part.mesh.faces]
        arrays += [part.paint.levels, part.paint.uv] if part.paint is not None else []
    for array in arrays:
        told.update(repr(np.shape(array)).encode())
        told.update(np.ascontiguousarray(array).tobytes())
    return told.hexdigest()


def _node_light(
    scene: mi.Scene, lattice: NodeLattice, water: Optics
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Straight and indirect light at the nodes."""
    nodes = lattice.nodes
    samples = _samples(scene, lattice, water)
    interpolation = Interpolation(nodes, samples.index, np.arange(len(nodes.inside)))
    straight = interpolation.of(samples.open).astype(np.float32)
    indirect, before = np.zeros_like(straight), np.ones_like(straight)
    while np.abs(indirect - before).max() > SETTLED:
        received, before = straight + indirect, indirect
        sent = np.einsum("mn,mn->m", received[samples.node], samples.share) / DIRECTIONS
        indirect = interpolation.of(samples.veil + sent).astype(np.float32)
    return straight, indirect


def reflectance(si: mi.SurfaceInteraction3f) -> mi.Float:
    """Of matt surfaces, 0 to 1, on the side that is seen.

    Parameters
    ----------
    si : SurfaceInteraction3f, what rays meet
    """
    upright = mi.Vector3f(0, 0, dr.select(mi.Frame3f.cos_theta(si.wi) < 0, -1.0, 1.0))
    return dr.pi * si.bsdf().eval(mi.BSDFContext(), si, upright, si.is_valid()).x


@dataclass(frozen=True)
class AmbientSamples:
    """What the directions from samples meet, M samples of N directions each.

    Attributes
    ----------
    index : (M,) array, of the nodes that are the samples
    open : (M,) array, share of the directions that meets nothing
    veil : (M,) array, mean of what the water on the way to surfaces adds to the light
    share : (M, N) array, reflectance of what a direction meets, times the transmittance
    node : (M, N) array, nearest to that place
    """

    index: Ints
    open: Floats
    veil: Floats
    share: NDArray[np.float32]
    node: NDArray[np.uint32]


def _samples(scene: mi.Scene, lattice: NodeLattice, water: Optics) -> AmbientSamples:
    """Samples of the field, denser and denser where the open sky is not linear between them."""
    nodes = lattice.nodes
    cells_mm = np.array(CELLS) * lattice.spacing_mm
    wanted = candidates = one_a_cell(nodes, np.flatnonzero(nodes.inside), cells_mm[-1])
    found: list[AmbientSamples] = []
    for cell_mm in cells_mm:
        chosen = one_a_cell(nodes, wanted, cell_mm)
        found.append(trace_all(scene, lattice, water, chosen))
        candidates = np.setdiff1d(candidates, chosen)
        index, sky = (np.concatenate([getattr(s, k) for s in found]) for k in ("index", "open"))
        wanted = candidates[Interpolation(nodes, index, candidates).residual(sky) > UNEVEN]
        if not wanted.size:
            break
    return join_samples(found)


def join_samples(some: Sequence[AmbientSamples]) -> AmbientSamples:
    """All samples together.

    Parameters
    ----------
    some : sequence of AmbientSamples, one at least
    """
    fields = zip(*(vars(samples).values() for samples in some), strict=True)
    return AmbientSamples(*(np.concatenate(field) for field in fields))


def one_a_cell(nodes: SurfaceNodes, index: Ints, cell_mm: float) -> Ints:
    """Of some nodes, one in each cube of space and of directions."""
    place = np.column_stack([nodes.point_mm[index] / cell_mm, 2 * nodes.normal[index]])
    cells = np.round(place).astype(np.int64)
    cells -= cells.min(axis=0)
    _, first = np.unique(np.ravel_multi_index(cells.T, cells.max(axis=0) + 1), return_index=True)
    return index[first]


def trace_all(scene: mi.Scene, lattice: NodeLattice, water: Optics, index: Ints) -> AmbientSamples:
    """What directions from nodes meet, of those nodes that are not within bodies.

    Parameters
    ----------
    scene, lattice, water : as the samples are of
    index : array, of the nodes, one at least
    """
    batches = np.array_split(index, -(-len(index) * DIRECTIONS // BATCH))
    samples = join_samples([_trace(scene, lattice, water, part) for part in batches])
    return select(samples, samples.open > 0)


def _trace(scene: mi.Scene, lattice: NodeLattice, water: Optics, index: Ints) -> AmbientSamples:
    """What directions from nodes meet."""
    shape = len(index), DIRECTIONS
    sample, number = np.divmod(np.arange(shape[0] * shape[1], dtype=np.uint32), shape[1])
    start, normal = (
        vectors(values[index][sample].T)
        for values in (lattice.nodes.start_mm, lattice.nodes.normal)
    )
    radius2 = (number + 0.5) / DIRECTIONS
    spiral = [f(TURN * number) * np.sqrt(radius2) for f in (np.cos, np.sin)]
    towards = vectors([*spiral, np.sqrt(1 - radius2)])
    ray = mi.Ray3f(mi.Point3f(start), mi.Frame3f(normal).to_world(towards))
    si = scene.ray_intersect(ray)
    met = si.is_valid()
    passed = dr.select(met, dr.exp(-water.extinction_per_mm * si.t), 1.0)
    albedo = water.scattering_per_mm / max(water.extinction_per_mm, 1e-20)
    share = dr.select(met, passed * reflectance(si), 0.0)
    columns = [met, albedo * (1 - passed), share, lattice.find(si, met).nearest()]
    dr.eval(columns)
    hit, veil, share, node = (np.array(column).reshape(shape) for column in columns)
    return AmbientSamples(index, 1 - hit.mean(axis=1), veil.mean(axis=1, dtype=float), share, node)


def box_about(parts: Sequence[MeshPart]) -> tuple[Floats, float]:
    """(2, 3) corners of a box about all that stands in the tank, and the spacing of nodes in it."""
    bounds = np.array([part.mesh.bounds for part in parts if part.name != "floor"])
    low, high = bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)
    side = float((high - low).max())
    return np.array([low - BEYOND * side, high + BEYOND * side]), SPACING * side


def is_convex(parts: Sequence[MeshPart]) -> bool:
    """Whether all surfaces lie on one convex body, or nearly: nothing stands before any.

    An open surface that is not flat, as of a bowl, is seen from within too.  A board is open
    where it is bent, too: what it hides of itself is negligible (sim.scene.errors).
    """
    if not parts or {part.name for part in parts} == set(BOARD_PARTS):
        return True
    points = np.concatenate([part.mesh.vertices for part in parts])
    closed = [part.mesh.is_watertight for part in parts]
    flat = all(_is_flat(p.mesh.vertices) for p, c in zip(parts, closed, strict=True) if not c)
    if not _is_flat(points) and not (flat and any(closed)):
        return False
    hull = -np.unique(ConvexHull(points, qhull_options="QJ").equations.round(6), axis=0)
    corners = np.concatenate([part.mesh.vertices[part.mesh.faces] for part in parts])
    some = np.array_split(corners, -(-len(corners) * len(hull) // BATCH))
    depths = ((part @ hull[:, :3].T + hull[:, 3]).max(axis=1).min(axis=1) for part in some)
    return all(np.all(depth < FLAT_MM) for depth in depths)


def _is_flat(points: Floats) -> bool:
    """Whether points lie in one plane, or nearly."""
    centred = points - points.mean(axis=0)
    across = np.linalg.svd(centred, full_matrices=False)[2][-1]
    return bool(np.ptp(centred @ across) < FLAT_MM)
