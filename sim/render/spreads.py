"""Tables of scattered light of a scene's water: shipped, or made once and kept in the cache."""

import hashlib
import os
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from importlib.resources import files
from importlib.resources.abc import Traversable
from math import log

import drjit as dr
import mitsuba as mi
import numpy as np

from lscan.errors import InputError
from lscan.files.cache import long_work
from lscan.records import Floats, Progress
from sim.render.plugins.arrays import floats, opaque
from sim.render.plugins.water import PhaseTable
from sim.water import Optics
from sim.water.spread import (
    ANGLE_AXIS,
    EDGES_FROM,
    PLANE_RINGS,
    PLANE_RINGS_FROM,
    PLANE_RINGS_TO,
    RINGS,
    SECTORS,
    Crossings,
    OnceScattered,
    PlaneCounts,
    Spread,
    once_scattered,
    tabulate,
)
from sim.water.tablecache import kept_arrays

# Photons of a pencil beam in endless water, counted where they first cross spheres and planes.
#
# The walks are analog: free paths and turns are drawn as the water scatters, absorption is a
# weight.  Lengths are optical depths.


BATCH = 2**20  # photons of one launch: their state is about 50 MB
# A photon that travels along a sphere as it crosses it adds 1 / 0.01 to the tangential sum at
# most; a share of 1e-4 of even light is steeper still.
GRAZING = 0.01
DIM, SURVIVAL = 0.02, 0.1  # below this weight, one photon in ten goes on
LOST = 2.0  # times the largest distance: from there hardly a photon comes back
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
    walk = _ToSpheres(phase, albedo, depths, SUMS * 2 * len(depths) * RINGS)
    sent = walk.send(photons, seed, progress)
    sums = np.array(walk.sums).reshape(SUMS, 2, len(depths), RINGS)
    return Crossings(sent, np.array(depths, dtype=float), *sums)


def plane_crossings(
    phase: Callable[[Floats], Floats],
    albedo: float,
    distances: Floats,
    tilts: Floats,
    photons: int,
    seed: int,
    progress: Progress | None = None,
) -> PlaneCounts:
    """Photons scattered more than once, counted in cells of planes across their beam.

    Parameters
    ----------
    phase, albedo, seed, progress : as of ``first_crossings``
    distances : (K,) where the planes cross the beam, optical depths, rising
    tilts : (T,) rad, between the planes' normals and the beam, 0 to less than pi / 2
    photons : int, how many at least, shared out to the tilts
    """
    shape = len(tilts), len(distances), PLANE_RINGS, SECTORS
    walk = _ToPlanes(phase, albedo, distances, int(np.prod(shape)))
    walk.tilts, walk.kinds = floats(tilts), len(tilts)
    each = walk.send(-(-photons // len(tilts)) * len(tilts), seed, progress) // len(tilts)
    weight = np.array(walk.sums).reshape(shape)
    return PlaneCounts(each, np.array(tilts), np.array(distances, dtype=float), weight)


def batches(photons: int) -> int:
    """How many batches these photons are sent in."""
    return -(-photons // BATCH)


@dataclass(frozen=True)
class _Crossing:
    """Photons where they cross the surface of a number; ``active``: those that do."""

    place: mi.Point3f
    towards: mi.Vector3f
    weight: mi.Float
    surface: mi.UInt32
    order: mi.UInt32
    lane: mi.UInt32
    active: mi.Bool


class _Walk(ABC):
    """The water, surfaces in the order in which photons can cross them, and what they count."""

    def __init__(
        self, phase: Callable[[Floats], Floats], albedo: float, depths: Floats, sums: int
    ) -> None:
        self.phase = PhaseTable(phase)
        self.scattering, self.absorption = opaque(albedo), opaque(1 - albedo)
        self.surfaces, self.lost = len(depths), opaque((LOST * depths[-1]) ** 2)
        self.depths = floats(depths)
        self.sums = dr.zeros(mi.Float64, sums)

    def send(self, photons: int, seed: int, progress: Progress | None) -> int:
        """Send photons in batches; how many there were."""
        batch, every = min(BATCH, photons), batches(photons)
        for number in range(every):
            self.follow(batch, dr.opaque(mi.UInt64, seed * every + number))
            dr.eval(self.sums)
            dr.sync_thread()
            if progress is not None:
                progress(number + 1, every)
        return batch * every

    @dr.syntax
    def follow(self, count: int, seed: mi.UInt64) -> None:
        """Send photons until they have crossed all surfaces, are absorbed or are lost."""
        random = mi.PCG32(size=count, initstate=seed)
        lane = dr.arange(mi.UInt32, count)
        place = dr.zeros(mi.Point3f, count)
        towards = mi.Vector3f(0, 0, dr.full(mi.Float, 1, count))
        weight = dr.full(mi.Float, 1, count)
        surface, order = dr.zeros(mi.UInt32, count), dr.zeros(mi.UInt32, count)
        active = dr.full(mi.Bool, True, count)
        while active:
            free = -dr.log(1 - random.next_float32()) / self.scattering
            crossing = mi.Bool(active)
            while crossing:
                depth = dr.gather(mi.Float, self.depths, surface, crossing)
                path = self.path(place, towards, depth, lane)
                crossing &= path <= free
                reached = weight * dr.exp(-self.absorption * path)
                there = mi.Point3f(place + towards * path)
                self.count(_Crossing(there, towards, reached, surface, order, lane, crossing))
                surface = dr.select(crossing, surface + 1, surface)
                crossing &= surface < self.surfaces
            place = mi.Point3f(place + towards * free)
            weight *= dr.exp(-self.absorption * free)
            active &= (surface < self.surfaces) & (dr.squared_norm(place) < self.lost)
            sample = mi.Point2f(random.next_float32(), random.next_float32())
            towards = self.phase.sample_direction(towards, sample)
            order += 1
            survival = dr.select(weight < DIM, mi.Float(SURVIVAL), 1)
            active &= random.next_float32() < survival
            weight /= survival

    @abstractmethod
    def path(
        self, place: mi.Point3f, towards: mi.Vector3f, depth: mi.Float, lane: mi.UInt32
    ) -> mi.Float:
        """How far it is to the next surface, infinity where it is not ahead."""

    @abstractmethod
    def count(self, at: _Crossing) -> None:
        """Add photons that cross a surface to its sums."""


class _ToSpheres(_Walk):
    """Photons to spheres about the origin."""

    def path(
        self, place: mi.Point3f, towards: mi.Vector3f, depth: mi.Float, lane: mi.UInt32
    ) -> mi.Float:
        ahead = dr.dot(place, towards)
        beside2 = dr.maximum(dr.squared_norm(place) - dr.square(ahead), 0)
        return dr.safe_sqrt(dr.square(depth) - beside2) - ahead

    def count(self, at: _Crossing) -> None:
        up = dr.normalize(mi.Vector3f(at.place))
        sine = dr.hypot(up.x, up.y)
        inner = EDGES_FROM
        angle = dr.log(dr.maximum(dr.atan2(sine, up.z), inner / 2)) - log(inner)
        ring = 1 + angle * ((RINGS - 1) / log(np.pi / inner))
        ring = mi.UInt32(dr.clip(ring, 0, RINGS - 1))
        away = mi.Vector3f(up.x * up.z, up.y * up.z, -dr.square(sine)) / dr.maximum(sine, 1e-20)
        slope = dr.dot(at.towards, away) / dr.maximum(dr.dot(at.towards, up), GRAZING)
        often = dr.select(at.order > 1, mi.UInt32(self.surfaces), 0)
        cell = (often + at.surface) * RINGS + ring
        scored = at.active & (at.order > 0)
        for kind, value in enumerate((at.weight, dr.square(at.weight), at.weight * slope)):
            start = kind * 2 * self.surfaces * RINGS
            dr.scatter_reduce(dr.ReduceOp.Add, self.sums, mi.Float64(value), start + cell, scored)


class _ToPlanes(_Walk):
    """Photons to planes across the beam, each photon to those of one tilt about y."""

    tilts: mi.Float
    kinds: int

    def path(
        self, place: mi.Point3f, towards: mi.Vector3f, depth: mi.Float, lane: mi.UInt32
    ) -> mi.Float:
        down = self._down(lane)
        towards_plane = dr.dot(towards, down)
        path = (depth * down.z - dr.dot(mi.Vector3f(place), down)) / towards_plane
        return dr.select(towards_plane > 0, path, dr.inf)

    def count(self, at: _Crossing) -> None:
        angle = dr.atan2(dr.hypot(at.place.x, at.place.y), at.place.z)
        inner, outer = PLANE_RINGS_FROM, PLANE_RINGS_TO
        ring = (dr.log(dr.maximum(angle, 1e-9)) - log(inner)) * (PLANE_RINGS / log(outer / inner))
        scored = at.active & (at.order > 1) & (ring >= 0) & (ring < PLANE_RINGS)
        sector = dr.abs(dr.atan2(at.place.y, at.place.x)) * (SECTORS / np.pi)
        sector = mi.UInt32(dr.minimum(sector, SECTORS - 1))
        cell = (at.lane % self.kinds * self.surfaces + at.surface) * PLANE_RINGS + mi.UInt32(ring)
        cell = cell * SECTORS + sector
        dr.scatter_reduce(dr.ReduceOp.Add, self.sums, mi.Float64(at.weight), cell, scored)

    def _down(self, lane: mi.UInt32) -> mi.Vector3f:
        """The planes' normal, away from the beam's origin; they are farther away at x > 0."""
        sine, cosine = dr.sincos(dr.gather(mi.Float, self.tilts, lane % self.kinds))
        return mi.Vector3f(-sine, 0, cosine)


# Tables of scattered light of a scene's water: shipped, or made once and kept in the user's cache.


FORMAT = 3  # of the kept files: raised where other numbers would be written
# 81 s of one core in water of 10 NTU, 50 s in 5, 19 s in 1, shared by all cores: a third each for
# counting, for drawing angles and for the rest of the walks.  The standard error is then 0.3 % or
# less within 2.5 rad of the beam, wherever the light of a ring is 1 % of the brightest ring's.
MOST_PHOTONS, FEWEST_PHOTONS, SEED = 20 * 2**20, 2**14, 1
# Distances of a scanner's parts, mm.  Beyond so many scatterings hardly any light arrives.
NEAREST_MM, FARTHEST_MM = 100.0, 3000.0
MOST_SCATTERINGS = 25.0
SPHERES = 16
TO_PLANES = 4  # so many photons go to spheres for each one that goes to planes
KEPT = ("multiple", "error", "horizon")
TILTS = np.radians([0.0, 15.0, 30.0, 42.0, 52.0, 61.0, 69.0, 76.0])


def photons_asked_for() -> int:
    """As LSCAN_PHOTONS says, for who needs tables soon rather than smooth.

    Raises
    ------
    InputError
        It says no number, or too small a one.
    """
    said = os.environ.get("LSCAN_PHOTONS", str(MOST_PHOTONS))
    if not said.isdecimal() or int(said) < FEWEST_PHOTONS:
        allowed = f"a whole number from {FEWEST_PHOTONS} on"
        raise InputError("no number of photons", where="LSCAN_PHOTONS", value=said, allowed=allowed)
    return int(said)


PHOTONS = photons_asked_for()


def spread_of(water: Optics, photons: int = PHOTONS, seed: int = SEED) -> Spread:
    """How a beam spreads in a water: as shipped, from the user's cache, or made and kept there.

    Tables of the waters of ``scenes`` are shipped (``sim/water/spreads``, written by
    ``make tables``) and serve whoever asks for no more photons.  A command line shows how far the
    making of others is (``lscan.files.cache``).

    Parameters
    ----------
    water : Optics, the water
    photons : int, how many at least
    seed : int, of the random numbers

    Raises
    ------
    InputError
        The water scatters nothing.
    """
    depths = _depths(water)
    nearest, farthest = (float(depth) for depth in depths[[0, -1]])
    shipped = shipped_file(water)
    if shipped.is_file() and photons <= MOST_PHOTONS and seed == SEED:
        with shipped.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            tables = (arrays[name].astype(float) for name in KEPT)
            return Spread(
                once_scattered(water.phase, _albedo(water), farthest), nearest, farthest, *tables
            )

    def made() -> dict[str, Floats]:
        with long_work("tables of this water's scattered light") as progress:
            spread = make_spread(water, photons, seed, progress)
        once = spread.once.table.view(float)
        return {"once": once, **{name: getattr(spread, name) for name in KEPT}}

    phase = water.phase(ANGLE_AXIS.nodes())
    numbers = np.array([FORMAT, _albedo(water), photons, seed, *depths, *phase], dtype=float)
    kept = kept_arrays(f"spread-{hashlib.sha256(numbers.tobytes()).hexdigest()[:32]}", made)
    once = OnceScattered(_albedo(water), farthest, kept["once"].view(complex))
    return Spread(once, nearest, farthest, *(kept[name] for name in KEPT))


def shipped_file(water: Optics) -> Traversable:
    """Where tables of this water, made of MOST_PHOTONS from SEED, lie if they are shipped.

    Parameters
    ----------
    water : Optics, the water; its numbers are told apart to nine digits, which hardly depend on
        the machine's own functions
    """
    numbers = [FORMAT, _albedo(water), *_depths(water), *water.phase(ANGLE_AXIS.nodes())]
    told = " ".join(f"{number:.8e}" for number in numbers)
    return files("sim.water") / "spreads" / f"{hashlib.sha256(told.encode()).hexdigest()[:32]}.npz"


def make_spread(water: Optics, photons: int, seed: int, progress: Progress | None = None) -> Spread:
    """How a beam spreads in a water, made anew.

    Parameters
    ----------
    water, photons, seed : as of ``spread_of``
    progress : callable, optional, called with (done, all)
    """
    albedo, depths, flat = _albedo(water), _depths(water), photons // TO_PLANES
    first, every = batches(photons), batches(photons) + batches(flat)
    shown = progress or (lambda done, every: None)
    crossings = first_crossings(
        water.phase, albedo, depths, photons, seed, lambda done, _: shown(done, every)
    )
    counts = plane_crossings(
        water.phase, albedo, depths, TILTS, flat, seed, lambda done, _: shown(first + done, every)
    )
    return tabulate(water.phase, albedo, crossings, counts)


def _albedo(water: Optics) -> float:
    return water.scattering_per_mm / water.extinction_per_mm


def _depths(water: Optics) -> Floats:
    """(SPHERES,) optical depths at which photons are counted."""
    if water.scattering_per_mm <= 0:
        raise InputError("scatters no light", where="water", value=0.0, allowed="above 0")
    farthest = min(water.extinction_per_mm * FARTHEST_MM, MOST_SCATTERINGS / _albedo(water))
    return np.geomspace(min(water.extinction_per_mm * NEAREST_MM, farthest / 2), farthest, SPHERES)
