"""Walks from the camera that meet photons where they end, or where their light turns most.

Light of two and more orders is partitioned so that each path is counted once:

    no surface        joined where the water turns it most: walk, water, photon or sheet
    one surface       joined there: a walk through water that ends on the surface, and photons
    two and more      joined at the last one, on which photons land that were reflected before

What the joint weighs is the phase function at the largest angle of the path, or what a surface
reflects, so nothing weighs much.
"""

import drjit as dr
import mitsuba as mi

from sim.render.judge.cells import CellRecords, SurfaceCells, voxel_key
from sim.render.judge.photons import LONGEST_PATH, PhotonRecords, Waters, spared
from sim.render.plugins.sheet import LaserSheet
from sim.render.plugins.water import angle_between
from sim.render.sampled.beams import Falloff, line_density
from sim.render.sampled.integrator import Leg, SheetIntegrator, crossing_of

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
