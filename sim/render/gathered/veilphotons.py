"""Photons of a sheet in endless water, counted where the camera sees them.

At every place that scatters a photon, light goes on to the camera on a walk of its own.  Each path
counts where it turns most, as the judge's do in ``tests/validation/light``: the photon's turns
before and the walk's after are smaller than that of the place, whose phase function is then never
at its peak.
Some paths are kept, the more light they bring the more likely, for surfaces to be held against.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import pi

import drjit as dr
import mitsuba as mi
import numpy as np

from lscan.records import Floats
from sim.render.plugins.arrays import floats, opaque, opaque_vector
from sim.render.plugins.sheet import LaserSheet
from sim.render.plugins.water import PhaseTable, angle_between
from sim.render.sampled.integrator import crossing_of
from sim.water import Optics

# Walks of light through water from the camera to a given place.
#
# A walk starts along an axis of its own and is scattered by chance.  Where it crosses the sphere
# about its start whose radius is the place's distance, it is turned about its start so that it ends
# at the place.  The radiance that arrives along the first leg of such walks, of a source of the
# radiant intensity I at the place, is then the mean of I / (distance2 cos), cos being that between
# the last leg and the sphere's normal: an element of volume is distance2 dOmega times cos of the
# element of the last leg.


# A cosine counts as no less: the light of 1e-3 of evenly distributed directions is lessened.
GRAZING = 0.02
MOST_TURNS = 64
# Of the walks that leave the sphere so many go on, for light that comes back, to so many radii.
RETURNING, FARTHEST = 0.25, 2.0


@dataclass(frozen=True)
class AimedWalk:
    """Walks to places, each turned about the line to its place by a random azimuth.

    towards: direction to the place, in the world.  end, arriving: where the walk along z ended and
    the direction of its last leg.  most: largest turn, rad.  worth: radiance per radiant intensity
    at the place, 1/mm2.  azimuth: rad.  first: mm to the first turn, or to the place.
    Directions are unit vectors.
    """

    towards: mi.Vector3f
    end: mi.Vector3f
    arriving: mi.Vector3f
    most: mi.Float
    worth: mi.Float
    azimuth: mi.Float
    first: mi.Float

    def turned(self, azimuth: float) -> tuple[mi.Vector3f, mi.Vector3f]:
        """First and last direction in the world, both away from the camera.

        azimuth: rad, by which the walk is turned further.
        """
        end, towards = self.end, self.towards
        sine = dr.hypot(end.x, end.y)  # not 1 - z2, which is lost to rounding where it is small
        beside = dr.select(sine > 0, mi.Vector3f(-end.x, -end.y, 0) / sine, mi.Vector3f(1, 0, 0))
        beside = mi.Vector3f(beside.x * end.z, beside.y * end.z, sine)
        own = mi.Frame3f(beside, dr.cross(end, beside), end)
        s, c = dr.sincos(self.azimuth + azimuth)
        frame = mi.Frame3f(towards)
        aside = frame.s * c + frame.t * s
        world = mi.Frame3f(aside, dr.cross(towards, aside), towards)
        last = world.to_world(own.to_local(self.arriving))
        return dr.normalize(towards * end.z + aside * sine), dr.normalize(last)


@dr.syntax
def aimed_walk(
    random: mi.PCG32,
    phase: PhaseTable,
    coefficients: tuple[mi.Float, mi.Float],
    start: mi.Float,
    offset: mi.Vector3f,
    scattered: mi.Bool,
    active: mi.Bool,
) -> tuple[AimedWalk, mi.PCG32]:
    """One walk to each of the places, and the random numbers as they are left.

    coefficients: absorption and scattering, 1/mm.  start: mm from the camera's pinhole at which
    the water begins.  offset: of the places from the pinhole, mm.  scattered: whether the walk has
    to be scattered at all.
    """
    absorption, scattering = coefficients
    distance = dr.norm(offset)
    within = FARTHEST * distance - start
    chance = dr.select(scattered, 1 - dr.exp(-scattering * within), 1.0)
    free = start - dr.log(1 - random.next_float32() * chance) / scattering
    place, way = mi.Vector3f(0), mi.Vector3f(0, 0, 1)
    first = mi.Float(free)
    length, most, kept = -start, mi.Float(0), mi.Float(chance)
    end, arriving, turned = mi.Vector3f(0, 0, 1), mi.Vector3f(0, 0, 1), mi.Float(0)
    worth, step, outside = mi.Float(0), mi.UInt32(0), mi.Bool(False)
    walking = active & (distance > start)
    while walking:
        along = dr.dot(place, way)
        inner = dr.square(along) + dr.square(distance) - dr.squared_norm(place)
        root = dr.safe_sqrt(inner)
        for path in (-along - root, -along + root):
            there = (place + way * path) / distance
            facing = dr.maximum(dr.abs(dr.dot(way, there)), GRAZING)
            more = kept * dr.exp(-absorption * (length + path)) / facing
            counts = (inner > 0) & (path > 0) & (path <= free) & ((step > 0) | ~scattered)
            more = dr.select(counts, more, 0.0)
            worth += more
            chosen = random.next_float32() * worth < more
            end, arriving = dr.select(chosen, there, end), dr.select(chosen, way, arriving)
            turned = dr.select(chosen, most, turned)
        place, length = mi.Vector3f(place + way * free), mi.Float(length + free)
        sample = mi.Point2f(random.next_float32(), random.next_float32())
        onward = phase.sample_direction(way, sample)
        most, way = dr.maximum(most, angle_between(way, onward)), mi.Vector3f(onward)
        free = -dr.log(1 - random.next_float32()) / scattering
        far = dr.norm(place) / distance
        leaves = (far > 1) & ~outside
        outside |= leaves
        walking &= (far < FARTHEST) & (step < MOST_TURNS)
        walking &= ~leaves | (random.next_float32() < RETURNING)
        kept = dr.select(leaves, kept / RETURNING, kept)
        step += 1
    azimuth = 2 * pi * random.next_float32()
    worth /= dr.square(distance)
    first = dr.select(turned > 0, first, distance)
    return AimedWalk(offset / distance, end, arriving, turned, worth, azimuth, first), random


# Photons of a sheet in endless water, counted where the camera sees them.


COLUMNS, ROWS = 32, 24  # cells of the camera's field of view
# Edges between a ray's cells, mm of depth behind its crossing of the sheet.  Light of the second
# order falls off steeply beside the sheet.
BESIDE = np.geomspace(0.75, 800.0, 11)
DEPTHS = np.concatenate([-BESIDE[::-1], BESIDE])
# Few photons add much where their paths turn several times, by no more than this of the whole
# angle from the laser to the camera at a time: they are counted by themselves.
MUCH = 0.5
BATCH = 2**18
FIRST = 2**14  # photons that say how much light there is
FARTHEST_MM = 3000.0
# Light scattered within so many mm of the port counts as much as that in the next ones, for
# 1 / distance2 would make single photons weigh much.
NEAR_MM = 40.0
# Walks start at one of so many scatterings that there is one about every so many mm.
WALKS_APART_MM = 1000.0
TURNED = 4  # azimuths by which each walk is turned
TOGETHER = 8  # photons beside each other, whose walks start at the same scattering
# Angles and depths of the first scattering lie evenly, the fractions of 1/p and 1/p2 of 2**32 from
# one photon to the next, p3 = p + 1 (M. Roberts, The Unreasonable Effectiveness of Quasirandom
# Sequences, 2018).
EVEN_STEPS = (3242174889, 2447445414)
# A photon whose weight times what is kept from there to the camera is below FAINT goes on with
# the odds of their ratio, or the least odds.
FAINT, LEAST_ODDS = 1.0, 0.1
KEPT = 2**16  # paths, about, and of each azimuth there is room for twice as many
ROOM = 2 * KEPT // TURNED
PLACES = 4  # of a kept path, beside its share and its depth


@dataclass(frozen=True)
class FieldOfView:
    """What the camera sees, as a pinhole in the water; the head's frame.

    Attributes
    ----------
    pinhole_mm : (3,) array, where its rays meet
    axes : (3, 3) array, rows: unit vectors to the right, down and ahead
    low, high : (2,) arrays, tangents to the right and down at the edges of the cells
    start_mm : float, mm from the pinhole at which the water begins
    """

    pinhole_mm: Floats
    axes: Floats
    low: Floats
    high: Floats
    start_mm: float

    def tangents(self, offset_mm: Floats) -> tuple[Floats, Floats]:
        """Tangents to the right and down of places; shapes (N,).

        Parameters
        ----------
        offset_mm : (N, 3) array, mm, from the pinhole
        """
        right, down, ahead = self.axes @ offset_mm.T
        return right / ahead, down / ahead


@dataclass(frozen=True)
class VeilCounts:
    """Light of order two and more, of a sheet of 1 mW.

    Attributes
    ----------
    light, squared : (2, len(DEPTHS) + 1, ROWS, COLUMNS) arrays, mean radiance in each cell, in
        mW/(mm2 sr) in the water, and the sum of squares of what the photons added to it: of
        paths that turn by less than MUCH of the whole angle at any place, then of the others
    paths : (N, 2 + 3 PLACES) array, of some paths: their share of the light, the depth of their
        deepest place, mm, and places, head frame, mm: where they were scattered first, before the
        place where they turn most, there, and last
    """

    light: Floats
    squared: Floats
    paths: Floats


def veil_counts(
    sheet: LaserSheet,
    water: Optics,
    view: FieldOfView,
    level: Floats,
    photons: int,
    seed: int,
    progress: Callable[[int, int], None],
) -> VeilCounts:
    """Photons of a sheet that stands in the head's frame, counted.

    Parameters
    ----------
    sheet : LaserSheet
    water : Optics
    view : FieldOfView
    level : (3,) array, the unit vector along which depth is measured
    photons : int, how many at least; they are sent in whole batches
    seed : int, of the random numbers
    progress : function of (done, all)
    """
    batches = -(-photons // BATCH)
    tracer = _Tracer(sheet, water, view, level)
    tracer.send(0, dr.opaque(mi.UInt64, seed * batches), FIRST)
    tracer.begin_to_keep(KEPT / batches)
    for number in range(batches):
        tracer.send(number, dr.opaque(mi.UInt64, seed * batches + number), BATCH)
        dr.sync_thread()
        progress(number + 1, batches)
    light, squared = np.array(tracer.sums).reshape(2, 2, len(DEPTHS) + 1, ROWS, COLUMNS)
    return VeilCounts(light / batches, squared / batches**2, tracer.kept_paths())


class _Tracer:
    """The sheet, the water and the cells, and what is counted."""

    def __init__(self, sheet: LaserSheet, water: Optics, view: FieldOfView, level: Floats) -> None:
        self.sheet, self.phase = sheet, PhaseTable(water.phase)
        self.scattering = opaque(water.scattering_per_mm)
        self.absorption = opaque(water.absorption_per_mm)
        self.pinhole, self.level = mi.Point3f(opaque_vector(view.pinhole_mm)), opaque_vector(level)
        self.right, self.down, self.ahead = (opaque_vector(axis) for axis in view.axes)
        self.low = [opaque(tangent) for tangent in view.low]
        self.scale = [
            opaque(count / span)
            for count, span in zip((COLUMNS, ROWS), view.high - view.low, strict=True)
        ]
        self.start = opaque(view.start_mm)
        self.depths = floats(DEPTHS)
        self.every = dr.opaque(mi.UInt32, max(1, round(WALKS_APART_MM * water.scattering_per_mm)))
        whole = angle_between(sheet.axis, -self.ahead)
        self.much = MUCH * whole
        self.cells = (len(DEPTHS) + 1) * ROWS * COLUMNS
        self.sums = dr.zeros(mi.Float64, 4 * self.cells)
        # Of the light that a path adds: the number of times that it is kept.
        self.share = dr.opaque(mi.Float, 0)
        self.used = [dr.zeros(mi.UInt32, 1) for _ in range(TURNED)]
        self.paths = [dr.zeros(mi.Float, (2 + 3 * PLACES) * ROOM) for _ in range(TURNED)]
        dr.make_opaque(self.used, self.paths)

    def begin_to_keep(self, paths: float) -> None:
        """Forget what was counted, and keep so many paths of light as much as that."""
        light = np.array(self.sums)[: 2 * self.cells].sum()
        self.share = opaque(float(paths / light) if light > 0 else 0.0)
        self.sums = dr.zeros(mi.Float64, 4 * self.cells)

    def kept_paths(self) -> Floats:
        """The paths that were kept."""
        each = [
            np.array(paths).reshape(ROOM, -1)[: int(used[0])]
            for paths, used in zip(self.paths, self.used, strict=True)
        ]
        return np.concatenate(each)

    def send(self, batch: int, seed: mi.UInt64, photons: int) -> None:
        """Send one batch of so many photons; their light is that of the whole sheet."""
        self.each = opaque(1 / photons)
        self._send(batch, mi.PCG32(size=photons, initstate=seed))
        dr.eval(self.sums, self.used, self.paths)

    @dr.syntax
    def _send(self, batch: int, random: mi.PCG32) -> None:
        """Send a photon for each stream of random numbers."""
        sheet, time = self.sheet, mi.Float(0)
        even = [_evenly(random, step) for step in EVEN_STEPS]
        phi = (2 * even[0] - 1) * sheet.half_angle
        sample = mi.Point2f(random.next_float32(), random.next_float32())
        chance = 1 - dr.exp(-self.scattering * FARTHEST_MM)
        rho = -dr.log(1 - chance * even[1]) / self.scattering
        aside = mi.warp.square_to_std_normal(sample).x * 0.5 * sheet.half_width(rho)
        place = mi.Point3f(sheet.apex(time) + sheet.direction(phi) * rho + sheet.normal * aside)
        towards = mi.Vector3f(sheet.ray_through(phi, rho, aside, time)[0])
        weight = sheet.power_density(phi) / sheet.power * 2 * sheet.half_angle * chance
        weight = mi.Float(weight * dr.exp(-self.absorption * rho))
        deepest = dr.dot(place - self.pinhole, self.level)
        first_place, before = mi.Point3f(place), mi.Point3f(place)
        turned, order = mi.Float(0), mi.UInt32(0)
        count = dr.width(phi)
        packet = dr.arange(mi.UInt32, count) // TOGETHER
        first = (packet + dr.opaque(mi.UInt32, batch)) % self.every
        active = dr.full(mi.Bool, True, count)
        while active:
            walks = active & (order % self.every == first)
            places = first_place, before, place
            random = self._count(
                random, places, towards, weight, deepest, turned, order == 0, walks
            )
            sample = mi.Point2f(random.next_float32(), random.next_float32())
            onward = self.phase.sample_direction(towards, sample)
            turned, towards = dr.maximum(turned, angle_between(towards, onward)), onward
            # In thin water, too, all photons are scattered twice.
            forced = dr.select(order == 0, chance, 1.0)
            free = -dr.log(1 - forced * random.next_float32()) / self.scattering
            before = mi.Point3f(place)
            place = mi.Point3f(place + towards * free)
            deepest = dr.maximum(deepest, dr.dot(place - self.pinhole, self.level))
            weight *= forced * dr.exp(-self.absorption * free)
            back = dr.norm(place - self.pinhole)
            worth = weight * dr.exp(-self.absorption * back)
            odds = dr.select(order == 0, 1.0, dr.clip(worth / FAINT, LEAST_ODDS, 1))
            active &= (back < FARTHEST_MM) & (random.next_float32() < odds)
            weight /= odds
            order += 1

    def _count(
        self,
        random: mi.PCG32,
        places: tuple[mi.Point3f, mi.Point3f, mi.Point3f],
        towards: mi.Vector3f,
        weight: mi.Float,
        deepest: mi.Float,
        turned: mi.Float,
        first: mi.Bool,
        active: mi.Bool,
    ) -> mi.PCG32:
        """Count light that is scattered at the last of some places and goes on to the camera.

        first: not scattered before, so that it has to be scattered on its way to the camera.
        """
        offset = places[-1] - self.pinhole
        distance = dr.norm(offset)
        active &= distance > self.start + NEAR_MM
        coefficients = self.absorption, self.scattering
        walk, random = aimed_walk(
            random, self.phase, coefficients, self.start, offset, first, active
        )
        weight = weight * walk.worth * mi.Float(self.every) * self.each / TURNED
        weight *= dr.select(distance < self.start + 2 * NEAR_MM, mi.Float(2), 1)
        active &= walk.worth > 0
        for number in range(TURNED):
            seen, arriving = walk.turned(2 * pi * number / TURNED)
            angle = angle_between(towards, -arriving)
            counts = active & (angle > turned) & (angle > walk.most)
            depth = dr.maximum(deepest, walk.first * dr.dot(seen, self.level))
            light = weight * self.phase.value(angle)
            light, counts = self._add(seen, angle, light, depth, counts)
            path = [*places, self.pinhole + walk.first * seen]
            self._keep(number, random.next_float32(), light, depth, path, counts)
        return random

    def _add(
        self, seen: mi.Vector3f, angle: mi.Float, light: mi.Float, depth: mi.Float, active: mi.Bool
    ) -> tuple[mi.Float, mi.Bool]:
        """Add light to the cell in which it is seen; what was added, and where there is a cell."""
        ahead = dr.dot(seen, self.ahead)
        sides = dr.dot(seen, self.right), dr.dot(seen, self.down)
        column, row = (
            dr.floor((side / ahead - low) * scale)
            for side, low, scale in zip(sides, self.low, self.scale, strict=True)
        )
        active &= (column >= 0) & (column < COLUMNS) & (row >= 0) & (row < ROWS) & (ahead > 0)
        crossing = crossing_within(self.sheet, mi.Ray3f(self.pinhole, seen))
        behind = depth - crossing * dr.dot(seen, self.level)
        layer = dr.binary_search(
            0, len(DEPTHS), lambda index: dr.gather(mi.Float, self.depths, index) <= behind
        )
        much = dr.select(angle > self.much, mi.UInt32(1), 0)
        cell = (layer * ROWS + mi.UInt32(row)) * COLUMNS + mi.UInt32(column)
        light = light * self.scale[0] * self.scale[1] / (ahead * dr.square(ahead))
        for kind, value in enumerate((light, dr.square(light))):
            index = (2 * kind + much) * self.cells + cell
            dr.scatter_reduce(dr.ReduceOp.Add, self.sums, mi.Float64(value), index, active)
        return light, active

    def _keep(
        self,
        number: int,
        sample: mi.Float,
        light: mi.Float,
        depth: mi.Float,
        places: list[mi.Point3f],
        active: mi.Bool,
    ) -> None:
        """Keep a path of that number of azimuth with odds that go as its light."""
        times = light * self.share
        slot = dr.scatter_inc(self.used[number], mi.UInt32(0), active & (sample < times))
        kept = active & (sample < times) & (slot < ROOM)
        values = dr.maximum(times, 1), depth, *(part for place in places for part in place)
        for k, value in enumerate(values):
            dr.scatter(self.paths[number], value, len(values) * slot + k, kept)


def _evenly(random: mi.PCG32, step: int) -> mi.Float:
    """Numbers from 0 to 1, each by the same step from the one before, which is drawn first."""
    drawn = random.next_uint32()
    count = dr.width(drawn)
    first = dr.gather(mi.UInt32, drawn, dr.zeros(mi.UInt32, count))
    number = first + mi.UInt32(step) * dr.arange(mi.UInt32, count)
    return mi.Float(number >> 8) * 2**-24


def crossing_within(sheet: LaserSheet, ray: mi.Ray3f) -> mi.Float:
    """Where rays cross the sheet, mm along them; FARTHEST_MM where they do not, or farther."""
    crossing, _ = crossing_of(sheet, ray)
    return dr.select((crossing > 0) & (crossing < FARTHEST_MM), crossing, FARTHEST_MM)
