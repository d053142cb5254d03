"""Photons of the laser: scattered and reflected as chance has it, and noted wherever they land."""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from sim.render.judge.cells import CellRecords, SurfaceCells, voxel_key
from sim.render.plugins.sheet import LaserSheet
from sim.render.plugins.water import angle_between
from sim.render.sampled.beams import straight_rays
from sim.render.sampled.integrator import WaterIntegrator

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
