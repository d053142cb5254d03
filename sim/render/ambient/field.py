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
from scipy.spatial import ConvexHull

from lscan.records import Floats, Ints, select
from sim.meshes import MeshPart
from sim.meshes.board import BOARD_PARTS
from sim.render.ambient.lattice import Interpolation, NodeLattice, SurfaceNodes
from sim.render.plugins.arrays import floats, vectors
from sim.water import Optics

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
        _KEPT[name] = _arriving(scene, lattice, water)
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


def _arriving(
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
        found.append(traced_all(scene, lattice, water, chosen))
        candidates = np.setdiff1d(candidates, chosen)
        index, sky = (np.concatenate([getattr(s, k) for s in found]) for k in ("index", "open"))
        wanted = candidates[Interpolation(nodes, index, candidates).residual(sky) > UNEVEN]
        if not wanted.size:
            break
    return joined(found)


def joined(some: Sequence[AmbientSamples]) -> AmbientSamples:
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


def traced_all(scene: mi.Scene, lattice: NodeLattice, water: Optics, index: Ints) -> AmbientSamples:
    """What directions from nodes meet, of those nodes that are not within bodies.

    Parameters
    ----------
    scene, lattice, water : as the samples are of
    index : array, of the nodes, one at least
    """
    batches = np.array_split(index, -(-len(index) * DIRECTIONS // BATCH))
    samples = joined([_traced(scene, lattice, water, part) for part in batches])
    return select(samples, samples.open > 0)


def _traced(scene: mi.Scene, lattice: NodeLattice, water: Optics, index: Ints) -> AmbientSamples:
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
