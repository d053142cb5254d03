"""Laser light that surfaces reflect onto each other, without random noise.

The line of each sheet lights other surfaces as short straight segments of a matt surface do, in
closed form, less what is hidden.  What those surfaces reflect in their turn comes from patches
(``bounces``), as does how much of the lines is hidden.
"""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import asinh, pi

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import sparse

from lscan.records import Floats, Ints, Mask
from sim.meshes import MeshPart
from sim.render.ambient import (
    DIRECTIONS,
    NEAR_MM,
    TURN,
    AmbientSamples,
    Interpolation,
    NodeLattice,
    box_about,
    is_convex,
    join_samples,
    like_places,
    one_a_cell,
    reflectance,
    trace_all,
)
from sim.render.gathered.line import (
    CLUSTER,
    CREASE_RAD,
    LEAVES,
    SEGMENTS,
    START_MM,
    Glow,
    LitLine,
    facing,
    lit_line,
    received,
    visible_part,
)
from sim.render.plugins.arrays import floats, indices, opaque, vectors
from sim.render.plugins.sheet import LaserSheet
from sim.render.plugins.water import PhaseTable
from sim.render.sampled.integrator import SheetIntegrator
from sim.water import Optics
from sim.water.tablecache import kept_arrays

# Light that surfaces send to and fro: what a tank's patches make of the light that they receive.
#
# The surfaces stand still, so what patches receive of the light they all send, over every number of
# reflections, is one matrix.  Light that a line gives them varies within a patch: what is reflected
# first is known at many more places, the senders.


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
            room = 1 if kind is mi.Float else dr.size_v(kind)
            columns = np.zeros((len(self._more), room), np.float32)
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


def _kind(left: int) -> type[mi.Float] | type[mi.Vector2f] | type[mi.Vector4f]:
    """What a group holds of so many numbers that are left: to gather few takes less."""
    return {1: mi.Float, 2: mi.Vector2f}.get(left, mi.Vector4f)


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
    sending = _thin(lattice, seen, MOST_SENDERS)
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
    first = trace_all(scene, lattice, water, coarse)
    sky = Interpolation(nodes, first.index, inside).of(first.open)
    shaded = np.setdiff1d(inside[sky < 1 - SHADED], coarse)
    more = _thin(lattice, shaded, MOST_PATCHES - len(coarse))
    return join_samples([first, trace_all(scene, lattice, water, more)]) if more.size else first


def _thin(lattice: NodeLattice, among: Ints, most: int) -> Ints:
    """One of some nodes in each cell, of the least of FINE that gives no more than ``most``."""
    for cell in FINE:
        chosen = one_a_cell(lattice.nodes, among, cell * lattice.spacing_mm)
        if len(chosen) <= most:
            break
    return chosen


# Light that was reflected twice and more, beside a lit line.
#
# Where the line runs into a corner such light falls off within millimetres of it, far closer than
# patches lie.  It is gathered anew at the most lit nodes of a lattice along the line and across it,
# out of a few directions each, from what patches and the line send there.


# Columns on either side of the line, at hyperbolic sines of even steps: the first is about
# FINEST_MM off, the last, at REACH_MM, knows what patches do.
ASIDE, FINEST_MM, REACH_MM = 5, 1.0, 20.0
COLUMNS, STEP = 2 * ASIDE + 1, asinh(REACH_MM / FINEST_MM) / ASIDE
GATHERING, BESIDE_DIRECTIONS = 704, 32  # nodes, and directions from each
# Rows along the line: one for every other segment, and others so many mm before the ends of its
# pieces, for in a corner light grows as fast as the distance shrinks.
EVERY, CORNER_MM = 2, (0.25, 0.8, 2.0)
ROWS = SEGMENTS // EVERY + 128
FAN_ANGLES = 16384  # of the fan, at which the place between rows is kept
# Off a node's tangent plane, of places on its surface, beside LEAVES times as far.
OFF_PLANE_MM = 0.05
LIKE = 1 - 2 * CREASE_RAD**2  # cosine between normals of one surface: twice a crease
Radiosity = Callable[[mi.SurfaceInteraction3f], mi.Float]


@dataclass(frozen=True)
class BesideLine:
    """Irradiance about the line of a sheet, where it is placed.

    Attributes
    ----------
    sheet : LaserSheet
    nodes : Float, 8 numbers each, row by row: place in mm, irradiance in mW/mm2; normal, 0
    rows : Float, at ANGLES of the fan, the number of the row there
    """

    sheet: LaserSheet
    nodes: mi.Float
    rows: mi.Float

    def at(self, point: mi.Point3f, normal: mi.Vector3f, otherwise: mi.Float) -> mi.Float:
        """At places of surfaces; linear between those of the four nodes that lie on the same one.

        Parameters
        ----------
        point, normal : Point3f, mm, and Vector3f, of the places
        otherwise : Float, where there are none
        """
        phi, _, aside = self.sheet.coordinates(point, mi.Float(0))
        return dr.if_stmt(  # few places are: the others cost nothing
            (point, normal, phi, aside, otherwise),
            (dr.abs(aside) < REACH_MM) & (dr.abs(phi) < self.sheet.half_angle),
            self._between_nodes,
            lambda *at: at[-1],
        )

    def _between_nodes(
        self,
        point: mi.Point3f,
        normal: mi.Vector3f,
        phi: mi.Float,
        aside: mi.Float,
        otherwise: mi.Float,
    ) -> mi.Float:
        """At places within the nodes: rad from the fan's axis and mm off the sheet's plane."""
        angle, along = _between(
            (phi / self.sheet.half_angle + 1) * (0.5 * (FAN_ANGLES - 1)), FAN_ANGLES
        )
        first, behind = (dr.gather(mi.Float, self.rows, angle + k) for k in (0, 1))
        row, down = _between(first + along * (behind - first), ROWS)
        column, right = _between(dr.asinh(aside / FINEST_MM) / STEP + ASIDE, COLUMNS)
        total, weight = mi.Float(0), mi.Float(0)
        for one, high in ((0, 1 - down), (1, down)):
            for other, wide in ((0, 1 - right), (1, right)):
                index = 2 * ((row + one) * COLUMNS + column + other)
                node = dr.gather(mi.Vector4f, self.nodes, index)
                upright = dr.gather(mi.Vector4f, self.nodes, index + 1)
                plane = mi.Vector3f(upright.x, upright.y, upright.z)
                offset = point - mi.Point3f(node.x, node.y, node.z)
                above = dr.abs(dr.dot(offset, plane)) - LEAVES * dr.norm(offset)
                same = (above < OFF_PLANE_MM) & (dr.dot(normal, plane) > LIKE)
                share = dr.select(same, high * wide, 0.0)
                total, weight = total + share * node.w, weight + share
        return dr.select(weight > 0, total / weight, otherwise)


def _between(place: mi.Float, count: int) -> tuple[mi.UInt32, mi.Float]:
    """The last of so many nodes before a place, but for the very last, and how far behind it."""
    place = dr.clip(place, 0, count - 1)
    before = dr.minimum(mi.UInt32(place), count - 2)
    return before, place - mi.Float(before)


def beside_line(
    scene: mi.Scene, sheet: LaserSheet, line: LitLine, field: PatchField, sent: Radiosity
) -> BesideLine:
    """Gather the light beside a line.

    Parameters
    ----------
    scene : mi.Scene
    sheet : LaserSheet, where it is placed
    line : LitLine, its line
    field : PatchField, whose first two numbers are irradiance by light that was reflected once,
        and more often
    sent : function of what rays meet, the radiosity in mW/mm2 that arrives of it
    """
    place = _row_places(np.array(line.segments).reshape(SEGMENTS, -1))
    phi, _, _ = sheet.coordinates(mi.Point3f(vectors(place.T)), mi.Float(0))
    angle = np.maximum.accumulate(np.array(phi))
    half, number = float(sheet.half_angle[0]), np.arange(ROWS)
    rows = np.interp(np.linspace(-half, half, FAN_ANGLES), angle, number)
    lane = dr.arange(mi.UInt32, ROWS * COLUMNS)
    column = mi.Float(lane % COLUMNS) - ASIDE
    origin = sheet.apex(mi.Float(0)) + sheet.normal * (FINEST_MM * dr.sinh(STEP * column))
    way = sheet.direction(dr.gather(mi.Float, floats(angle), lane // COLUMNS))
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(origin), dr.normalize(way)))
    normal, (_, more, *_) = facing(si), field.at(si)
    inner = si.is_valid() & (dr.abs(column) < ASIDE)
    close, _ = received(line, si.p, normal, mi.Float(0), inner)
    columns = [*si.p, more, *normal, mi.Float(0), close]
    dr.eval(columns)
    nodes = np.stack([np.broadcast_to(np.array(values), len(lane)) for values in columns], axis=-1)
    most = np.argsort(-nodes[:, 8], kind="stable")[:GATHERING]
    nodes[most, 3] = _gather(scene, most, nodes[most], sent)
    return BesideLine(sheet, floats(nodes[:, :8]), floats(rows))


def _row_places(segments: Floats) -> Floats:
    """(ROWS, 3) mm, along the line: the middles of its segments, and places near corners.

    Its pieces end where the next segment begins by more than half of one farther on, or is turned.
    """
    middle, half, along = segments[:, :3], segments[:, 3:4], segments[:, 8:11]
    ends = np.stack([middle - half * along, middle + half * along])
    apart = np.linalg.norm(ends[0, 1:] - ends[1, :-1], axis=1) > half[1:, 0]
    turned = np.sum(segments[1:, 4:7] * segments[:-1, 4:7], axis=1) < LIKE
    cut = np.concatenate([[True], apart | turned, [True]])
    places, order = [middle[::EVERY]], [np.arange(0, SEGMENTS, EVERY, dtype=float)]
    for which, (end, sign) in enumerate(zip(ends, (1, -1), strict=True)):
        number = np.flatnonzero(cut[which : which + SEGMENTS])
        for off_mm in CORNER_MM:
            inner = number[CLUSTER * half[number, 0] > off_mm]
            places.append(end[inner] + sign * off_mm * along[inner])
            order.append(inner - sign * (1 - off_mm / half[inner, 0]) / 2)
    placed = np.concatenate(places)[np.argsort(np.concatenate(order)[:ROWS], kind="stable")]
    return np.pad(placed, ((0, ROWS - len(placed)), (0, 0)), mode="edge")


def _gather(scene: mi.Scene, number: Ints, nodes: Floats, sent: Radiosity) -> Floats:
    """Irradiance of nodes, given their numbers: means over directions on a spiral each."""
    lane = dr.arange(mi.UInt32, BESIDE_DIRECTIONS * len(number))
    index, which = lane // BESIDE_DIRECTIONS, lane % BESIDE_DIRECTIONS
    point, normal = (
        dr.gather(kind, floats(nodes[:, some]), index)
        for kind, some in ((mi.Point3f, np.s_[:3]), (mi.Vector3f, np.s_[4:7]))
    )
    turned = BESIDE_DIRECTIONS * dr.gather(mi.UInt32, indices(number), index)
    sine, cosine = dr.sincos(TURN * mi.Float(turned + which))
    radius2 = (mi.Float(which) + 0.5) / BESIDE_DIRECTIONS
    radius = dr.sqrt(radius2)
    towards = mi.Vector3f(cosine * radius, sine * radius, dr.sqrt(1 - radius2))
    ray = mi.Ray3f(point + START_MM * normal, mi.Frame3f(normal).to_world(towards))
    return (
        np.array(dr.block_sum(sent(scene.ray_intersect(ray)), BESIDE_DIRECTIONS))
        / BESIDE_DIRECTIONS
    )


# Laser light that surfaces reflect onto each other, without random noise.


# How much of the light that a sheet's rays scatter onto a surface other surfaces let through.
#
# Most of it comes along the ray that meets the surface.  Where that is stopped, a place in shadow
# receives a fraction of what is received beside it: light on either side is kept apart.


# Rays of the sheet that stand for all, and places on each: of equal shares of the light that is
# scattered once where it falls off as the square of the distance from the ray.
RAYS, PLACES = 6, 4
OFF_SURFACE_MM = 0.01  # off the surface


def visible_share(
    scene: mi.Scene, sheet: LaserSheet, phase: PhaseTable, point: mi.Point3f, normal: mi.Vector3f
) -> mi.Float:
    """Share of the sheet's light, scattered once, that gets to places of surfaces, 0 to 1.

    Parameters
    ----------
    scene : mi.Scene
    sheet : LaserSheet, where it is placed
    phase : PhaseTable, of the water
    point : Point3f, mm, world frame
    normal : Vector3f, of the surface, on the side that is lit
    """
    lane = dr.arange(mi.UInt32, dr.width(point) * RAYS)
    index, ray = lane // RAYS, mi.Float(lane % RAYS)
    point, normal = dr.gather(mi.Point3f, point, index), dr.gather(mi.Vector3f, normal, index)
    phi, rho, s = sheet.coordinates(point, mi.Float(0))
    aside = dr.maximum(dr.abs(s), 0.5 * sheet.half_width(rho))
    angle = phi + aside * dr.tan(pi * ((ray + 0.5) / RAYS - 0.5)) / rho
    inside = dr.abs(angle) <= sheet.half_angle
    way = dr.normalize(sheet.direction(angle))
    apex = sheet.apex(mi.Float(0))
    ends = scene.ray_intersect_preliminary(mi.Ray3f(apex, way), active=inside).t
    offset = point - apex
    foot = dr.dot(offset, way)
    beside = dr.norm(offset - way * foot)
    below = phase.line_integral(dr.atan2(beside, foot))
    above = phase.line_integral(mi.Float(pi / 2))
    start, total, seen = point + normal * OFF_SURFACE_MM, mi.Float(0), mi.Float(0)
    for place in range(PLACES):
        turned = phase.sample_line(below, above, mi.Float((place + 0.5) / PLACES))
        along = dr.maximum(foot - beside / dr.tan(turned), 0)
        towards = apex + way * along - point
        distance = dr.norm(towards)
        towards /= distance
        weight = dr.select(inside, dr.maximum(dr.dot(towards, normal), 0), 0.0)
        total += weight
        lit = (weight > 0) & (along < ends)
        hidden = scene.ray_test(mi.Ray3f(start, towards, distance, 0.0, []), lit)
        seen += dr.select(lit & ~hidden, weight, 0.0)
    dr.eval(total, seen)  # once: each sum would work both out
    total, seen = dr.block_sum(total, RAYS), dr.block_sum(seen, RAYS)
    return dr.select(total > 0, seen / total, 1.0)


def sees_apex(
    scene: mi.Scene, sheet: LaserSheet, point: mi.Point3f, normal: mi.Vector3f, active: mi.Bool
) -> mi.Bool:
    """Whether nothing lies between places and where a sheet's rays come from; False if inactive.

    Parameters
    ----------
    scene, sheet, point, normal : as those of ``visible_share``
    active : Bool, the places that are asked for
    """
    start = point + normal * OFF_SURFACE_MM
    way = sheet.apex(mi.Float(0)) - start
    far = dr.norm(way)
    ray = mi.Ray3f(start, way / far, far, 0.0, [])
    return active & (dr.dot(way, normal) > 0) & ~scene.ray_test(ray, active)


# Laser light that surfaces reflect onto each other, without random noise.


# Shares of scattered light in and out of the sheet's light: what differs by less is not told apart.
SHARES_DIFFER = 0.02


@dataclass(frozen=True)
class LitSurfaces:
    """What sheets light where they are placed.

    Attributes
    ----------
    lines : tuple of LitLine, one for each sheet
    field : PatchField, irradiance in mW/mm2 by light of the lines that was reflected once, and by
        what was reflected more often or scattered onto surfaces off the lines; of each sheet, the
        share of its line afar that is seen, that of its light that the water scatters, in the
        sheet's light and in shadow, and that light in shadow in mW/mm2.  None where no surface
        sees another
    beside : tuple of BesideLine, light reflected more often once more, about each line
    """

    lines: tuple[LitLine, ...]
    field: PatchField | None
    beside: tuple[BesideLine, ...] = ()


class Reflections:
    """Irradiance of surfaces by light that other surfaces reflect, of a tank."""

    def __init__(
        self,
        scene: mi.Scene,
        parts: Sequence[MeshPart],
        integrator: SheetIntegrator,
        water: Optics,
        glows: Sequence[Glow] = (),
    ) -> None:
        """Work out what stands still.

        Parameters
        ----------
        scene : mi.Scene, its shapes are the parts
        parts : sequence of MeshPart, matt
        integrator : SheetIntegrator, its sheets
        water : Optics
        glows : sequence of Glow, of each sheet; none where the water scatters nothing
        """
        self._scene, self._integrator, self._glows = scene, integrator, glows
        between = lasting(water)
        self._extinction = opaque(between.extinction_per_mm)
        # On convex bodies no surface sees another, and black ones send nothing on.
        dark = is_convex(parts) or not any(part.albedo for part in parts)
        self._bounces = None if dark else Bounces(scene, parts, between)

    def lit(self) -> LitSurfaces:
        """What the sheets light where they are placed now."""
        bounces, sheets = self._bounces, self._integrator.sheets
        if bounces is None:
            return LitSurfaces((), None)
        lines, seen, shares, inside, glows = [], [], [], [], []
        point, normal = bounces.sender_point, bounces.sender_normal
        patches = bounces.point, bounces.normal
        received_once, extinction = mi.Float(0), self._integrator.extinction
        for number, sheet in enumerate(sheets):
            strip = self._glows[number].of_strip if self._glows else None
            line = lit_line(self._scene, sheet, lambda far: dr.exp(-extinction * far), strip)
            part = visible_part(self._scene, line, *patches)
            close, far = received(line, point, normal, self._extinction, mi.Bool(True))
            received_once += close + far * dr.gather(mi.Float, part, bounces.owner)
            lines.append(line)
            seen.append(part)
            shares.append(visible_share(self._scene, sheet, self._integrator.phase, *patches))
            inside.append(sees_apex(self._scene, sheet, *patches, mi.Bool(True)))
            glow = self._glows[number].irradiance(*patches) if self._glows else mi.Float(0)
            glows.append(shares[-1] * glow)
        dr.eval(received_once, seen, shares, inside, glows)
        once = np.array(received_once)
        seen_there = [dr.gather(mi.Float, share, bounces.owner) for share in shares]
        scattered = self._scattered_onto(point, normal, seen_there)
        values = [bounces.about(once), bounces.of(once + np.array(scattered))]
        for part, share, is_lit, glow in zip(seen, shares, inside, glows, strict=True):
            here = np.array(is_lit)
            values += [np.array(part), *bounces.apart(np.array(share), here)]
            values.append(bounces.apart(np.broadcast_to(np.array(glow), here.shape), here)[1])
        field = bounces.field(values)
        lit = LitSurfaces(tuple(lines), field)

        def sent(si: mi.SurfaceInteraction3f) -> mi.Float:
            loss = dr.select(si.is_valid(), dr.exp(-self._extinction * si.t), 0.0)
            light, shares = self.irradiance(lit, si)
            normal, sends = facing(si), reflectance(si) * loss
            dr.eval(light, shares, normal, sends, si.p)  # apart from the glow, as in a picture
            return (light + self._scattered_onto(si.p, normal, shares)) * sends

        beside = [
            beside_line(self._scene, sheet, line, field, sent)
            for sheet, line in zip(sheets, lines, strict=True)
        ]
        return replace(lit, beside=tuple(beside))

    def _scattered_onto(
        self, point: mi.Point3f, normal: mi.Vector3f, shares: Sequence[mi.Float]
    ) -> mi.Float:
        """mW/mm2 that the water scatters onto surfaces, but for what counts as of the lines.

        shares: of each sheet, the share that no surface hides.
        """
        light = mi.Float(0)
        for glow, share in zip(self._glows, shares, strict=False):
            light += share * glow.off_strip(point, normal)
        return light

    def irradiance(
        self, lit: LitSurfaces, si: mi.SurfaceInteraction3f
    ) -> tuple[mi.Float, list[mi.Float]]:
        """Irradiance in mW/mm2 of places of surfaces, and the share of each sheet's glow there.

        Parameters
        ----------
        lit : LitSurfaces
        si : SurfaceInteraction3f, the places, on the side that is seen
        """
        count = len(self._integrator.sheets)
        if lit.field is None:
            return mi.Float(0), [mi.Float(1)] * count
        once, light, *rest = lit.field.at(si)
        for beside in lit.beside:
            light = beside.at(si.p, facing(si), light)
        shares = []
        for number, (line, sheet) in enumerate(
            zip(lit.lines, self._integrator.sheets, strict=True)
        ):
            seen, bright, dark, dim = rest[4 * number : 4 * number + 4]
            close, far = received(line, si.p, facing(si), self._extinction, once > 0)
            light += close + seen * far
            asked = si.is_valid() & (dr.abs(bright - dark) > SHARES_DIFFER)
            is_lit = sees_apex(self._scene, sheet, si.p, facing(si), asked)
            in_shadow = asked & ~is_lit
            light += dr.select(in_shadow, dim, 0.0)
            shares.append(dr.select(in_shadow, 0.0, bright))
        return dr.select(si.is_valid(), light, 0.0), shares
