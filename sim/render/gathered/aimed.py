"""Walks of light through water from the camera to a given place.

A walk starts along an axis of its own and is scattered by chance.  Where it crosses the sphere
about its start whose radius is the place's distance, it is turned about its start so that it ends
at the place.  The radiance that arrives along the first leg of such walks, of a source of the
radiant intensity I at the place, is then the mean of I / (distance2 cos), cos being that between
the last leg and the sphere's normal: an element of volume is distance2 dOmega times cos of the
element of the last leg.
"""

from dataclasses import dataclass
from math import pi

import drjit as dr
import mitsuba as mi

from sim.render.plugins.phase import PhaseTable, angle_between

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
