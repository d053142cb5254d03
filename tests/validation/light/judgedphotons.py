"""Photons of the laser: scattered and reflected as chance has it, and noted wherever they land."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np

from lscan.records import Floats, Ints
from sim.render.plugins.arrays import floats, indices, long_indices
from sim.render.plugins.sheet import LaserSheet
from sim.render.plugins.water import angle_between
from sim.render.sampled.beams import straight_rays
from sim.render.sampled.integrator import WaterIntegrator

# Where photons land: cells on the triangles of a scene and in the water, and what fell in each.


JOINED = (4, 16, 64)  # cells a side, that may be one
NEARNESS = 12.0  # light that goes as the distance to -1.35 is then off by 0.2 %
# Of a whole cell's area, the least that a cell counts with which a triangle's third side cuts off:
# one photon in next to nothing would be a speck.  Of the area along such a side 5e-4 is affected.
SLIVER = 0.03
# So many planes, those of the largest triangles, are looked at for rectangles: corners lie in one
# to so many mm, and all triangles together have its area to that share.
PLANES, FLAT_MM, SAME_AREA = 16, 3e-4, 1e-3
EMPTY = 2**64 - 1  # the key of a record that was never written: behind all others
VOXEL_BITS = 20  # a coordinate's, of a key


class SurfaceCells:
    """The triangles of a scene's meshes, cut into parallelograms along two of their sides.

    Triangles that tile a rectangle are cut as one: those about the marks of a board may be
    thousands of times narrower than a cell, and one photon in such a one would be a speck.

    Light that was scattered or reflected varies on the scale of the distance from the sheets, so
    cells may grow with it: fours by four are joined where they still are NEARNESS times smaller
    than that.
    """

    def __init__(self, scene: mi.Scene, sheets: Sequence[LaserSheet], cell_mm: float) -> None:
        """Cut all shapes, which have to be meshes, into cells of ``cell_mm`` and more a side."""
        self._sheets, self._shapes, self._cell_mm = sheets, scene.shapes(), cell_mm
        meshes = [_triangles(shape) for shape in self._shapes]
        self._first = np.cumsum([0, *(len(mesh) for mesh in meshes)])
        triangles = np.concatenate(meshes)
        rectangles, patch = _rectangles(triangles)
        corners = np.concatenate([triangles, rectangles])
        self._patch = indices(patch)
        self._triangular = floats(np.arange(len(corners)) < len(triangles))
        start, sides = corners[:, 0], corners[:, 1:] - corners[:, :1]
        counts = np.maximum(np.ceil(np.linalg.norm(sides, axis=2) / cell_mm), 1)
        normal = np.cross(sides[:, 0], sides[:, 1])
        whole = np.linalg.norm(normal, axis=1)
        unit = normal / np.maximum(whole, 1e-30)[:, None] ** 2
        begins = np.cumsum([0, *counts.prod(axis=1)])[:-1]
        self._start, self._sides = floats(start), [floats(sides[:, k]) for k in (0, 1)]
        duals = np.cross(sides[:, 1], unit), np.cross(unit, sides[:, 0])
        self._duals = [floats(dual) for dual in duals]
        self._counts = [floats(counts[:, k]) for k in (0, 1)]
        self._begins, self._whole = long_indices(begins), floats(whole)

    def find(
        self, si: mi.SurfaceInteraction3f, towards: mi.Vector3f, active: mi.Bool
    ) -> tuple[mi.UInt64, mi.Float]:
        """Key of the cell at ``si``, on the side that ``towards`` points to, and its area, mm2."""
        patch = dr.gather(mi.UInt32, self._patch, self._triangle(si), active)

        def of(kind: Any, values: mi.Float) -> Any:
            return dr.gather(kind, values, patch, active)

        start, sides = of(mi.Point3f, self._start), [of(mi.Vector3f, v) for v in self._sides]
        offset, counts = si.p - start, [of(mi.Float, count) for count in self._counts]
        duals = [of(mi.Vector3f, dual) for dual in self._duals]
        place = [dr.clip(dr.dot(offset, dual), 0, 1) for dual in duals]
        is_triangle = of(mi.Float, self._triangular)
        joined, level = mi.Float(1), mi.UInt64(0)
        for number, many in enumerate(JOINED, start=1):
            blocks = [_block(p, n, many) for p, n in zip(place, counts, strict=True)]
            middle = [0.5 * (begin + dr.minimum(end, 1)) for begin, end in blocks]
            within = dr.maximum(is_triangle * (middle[0] + middle[1]), 1)
            centre = start + (sides[0] * middle[0] + sides[1] * middle[1]) / within
            far = self._distance(centre) > many * NEARNESS * self._cell_mm
            joined, level = dr.select(far, many, joined), dr.select(far, number, level)
        (u, u_end), (v, v_end) = (_block(p, n, joined) for p, n in zip(place, counts, strict=True))
        n, m = counts
        index = mi.UInt64(dr.round(u * n)) * mi.UInt64(m) + mi.UInt64(dr.round(v * m))
        key = of(mi.UInt64, self._begins) + index
        outside = dr.dot(dr.cross(*sides), towards) > 0
        side = dr.select(outside, mi.UInt64(1), mi.UInt64(0))
        inside = (dr.minimum(u_end, 1) - u) * (dr.minimum(v_end, 1) - v)
        cut = dr.maximum(_cut_off(u, u_end, v, v_end), SLIVER * inside)
        share = dr.select(is_triangle > 0, cut, inside)
        return 8 * key + 2 * level + side, of(mi.Float, self._whole) * share

    def _triangle(self, si: mi.SurfaceInteraction3f) -> mi.UInt32:
        """The number of the triangle among all shapes'."""
        triangle = mi.UInt32(si.prim_index)
        for shape, first in zip(self._shapes, self._first[:-1].tolist(), strict=True):
            triangle += dr.select(si.shape == mi.ShapePtr(shape), mi.UInt32(first), 0)
        return triangle

    def _distance(self, point: mi.Point3f) -> mi.Float:
        """From the nearest of the sheets, mm."""
        distance = mi.Float(dr.inf)
        for sheet in self._sheets:
            distance = dr.minimum(distance, dr.abs(sheet.coordinates(point, mi.Float(0))[2]))
        return distance


def _rectangles(triangles: Floats) -> tuple[Floats, Ints]:
    """(R, 3, 3) corners of rectangles that triangles tile, and of each triangle its patch.

    Patches are the triangles, then the rectangles.
    """
    sides = triangles[:, 1:] - triangles[:, :1]
    normal = np.cross(sides[:, 0], sides[:, 1])
    area, patch = np.linalg.norm(normal, axis=1) / 2, np.arange(len(triangles))
    left = area.copy()
    found: list[Floats] = []
    for _ in range(PLANES):
        largest = int(np.argmax(left))
        if left[largest] <= 0:
            break
        along = sides[largest, 0] / np.linalg.norm(sides[largest, 0])
        upright = normal[largest] / np.linalg.norm(normal[largest])
        frame = np.stack([along, np.cross(upright, along), upright])
        offset = triangles - triangles[largest, 0]
        here = (left > 0) & np.all(np.abs(offset @ upright) < FLAT_MM, axis=1)
        left[here] = 0
        flat = (offset[here] @ frame[:2].T).reshape(-1, 2)
        box = cv2.boxPoints(cv2.minAreaRect(flat.astype(np.float32))).astype(float)
        first, second = box[1] - box[0], box[3] - box[0]
        whole = np.linalg.norm(first) * np.linalg.norm(second)
        if here.sum() > 1 and abs(area[here].sum() - whole) < SAME_AREA * whole:
            patch[here] = len(triangles) + len(found)
            if first[0] * second[1] < first[1] * second[0]:  # on the side that triangles face
                box = box[[0, 3, 2, 1]]
            found.append(triangles[largest, 0] + box[[0, 1, 3]] @ frame[:2])
    return np.reshape(found, (-1, 3, 3)), patch


def _block(place: mi.Float, count: mi.Float, joined: mi.Float | int) -> tuple[mi.Float, mi.Float]:
    """Where the joined cells about a place begin and end, 0 to 1 along a side."""
    number = dr.minimum(dr.floor(place * count / joined), dr.ceil(count / joined) - 1)
    return number * joined / count, (number + 1) * joined / count


def _cut_off(u: mi.Float, u_end: mi.Float, v: mi.Float, v_end: mi.Float) -> mi.Float:
    """Area of a rectangle within the triangle u + v < 1."""
    inside = (u_end - u) * (v_end - v)

    def beyond(a: mi.Float, b: mi.Float) -> mi.Float:
        return 0.5 * dr.square(dr.maximum(1 - a - b, 0))

    cut = beyond(u, v) - beyond(u_end, v) - beyond(u, v_end) + beyond(u_end, v_end)
    return dr.select(u_end + v_end <= 1, inside, cut)


def voxel_key(point: mi.Point3f, voxel_mm: float) -> mi.UInt64:
    """The key of the cube of the water that holds a point, to half a million cubes each way."""
    half = 1 << (VOXEL_BITS - 1)
    key = mi.UInt64(0)
    for coordinate in (point.x, point.y, point.z):
        place = dr.floor(dr.clip(coordinate / voxel_mm, -half, half - 1))
        key = (key << VOXEL_BITS) + mi.UInt64(mi.Int32(place) + half)
    return key


@dataclass(frozen=True)
class DrawnRecord:
    """One record of a cell, each as likely; count: how many there are.

    towards: where its light came from, a unit vector.  power: mW.  mark: as it was written.
    """

    count: mi.UInt32
    towards: mi.Vector3f
    power: mi.Float
    mark: mi.Float


class CellRecords:
    """Photons, written as they fall, then sorted by their cell and drawn from it."""

    def __init__(self, capacity: int) -> None:
        """Make room for so many."""
        self.capacity = capacity
        self._used = dr.zeros(mi.UInt32, 1)
        self._keys = dr.full(mi.UInt64, EMPTY, capacity)
        self._values = dr.zeros(mi.Float, 5 * capacity)
        dr.make_opaque(self._used, self._keys, self._values)

    def write(
        self,
        key: mi.UInt64,
        towards: mi.Vector3f,
        power: mi.Float,
        mark: mi.Float,
        active: mi.Bool,
    ) -> None:
        """In a loop, add a record for each active lane, as long as there is room."""
        slot = dr.scatter_inc(self._used, mi.UInt32(0), active)
        held = active & (slot < self.capacity)
        dr.scatter(self._keys, key, slot, held)
        for k, value in enumerate((*towards, power, mark)):
            dr.scatter(self._values, value, 5 * slot + k, held)

    def sort(self) -> bool:
        """Put the records in the order of their keys; whether all have found room."""
        order = np.argsort(np.array(self._keys), kind="stable")
        self._keys = long_indices(np.array(self._keys)[order])
        self._values = floats(np.array(self._values).reshape(-1, 5)[order])
        return int(self._used[0]) <= self.capacity

    def powers(self) -> Floats:
        """(capacity,) mW of each record, 0 of those not written."""
        return np.array(self._values, dtype=float)[3::5]

    def draw(self, key: mi.UInt64, sample: mi.Float, active: mi.Bool) -> DrawnRecord:
        """A record of the cell of that key."""
        first, behind = self._before(key), self._before(key + 1)
        count = dr.select(active, behind - first, 0)
        index = first + dr.minimum(mi.UInt32(sample * mi.Float(count)), dr.maximum(count, 1) - 1)
        found = active & (count > 0)
        x, y, z, power, mark = (
            dr.gather(mi.Float, self._values, 5 * index + k, found) for k in range(5)
        )
        return DrawnRecord(count, mi.Vector3f(x, y, z), power, mark)

    def _before(self, key: mi.UInt64) -> mi.UInt32:
        """How many records have smaller keys."""
        return dr.binary_search(
            0, self.capacity, lambda index: dr.gather(mi.UInt64, self._keys, index) < key
        )


def _triangles(shape: mi.Shape) -> Floats:
    """(T, 3, 3) corners of a mesh."""
    parts = mi.traverse(shape)
    vertices = np.array(parts["vertex_positions"], dtype=float).reshape(-1, 3)
    return np.asarray(vertices[np.array(parts["faces"]).reshape(-1, 3)])


# Photons of the laser: scattered and reflected as chance has it, and noted wherever they land.


FAINT = 0.05  # of a path's first weight: below, some are ended and the others keep as much
LONGEST_PATH = 1024
METRE_MM = 1000.0
# Cells in which scattered walks end are so many times as wide: what these blur is blurred anyway.
WIDER = 4.0
REFLECTED = -1.0  # the mark of light that has been reflected


class Waters:
    """What photons and walks go through, and the cells they meet in."""

    def __init__(
        self, scene: mi.Scene, water: WaterIntegrator, cell_mm: float, voxel_mm: float
    ) -> None:
        """Take surfaces and water as they are, with cells of so many mm a side."""
        self.scene, self.water, self.voxel_mm = scene, water, voxel_mm
        self.surfaces = SurfaceCells(scene, water.sheets, cell_mm)
        self.wide = SurfaceCells(scene, water.sheets, WIDER * cell_mm)
        self.absorption = water.extinction - water.scattering
        # So that no more than about one a photon is noted in the water.
        self.noted = dr.minimum(1, 1 / (METRE_MM * dr.maximum(water.scattering, 1e-20)))

    def chance_within(self, length: mi.Float) -> mi.Float:
        """That light is scattered within so many mm, which may be infinite."""
        if not self.water.has_water:
            return mi.Float(0)
        return 1 - dr.exp(-self.water.scattering * length)

    def free_path(self, sample: mi.Float) -> mi.Float:
        """How far light goes before it is scattered, mm."""
        if not self.water.has_water:
            return mi.Float(dr.inf)
        return -dr.log(1 - sample) / self.water.scattering

    def kept(self, length: mi.Float) -> mi.Float:
        """Share that absorption leaves after so many mm, none of it after infinitely many."""
        return dr.select(dr.isfinite(length), dr.exp(-self.absorption * length), 0.0)


class PhotonRecords:
    """Where photons of scattered or reflected light were.

    landed, wide: on surfaces, each time, in small cells and in wide ones; its mark is 0, or
    REFLECTED after a reflection.
    met: where water scatters what it has scattered before and nothing reflected; the mark is the
    largest angle it has been turned by so far.
    """

    def __init__(self, capacity: int) -> None:
        """Make room for so many of each kind."""
        self.landed, self.wide, self.met = (CellRecords(capacity) for _ in range(3))

    def sort(self) -> bool:
        """Sort them; whether all records have found room."""
        return all(records.sort() for records in (self.landed, self.wide, self.met))


@dataclass
class Photon:
    """Where a photon starts its second flight.

    weight: of its power.  turned: by how much the water has scattered it.
    """

    ray: mi.Ray3f
    weight: mi.Float
    turned: mi.Float
    reflected: mi.Bool
    active: mi.Bool


def shoot(waters: Waters, sheet: LaserSheet, count: int, seed: int, records: PhotonRecords) -> None:
    """Send so many photons of a sheet on their way and note where they land, in mW."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, count)
    unit = sheet.power / count
    weight = _follow(waters, _first_flight(waters, sheet, sampler), sampler, unit, records)
    dr.eval(weight)


def _first_flight(waters: Waters, sheet: LaserSheet, sampler: mi.Sampler) -> Photon:
    """Photons of the sheet after the water scattered or a surface reflected them once.

    Where little is scattered, half of them are, at a smaller weight.
    """
    scene, time = waters.scene, mi.Float(0)
    phi = (2 * sampler.next_1d() - 1) * sheet.half_angle
    power = sheet.power_density(phi) * 2 * sheet.half_angle / sheet.power
    lateral = mi.warp.square_to_std_normal(sampler.next_2d()).x
    straight = straight_rays(scene, sheet, phi, time, mi.Bool(True))
    origin, along = straight.line(lateral)
    stretch = dr.rcp(dr.norm(along))
    si = scene.ray_intersect(mi.Ray3f(origin, along * stretch, time, []))
    hit = si.is_valid()
    chance = waters.chance_within(si.t)
    odds = dr.select(hit & (chance > 0), dr.maximum(chance, 0.5), chance)
    in_water = sampler.next_1d() < odds

    free = waters.free_path(chance * sampler.next_1d())
    rho = dr.select(in_water, free * stretch, 1.0)
    aside = lateral * 0.5 * sheet.half_width(rho)
    place = straight.apex + straight.middle * rho + sheet.normal * aside
    incoming, _ = sheet.ray_through(phi, rho, aside, time)
    onward = waters.water.phase.sample_direction(incoming, sampler.next_2d())
    out, worth = bounce(si, sampler, ~in_water & hit)
    spawned = si.spawn_ray(out)

    scattered = chance / odds * waters.kept(free)
    reflected = worth * (1 - chance) / (1 - odds) * waters.kept(si.t)
    return Photon(
        ray=mi.Ray3f(
            dr.select(in_water, place, spawned.o), dr.select(in_water, onward, out), time, []
        ),
        weight=power * dr.select(in_water, scattered, reflected),
        turned=angle_between(incoming, onward),
        reflected=~in_water,
        active=in_water | hit,
    )


@dr.syntax
def _follow(
    waters: Waters, photon: Photon, sampler: mi.Sampler, unit: mi.Float, records: PhotonRecords
) -> mi.Float:
    """Photons to the end of their paths; their last weights."""
    ray, weight, turned = mi.Ray3f(photon.ray), mi.Float(photon.weight), mi.Float(photon.turned)
    reflected, active = mi.Bool(photon.reflected), mi.Bool(photon.active)
    step = mi.UInt32(0)
    while active:
        si = waters.scene.ray_intersect(ray, active)
        free = waters.free_path(sampler.next_1d(active))
        in_water = active & (free < si.t)
        on_surface = active & ~in_water & si.is_valid()
        weight *= waters.kept(dr.select(in_water, free, si.t))
        point, back = ray(free), -ray.d
        noted = in_water & ~reflected & (sampler.next_1d(active) < waters.noted)
        key = voxel_key(point, waters.voxel_mm)
        records.met.write(key, back, weight * unit / waters.noted, turned, noted)
        mark = dr.select(reflected, REFLECTED, 0.0)
        for cells, landed in ((waters.surfaces, records.landed), (waters.wide, records.wide)):
            key, _ = cells.find(si, back, on_surface)
            landed.write(key, back, weight * unit, mark, on_surface)

        onward = waters.water.phase.sample_direction(ray.d, sampler.next_2d(active))
        turned = dr.maximum(turned, angle_between(ray.d, onward))
        out, worth = bounce(si, sampler, on_surface)
        weight *= dr.select(on_surface, worth, 1.0)
        reflected |= on_surface
        spawned = si.spawn_ray(out)
        ray.o = dr.select(in_water, point, spawned.o)
        ray.d = dr.select(in_water, onward, out)
        active = in_water | on_surface
        weight = spared(weight, sampler.next_1d(active))
        active &= (weight > 0) & (step < LONGEST_PATH)
        step += 1
    return weight


def bounce(
    si: mi.SurfaceInteraction3f, sampler: mi.Sampler, active: mi.Bool
) -> tuple[mi.Vector3f, mi.Float]:
    """Where a surface sends a photon, and by how much its weight changes.

    With shading normals light is reflected as the camera asks, whose BSDF counts the laser's
    shading cosine: power goes by the true ones (Veach 1997, sec. 5.3.2).
    """
    context = mi.BSDFContext(mi.TransportMode.Importance)
    bs, value = si.bsdf().sample(
        context, si, sampler.next_1d(active), sampler.next_2d(active), active
    )
    out = si.to_world(bs.wo)
    shaded = mi.Frame3f.cos_theta(si.wi) * dr.dot(si.n, out)
    true = mi.Frame3f.cos_theta(bs.wo) * dr.dot(si.n, si.to_world(si.wi))
    worth = value.x * dr.abs(shaded / true)
    return out, dr.select(active & (true != 0) & (value.x > 0), worth, 0.0)


def spared(weight: mi.Float, sample: mi.Float) -> mi.Float:
    """A path's weight after Russian roulette: never below FAINT but for 0."""
    survival = dr.minimum(weight / FAINT, 1)
    return dr.select(sample < survival, dr.maximum(weight, FAINT), 0.0)
