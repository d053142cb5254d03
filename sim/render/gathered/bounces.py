"""Light that surfaces send to and fro: what a tank's patches make of the light that they receive.

The surfaces stand still, so what patches receive of the light they all send, over every number of
reflections, is one matrix.  Light that a line gives them varies within a patch: what is reflected
first is known at many more places, the senders.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import pi

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import sparse

from lscan.records import Floats, Ints, Mask
from sim.meshes import MeshPart
from sim.render.ambient.field import (
    DIRECTIONS,
    AmbientSamples,
    box_about,
    joined,
    one_a_cell,
    traced_all,
)
from sim.render.ambient.interpolation import NEAR_MM, Interpolation, like_places
from sim.render.ambient.lattice import NodeLattice
from sim.render.plugins.arrays import floats, indices, vectors
from sim.water import Optics
from sim.water.tablecache import kept_arrays

# Sides of the cells that hold a patch each, in the lattice's spacings: about surfaces of whose
# sky more than SHADED is hidden they are the least of FINE that gives no more patches.
MOST_PATCHES, MOST_SENDERS = 1200, 20000
COARSE, FINE, SHADED = 8.0, (1.0, 1.4, 2.0, 2.8, 4.0), 0.1
FORMAT = 3  # of the kept files: raised where other numbers would be written
ANGLES = 4096  # at which the phase function is summed


def lasting(water: Optics) -> Optics:
    """The water as light among surfaces meets it: with scattering less what goes on forwards.

    Light that turns by little on a way which is short against the attenuation length lands beside
    where it would have: it is not lost.  By the similarity relation b becomes b (1 - g), with g the
    mean cosine of a turn.  What of the rest reaches surfaces all the same is neglected.

    Parameters
    ----------
    water : Optics

    References
    ----------
    van de Hulst, H. C. (1980). Multiple Light Scattering. Academic Press, chapter 14.
    """
    angle = np.geomspace(1e-7, pi, ANGLES)
    middle = np.sqrt(angle[1:] * angle[:-1])
    lost = 2 * pi * water.phase(middle) * np.sin(middle) * (1 - np.cos(middle)) * np.diff(angle)
    return replace(water, scattering_per_mm=water.scattering_per_mm * float(lost.sum()))


class Bounces:
    """Patches of a tank's surfaces, and what they make of the light that they receive."""

    def __init__(self, scene: mi.Scene, parts: Sequence[MeshPart], water: Optics) -> None:
        """Trace directions from the patches, once a tank.

        Parameters
        ----------
        scene : mi.Scene, its shapes are the parts
        parts : sequence of MeshPart, matt
        water : Optics, as ``lasting``
        """
        box_mm, spacing_mm = box_about(parts)
        self._lattice = NodeLattice(scene, parts, box_mm, spacing_mm)
        kept = kept_arrays(_name(parts, water), lambda: _tables(scene, self._lattice, water))
        index, self._more = kept["index"].astype(np.intp), kept["more"]
        self._near = [indices(near) for near in kept["near"].T]
        self._shares = [floats(share) for share in kept["shares"].T]
        self.point, self.normal = self._places(index)
        self._about = kept["near"][index].astype(np.intp)
        place = like_places(self._lattice.nodes, index)
        distance = np.linalg.norm(place[self._about] - place[:, np.newaxis], axis=2)
        self._closeness = 1 / (distance + NEAR_MM) ** 2
        senders = kept["senders"].astype(np.intp)
        self.sender_point, self.sender_normal = self._places(senders)
        self._owners = kept["owners"].astype(np.intp)
        self.owner = indices(self._owners)
        patch, sender = kept["pairs"].T.astype(np.intp)
        shape = len(index), len(senders)
        self._first = sparse.csr_array((kept["met"], (patch, sender)), shape=shape)

    def _places(self, node: Ints) -> tuple[mi.Point3f, mi.Vector3f]:
        """Points and normals of nodes."""
        nodes = self._lattice.nodes
        return mi.Point3f(vectors(nodes.point_mm[node].T)), vectors(nodes.normal[node].T)

    def about(self, values: Floats) -> Floats:
        """Sums over each patch and the senders that lie on it, (N,).

        Parameters
        ----------
        values : (S,) array, of senders, on the patches ``owner``
        """
        return np.asarray(np.bincount(self._owners, values, len(self._more)), dtype=float)

    def apart(self, values: Floats, here: Mask) -> list[Floats]:
        """(N,) values about patches that are ``here``, and about those that are not.

        A patch that is not among them has the mean of those near it that are, or, where none is,
        its own value.

        Parameters
        ----------
        values : (N,) array, of patches
        here : (N,) mask
        """
        sides = []
        for side in (here, ~here):
            weight = self._closeness * side[self._about]
            total = weight.sum(axis=1)
            mean = (weight * values[self._about]).sum(axis=1) / np.where(total > 0, total, 1)
            sides.append(np.where(side | (total == 0), values, mean))
        return sides

    def of(self, irradiance: Floats) -> Floats:
        """What patches receive of the light that surfaces reflect, any number of times, (N,).

        Parameters
        ----------
        irradiance : (S,) mW/mm2, what the senders receive without that
        """
        once = self._first @ irradiance
        return np.asarray(once + np.einsum("mn,n->m", self._more, once))

    def field(self, values: Sequence[Floats]) -> "PatchField":
        """Values of patches, to be known at all places of surfaces.

        Parameters
        ----------
        values : sequence of (N,) arrays, which are read in groups of four
        """
        groups = []
        for first in range(0, len(values), 4):
            some = values[first : first + 4]
            kind = _kind(len(some))
            columns = np.zeros((len(self._more), 1 if kind is mi.Float else 4), np.float32)
            columns[:, : len(some)] = np.stack(some, axis=-1)
            patches, total = floats(columns), kind(0)
            for near, share in zip(self._near, self._shares, strict=True):
                total += share * dr.gather(kind, patches, near)
            groups.append(dr.ravel(total))
        return PatchField(self._lattice, tuple(groups), len(values))


@dataclass(frozen=True)
class PatchField:
    """Numbers known at the lattice's nodes, in groups of four; count: of all numbers of a node."""

    lattice: NodeLattice
    groups: tuple[mi.Float, ...]
    count: int

    def at(self, si: mi.SurfaceInteraction3f) -> list[mi.Float]:
        """The numbers at places of surfaces.

        Parameters
        ----------
        si : SurfaceInteraction3f, the places
        """
        active = si.is_valid()
        about = self.lattice.find(si, active)
        numbers: list[mi.Float] = []
        for place, values in enumerate(self.groups):
            kind = _kind(self.count - 4 * place)
            total = kind(0)
            for node, weight in zip(about.index, about.weight, strict=True):
                total += weight * dr.gather(kind, values, node, active)
            numbers += [total] if kind is mi.Float else [*total]
        return [dr.maximum(number, 0) for number in numbers[: self.count]]


def _kind(left: int) -> type[mi.Float] | type[mi.Vector4f]:
    """What a group holds of so many numbers that are left: to gather one alone takes less."""
    return mi.Float if left == 1 else mi.Vector4f


def _name(parts: Sequence[MeshPart], water: Optics) -> str:
    """Of the kept file, by all that the tables depend on."""
    told = hashlib.sha256(repr((FORMAT, water.extinction_per_mm)).encode())
    for part in parts:
        told.update(repr((part.albedo, part.smooth)).encode())
        arrays = [part.mesh.vertices, part.mesh.faces]
        arrays += [part.paint.levels, part.paint.uv] if part.paint is not None else []
        for array in arrays:
            told.update(np.ascontiguousarray(array).tobytes())
    return f"patches-{told.hexdigest()[:32]}"


def _tables(scene: mi.Scene, lattice: NodeLattice, water: Optics) -> dict[str, Floats]:
    """Patches and senders, what comes of light on them, and which patches each node is near."""
    nodes = lattice.nodes
    samples = _patches(scene, lattice, water)
    index = samples.index
    about = Interpolation(nodes, index, np.arange(len(nodes.inside)))
    patch = np.repeat(np.arange(len(index)), DIRECTIONS)
    share, node = samples.share.ravel() / DIRECTIONS, samples.node.ravel()
    met = sparse.csr_array((share, (patch, node)), shape=(len(index), len(nodes.inside)))
    once = np.asarray((met @ about.matrix(len(index))).todense())
    more = np.linalg.solve(np.eye(len(index)) - once, once)
    seen, of_seen = np.unique(node[share > 0].astype(np.intp), return_inverse=True)
    sending = _thinned(lattice, seen, MOST_SENDERS)
    sender = len(index) + Interpolation(nodes, sending, seen).near[:, 0][of_seen]
    senders = np.concatenate([index, sending])  # patches that no light leaves may be lit, too
    size = len(index), len(senders)
    first = sparse.coo_array((share[share > 0], (patch[share > 0], sender)), shape=size)
    first.sum_duplicates()
    tables = {
        "index": index,
        "more": more,
        "near": about.near,
        "shares": about.shares,
        "senders": senders,
        "owners": about.near[senders, 0],
        "pairs": np.column_stack(first.coords),
        "met": first.data,
    }
    return {name: np.asarray(table, dtype=np.float32) for name, table in tables.items()}


def _patches(scene: mi.Scene, lattice: NodeLattice, water: Optics) -> AmbientSamples:
    """Patches of all surfaces, and more of them on those that see others."""
    nodes = lattice.nodes
    inside = np.flatnonzero(nodes.inside)
    coarse = one_a_cell(nodes, inside, COARSE * lattice.spacing_mm)
    first = traced_all(scene, lattice, water, coarse)
    sky = Interpolation(nodes, first.index, inside).of(first.open)
    shaded = np.setdiff1d(inside[sky < 1 - SHADED], coarse)
    more = _thinned(lattice, shaded, MOST_PATCHES - len(coarse))
    return joined([first, traced_all(scene, lattice, water, more)]) if more.size else first


def _thinned(lattice: NodeLattice, among: Ints, most: int) -> Ints:
    """One of some nodes in each cell, of the least of FINE that gives no more than ``most``."""
    for cell in FINE:
        chosen = one_a_cell(lattice.nodes, among, cell * lattice.spacing_mm)
        if len(chosen) <= most:
            break
    return chosen
