"""Photons of a pencil beam in endless water, counted where they first cross spheres.

The walks are analog: free paths and turns are drawn as the water scatters, absorption is a
weight.  Lengths are optical depths.
"""

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from lscan.records import Floats, Progress
from sim.render.plugins.opaque import opaque
from sim.render.plugins.phase import PhaseTable
from sim.water.rings import EDGES_FROM, RINGS, Crossings

BATCH = 2**20  # photons of one launch: their state is about 50 MB
# A photon that travels along a sphere as it crosses it adds 1 / 0.01 to the tangential sum at
# most; a share of 1e-4 of even light is steeper still.
GRAZING = 0.01
DIM, SURVIVAL = 0.02, 0.1  # below this weight, one photon in ten goes on
SUMS = 3  # weight, squared, tangential


def first_crossings(
    phase: Callable[[Floats], Floats],
    albedo: float,
    depths: Floats,
    photons: int,
    seed: int,
    progress: Progress | None = None,
) -> Crossings:
    """Photons counted in rings of spheres about the origin of their beam.

    Parameters
    ----------
    phase : function of the scattering angle in rad, 1/sr
    albedo : float, b / c, above 0
    depths : (K,) the spheres' optical radii, rising
    photons : int, how many at least; they are sent in whole batches
    seed : int, of the random numbers
    progress : callable, optional, called with (done, all) after each batch
    """
    walk = _Walk(phase, albedo, depths)
    batch = min(BATCH, photons)
    batches = -(-photons // batch)
    for number in range(batches):
        walk.follow(batch, dr.opaque(mi.UInt64, seed * batches + number))
        dr.eval(walk.sums)
        dr.sync_thread()
        if progress is not None:
            progress(number + 1, batches)
    sums = np.array(walk.sums).reshape(SUMS, 2, len(depths), RINGS)
    return Crossings(batch * batches, np.array(depths, dtype=float), *sums)


class _Walk:
    """The water, the spheres, and the sums that photons leave there."""

    def __init__(self, phase: Callable[[Floats], Floats], albedo: float, depths: Floats) -> None:
        self.phase = PhaseTable(phase)
        self.scattering, self.absorption = opaque(albedo), opaque(1 - albedo)
        self.spheres = len(depths)
        self.depths = mi.Float(np.asarray(depths, dtype=np.float32))
        self.sums = dr.zeros(mi.Float64, SUMS * 2 * self.spheres * RINGS)

    @dr.syntax
    def follow(self, count: int, seed: mi.UInt64) -> None:
        """Send photons until they have crossed all spheres or are absorbed."""
        random = mi.PCG32(size=count, initstate=seed)
        place = dr.zeros(mi.Point3f, count)
        towards = mi.Vector3f(0, 0, dr.full(mi.Float, 1, count))
        weight = dr.full(mi.Float, 1, count)
        sphere, order = dr.zeros(mi.UInt32, count), dr.zeros(mi.UInt32, count)
        active = dr.full(mi.Bool, True, count)
        while active:
            free = -dr.log(1 - random.next_float32()) / self.scattering
            ahead = dr.dot(place, towards)
            beside2 = dr.maximum(dr.squared_norm(place) - dr.square(ahead), 0)
            crossing = mi.Bool(active)
            while crossing:
                radius = dr.gather(mi.Float, self.depths, sphere, crossing)
                path = dr.safe_sqrt(dr.square(radius) - beside2) - ahead
                crossing &= path <= free
                reached = weight * dr.exp(-self.absorption * path)
                self.count(place + towards * path, towards, reached, sphere, order, crossing)
                sphere = dr.select(crossing, sphere + 1, sphere)
                crossing &= sphere < self.spheres
            active &= sphere < self.spheres
            place = mi.Point3f(place + towards * free)
            weight *= dr.exp(-self.absorption * free)
            sample = mi.Point2f(random.next_float32(), random.next_float32())
            towards = self.phase.sample_direction(towards, sample)
            order += 1
            survival = dr.select(weight < DIM, mi.Float(SURVIVAL), 1)
            active &= random.next_float32() < survival
            weight /= survival

    def count(
        self,
        place: mi.Point3f,
        towards: mi.Vector3f,
        weight: mi.Float,
        sphere: mi.UInt32,
        order: mi.UInt32,
        active: mi.Bool,
    ) -> None:
        """Add photons that leave a sphere to its rings; those never scattered are left out."""
        up = dr.normalize(mi.Vector3f(place))
        sine = dr.hypot(up.x, up.y)
        angle = dr.maximum(dr.atan2(sine, up.z), EDGES_FROM / 2)
        scale = (RINGS - 1) / float(np.log(np.pi / EDGES_FROM))
        ring = mi.UInt32(
            dr.clip((dr.log(angle) - float(np.log(EDGES_FROM))) * scale + 1, 0, RINGS - 1)
        )
        away = mi.Vector3f(up.x * up.z, up.y * up.z, -dr.square(sine)) / dr.maximum(sine, 1e-20)
        slope = dr.dot(towards, away) / dr.maximum(dr.dot(towards, up), GRAZING)
        often = dr.select(order > 1, mi.UInt32(self.spheres), 0)
        index = (often + sphere) * RINGS + ring
        for kind, value in enumerate((weight, dr.square(weight), weight * slope)):
            start = kind * 2 * self.spheres * RINGS
            scored = active & (order > 0)
            dr.scatter_reduce(dr.ReduceOp.Add, self.sums, mi.Float64(value), start + index, scored)
