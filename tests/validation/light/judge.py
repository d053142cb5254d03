"""The judge: light of two and more orders in a window of a picture, by families."""

from collections.abc import Mapping
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from lscan.records import Floats
from sim.render.layers import W_PER_M2_IN_MW_PER_MM2
from sim.render.plugins.camera import RefractiveCamera
from sim.render.plugins.sheet import LaserSheet
from sim.render.plugins.water import angle_between
from sim.render.sampled.beams import Falloff, line_density
from sim.render.sampled.integrator import Leg, SheetIntegrator, crossing_of
from sim.render.tank import Tank
from sim.scene import camera_pose, head_pose
from tests.validation.light.judgedphotons import (
    LONGEST_PATH,
    CellRecords,
    PhotonRecords,
    SurfaceCells,
    Waters,
    shoot,
    spared,
    voxel_key,
)

# Walks from the camera that meet photons where they end, or where their light turns most.
#
# Light of two and more orders is partitioned so that each path is counted once:
#
#     no surface        joined where the water turns it most: walk, water, photon or sheet
#     one surface       joined there: a walk through water that ends on the surface, and photons
#     two and more      joined at the last one, on which photons land that were reflected before
#
# What the joint weighs is the phase function at the largest angle of the path, or what a surface
# reflects, so nothing weighs much.


FAMILIES = ("laser", "camera", "both", "interreflection", "veil")
HALO_MM = 10.0  # on either side of the sheet, where most of the water's photons are looked for


class CameraWalks:
    """Estimates of each family's radiance along rays of the camera."""

    def __init__(self, waters: Waters, single: SheetIntegrator, records: PhotonRecords) -> None:
        """Walk among these records; ``single`` finds single scattering in the same water."""
        self.waters, self.single, self.records = waters, single, records
        self.sheets = single.sheets

    def light(self, ray: mi.Ray3f, sampler: mi.Sampler) -> list[mi.Float]:
        """Radiance of FAMILIES along the rays, in mW/(mm2 sr), one walk each.

        On the camera's own leg scattered and unscattered light are both followed: what arrives
        unscattered is certain, and the walk always scatters.
        """
        waters, scene = self.waters, self.waters.scene
        own = Leg(scene, sampler, ray, scene.ray_intersect(ray), mi.Bool(True))
        chance = waters.chance_within(own.si.t)
        straight = waters.kept(own.si.t) * (1 - chance)
        laser, between = self._landed(own, straight, waters.surfaces, self.records.landed)
        veil = self._met(own, mi.Float(0))
        free = waters.free_path(chance * sampler.next_1d())
        start = mi.Ray3f(ray(free), waters.water.phase.sample_direction(ray.d, sampler.next_2d()))
        weight = dr.select(chance > 0, chance * waters.kept(free), 0.0)
        met, last, weight = self._walk(start, angle_between(ray.d, start.d), weight, sampler)
        end = Leg(scene, sampler, last, scene.ray_intersect(last, weight > 0), weight > 0)
        both, reflected = self._landed(end, weight, waters.wide, self.records.wide)
        end.si.t = dr.select(end.si.is_valid(), 0.0, end.si.t)  # the weight counts the way
        camera = mi.Float(0)
        for sheet in self.sheets:
            camera += weight * waters.water.direct(end, sheet)
        return [laser, camera, both, between + reflected, veil + met]

    @dr.syntax
    def _walk(
        self, start: mi.Ray3f, angle: mi.Float, first: mi.Float, sampler: mi.Sampler
    ) -> tuple[mi.Float, mi.Ray3f, mi.Float]:
        """Light met in the water by walks that were turned by ``angle`` and weigh ``first``.

        Also the rays on which they end, and their weights on the surface there, 0 where there is
        none.
        """
        waters, veil, arrived = self.waters, mi.Float(0), mi.Float(0)
        ray, weight, turned = mi.Ray3f(start), mi.Float(first), mi.Float(angle)
        step, active = mi.UInt32(0), weight > 0
        while active:
            si = waters.scene.ray_intersect(ray, active)
            leg = Leg(waters.scene, sampler, ray, si, mi.Bool(active))
            veil += weight * self._met(leg, turned)
            for sheet in self.sheets:
                veil += weight * self.single.scattered(leg, sheet, turned)
            free = waters.free_path(sampler.next_1d(active))
            in_water = active & (free < si.t)
            ends = active & ~in_water & si.is_valid()
            arrived = dr.select(ends, weight * waters.kept(si.t), arrived)
            onward = waters.water.phase.sample_direction(ray.d, sampler.next_2d(active))
            turned = dr.maximum(turned, angle_between(ray.d, onward))
            weight *= dr.select(in_water, waters.kept(free), 0.0)
            weight = spared(weight, sampler.next_1d(active))
            ray.o = dr.select(in_water, ray(free), ray.o)
            ray.d = dr.select(in_water, onward, ray.d)
            active = in_water & (weight > 0) & (step < LONGEST_PATH)
            step += 1
        return veil, ray, arrived

    def _landed(
        self, leg: Leg, weight: mi.Float, cells: SurfaceCells, records: CellRecords
    ) -> tuple[mi.Float, mi.Float]:
        """Light that photons brought to the surface on the ray, by scattering and by reflection.

        Of one photon of the cell, times their number; each of the two times ``weight``.
        """
        si, active = leg.si, leg.active & leg.si.is_valid() & (weight > 0)
        key, area = cells.find(si, -leg.ray.d, active)
        photon = records.draw(key, leg.sampler.next_1d(active), active)
        active &= photon.count > 0
        outgoing = si.to_local(photon.towards)
        value = si.bsdf().eval(mi.BSDFContext(), si, outgoing, active)
        facing = dr.abs(dr.dot(si.n, photon.towards))
        light = weight * value.x / facing * photon.power * photon.count / area
        light = dr.select(active & (facing > 0), light, 0.0)
        reflected = photon.mark < 0
        return dr.select(reflected, 0.0, light), dr.select(reflected, light, 0.0)

    def _met(self, leg: Leg, turned: mi.Float) -> mi.Float:
        """Light that photons in the water send along the ray where the path turns most."""
        waters, ray = self.waters, leg.ray
        if not waters.water.has_water:
            return mi.Float(0)
        end = dr.select(leg.si.is_valid(), dr.minimum(leg.si.t, waters.water.far), waters.water.far)
        densities = [self._about(sheet, ray, end) for sheet in self.sheets]
        sample, choice = leg.sampler.next_1d(leg.active), leg.sampler.next_1d(leg.active)
        t = densities[0].sample(sample)
        for number, density in enumerate(densities[1:], start=1):
            t = dr.select(choice * len(densities) >= number, density.sample(sample), t)
        density = sum((one.density(t) for one in densities), mi.Float(0)) / len(densities)

        active = leg.active & (t > 0) & (t < end)
        key = voxel_key(ray(t), waters.voxel_mm)
        photon = self.records.met.draw(key, leg.sampler.next_1d(leg.active), active)
        angle = angle_between(photon.towards, ray.d)
        active &= (photon.count > 0) & (angle > photon.mark) & (angle > turned)
        light = photon.power * photon.count / waters.voxel_mm**3 * waters.water.phase.value(angle)
        return dr.select(active, light * dr.exp(-waters.water.extinction * t) / density, 0.0)

    def _about(self, sheet: LaserSheet, ray: mi.Ray3f, end: mi.Float) -> Falloff:
        """Where along a ray to look for photons: about its crossing of the sheet."""
        crossing, slope = crossing_of(sheet, ray)
        _, rho, _ = sheet.coordinates(ray(crossing), ray.time)
        crossing = dr.select(dr.isfinite(crossing), crossing, 0.0)
        width = dr.select(dr.isfinite(rho), sheet.half_width(rho), 0.0) + HALO_MM
        return line_density(crossing, width / dr.maximum(dr.abs(slope), 1e-3), end)


# The judge: light of two and more orders in a window of a picture, by families.


Window = tuple[int, int, int, int]
RECORDS_A_PHOTON = 1  # at first; more where there is no room for all


@dataclass(frozen=True)
class JudgeEffort:
    """How much the judge does.

    Attributes
    ----------
    photons : int, of each sheet, a batch
    walks : int, of each pixel, a batch
    batches : int, independent ones, from which standard errors come
    cell_mm : float, mm, largest side of a cell of the surfaces; light that varies as a Gaussian of
        the standard deviation s comes out too low at its peak by cell_mm2 / (12 s2)
    voxel_mm : float, mm, side of a cell of the water
    """

    photons: int = 1 << 20
    walks: int = 64
    batches: int = 16
    cell_mm: float = 0.15
    voxel_mm: float = 2.0


EFFORT = JudgeEffort()


@dataclass(frozen=True)
class Judged:
    """What the judge found in a window, W/(m2 sr) in the air behind the port.

    Attributes
    ----------
    families : mapping of names to (batches, H, W) arrays, each batch's own estimate.  One surface
        and water before it ("laser"), behind it ("camera") or both ("both"), as the light goes;
        two surfaces and more ("interreflection"); none ("veil")
    """

    families: Mapping[str, Floats]

    @property
    def total(self) -> Floats:
        """(batches, H, W) of all families together."""
        return np.asarray(sum(self.families.values()))

    def mean(self, family: str) -> Floats:
        """(H, W) the best estimate.

        Parameters
        ----------
        family : str, one of ``families``
        """
        return np.asarray(self.families[family].mean(axis=0))

    def error(self, family: str) -> Floats:
        """(H, W) its standard error.

        Parameters
        ----------
        family : str, one of ``families``
        """
        batches = self.families[family]
        return np.asarray(batches.std(axis=0, ddof=1) / np.sqrt(len(batches)))


def judge(
    tank: Tank,
    position_mm: float,
    window: Window | None = None,
    effort: JudgeEffort = EFFORT,
    seed: int = 0,
) -> Judged:
    """The laser's light of two and more orders, without bias but that of the cells.

    The head stands still while the picture is taken; the lens is not yet counted.

    Parameters
    ----------
    tank : Tank
        Its water, sheets and surfaces, which have to be meshes, as they are.
    position_mm : float
        Track position of the head, mm.
    window : (left, top, width, height), optional
        Px, of the picture; all of it if None.  With the scene's fineness f the arrays have f rows
        and columns a pixel.
    effort : JudgeEffort
        How much is done.
    seed : int
        Of all random numbers.

    """
    tank.place(position_mm)
    camera = tank.make_camera(window=window, jitter=True)
    head = tank.scene.tank.head
    camera.place(head_pose(head, position_mm) @ camera_pose(head))
    waters = _waters(tank, effort)
    seeds = np.random.SeedSequence(seed).generate_state(effort.batches)
    batches = []
    capacity = RECORDS_A_PHOTON * effort.photons * len(tank.sheets)
    for one in (int(word) >> 1 for word in seeds):
        records = _photons_landed(tank, waters, effort.photons, one, capacity)
        capacity = records.landed.capacity
        walks = CameraWalks(waters, tank.integrator, records)
        batches.append(_pictures(walks, camera, effort.walks, one + len(tank.sheets)))
    pictures = np.moveaxis(np.array(batches), 1, 0)
    return Judged(dict(zip(FAMILIES, pictures, strict=True)))


def landed_irradiance(
    tank: Tank, rays: mi.Ray3f, effort: JudgeEffort = EFFORT, seed: int = 0
) -> Floats:
    """What one batch of photons brings to the places where rays meet a surface, mW/mm2.

    Light that was scattered on its way, but not reflected, of a photon each.

    Parameters
    ----------
    tank : Tank, its water, sheets and surfaces, as they are
    rays : Ray3f, each has to meet a surface
    effort : JudgeEffort, its photons and cells
    seed : int, of all random numbers

    Returns
    -------
    (N,) one estimate a ray.
    """
    waters, capacity = _waters(tank, effort), RECORDS_A_PHOTON * effort.photons * len(tank.sheets)
    landed = _photons_landed(tank, waters, effort.photons, seed, capacity).landed
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed + len(tank.sheets), dr.width(rays))
    key, area = waters.surfaces.find(waters.scene.ray_intersect(rays), -rays.d, mi.Bool(True))
    photon = landed.draw(key, sampler.next_1d(), mi.Bool(True))
    found = (photon.count > 0) & (photon.mark >= 0)
    light = dr.select(found, photon.power * photon.count / area, 0.0)
    return np.array(light, dtype=float)


def _waters(tank: Tank, effort: JudgeEffort) -> Waters:
    return Waters(tank.mitsuba_scene, tank.higher, effort.cell_mm, effort.voxel_mm)


def _photons_landed(
    tank: Tank, waters: Waters, photons: int, seed: int, capacity: int
) -> PhotonRecords:
    """The records of so many photons of each sheet, sorted; with more room where that is short."""
    records = PhotonRecords(capacity)
    for number, sheet in enumerate(tank.sheets):
        shoot(waters, sheet, photons, seed + number, records)
    if records.sort():
        return records
    return _photons_landed(tank, waters, photons, seed, 2 * capacity)


def _pictures(walks: CameraWalks, camera: RefractiveCamera, count: int, seed: int) -> list[Floats]:
    """(H, W) pictures of FAMILIES, by so many walks a pixel."""
    width, height = camera.film().crop_size()
    rays = width * height * count
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, rays)
    pixel = dr.arange(mi.UInt32, rays) // count
    place = mi.Point2f(pixel % width, pixel // width) + sampler.next_2d()
    place /= mi.Vector2f(width, height)
    ray, weight = camera.sample_ray(mi.Float(0.5), mi.Float(0), place, sampler.next_2d())
    light = [value * weight.x * W_PER_M2_IN_MW_PER_MM2 for value in walks.light(ray, sampler)]
    dr.eval(light)
    return [
        np.array(value, dtype=float).reshape(height, width, count).mean(axis=-1) for value in light
    ]
