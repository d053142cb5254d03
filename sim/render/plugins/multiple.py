"""The integrator plugin for light of all higher orders: two and more surfaces or places of water.

Paths are partitioned by their order, the number of their vertices between laser and camera.
The last two vertices, x on the ray at hand and y where the laser's light first turns, are
drawn together, because a chance ray never meets a thin sheet or its line:

    x on a surface, y on a surface   interreflection
    x on a surface, y in the water   light scattered onto the target
    x in the water, y on a surface   the halo about the line
    x in the water, y in the water   the veil's own blur

One ray of the laser serves the families with water, a few more the first.  It is drawn near
the ray at hand (sim.render.plugins.beams); places in the water are drawn by the angle of scattering
(sim.render.plugins.phase), from the surface's point or, in the last family, from each other, in
either order, weighted by the balance heuristic (Veach 1997, sec. 9.2).  Interreflection is
weighted against the surface's own sampling by the power heuristic, for light that meets a
surface near a corner.  Paths of three and more orders are walks from the camera that end in
such a pair at every step; a walk turns as surface and water scatter, or towards the apex or
the line, from where most of the light comes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from sim.render.plugins.beams import (
    FARTHEST_MM,
    Beam,
    beam_density,
    drawn_beam,
    line_density,
    ray_density,
)
from sim.render.plugins.integrator import direct_light
from sim.render.plugins.opaque import opaque
from sim.render.plugins.phase import PhaseTable, angle_between, approach
from sim.render.plugins.sheet import LaserSheet
from sim.water import Optics

HIGHER_LAYERS = ("scattered", "ambient")
FAR_OPTICAL_DEPTH = 25.0  # what lies deeper is dimmer by 1e-11
# Shares of a walk's first turns that are drawn about the direction to the apex, and to the
# line, and what is left of them at later turns: what is not drawn so weighs the more, by
# 1 / (1 - both) a turn, which over the many turns in turbid water would grow beyond bounds.
TO_APEX, TO_LINE, LATER = 0.25, 0.35, 0.15
REFLECTIONS = 4  # rays of the laser that look for interreflection at each step of a walk
SURVIVAL = 0.95  # of a walk whose weight has not fallen
LONGEST_WALK = 256


@dataclass(frozen=True)
class Spot:
    """Where a ray of the laser meets a surface.

    flux: mW that arrive there per unit of the ray's density, after the water's loss, over
    the cosine.  density: probability per mm2 of drawing the point.
    """

    si: mi.SurfaceInteraction3f
    to_apex: mi.Vector3f
    flux: mi.Float
    density: mi.Float
    valid: mi.Bool


class MultipleIntegrator(mi.SamplingIntegrator):
    """Laser light of the second and all higher orders, and ambient light's interreflection."""

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.sheets: Sequence[LaserSheet] = ()

    def configure(
        self, water: Optics, sheets: Sequence[LaserSheet], ambient_mw_mm2_sr: float
    ) -> None:
        """Set the water, the laser's sheets (none: off) and the ambient radiance."""
        self.sheets = tuple(sheets)
        self.extinction = opaque(water.extinction_per_mm)
        self.scattering = opaque(water.scattering_per_mm)
        self.has_water = water.scattering_per_mm > 0
        far = FARTHEST_MM
        if water.extinction_per_mm > 0:
            far = min(far, FAR_OPTICAL_DEPTH / water.extinction_per_mm)
        self.far = opaque(far)
        self.phase = PhaseTable(water.phase)
        self.has_ambient = ambient_mw_mm2_sr > 0
        self.ambient_radiance = opaque(ambient_mw_mm2_sr)

    def aov_names(self) -> list[str]:
        """One channel a layer, after the sum's own."""
        return list(HIGHER_LAYERS)

    def sample(
        self,
        scene: mi.Scene,
        sampler: mi.Sampler,
        ray: mi.RayDifferential3f,
        medium: mi.Medium | None = None,
        active: mi.Bool = True,
    ) -> tuple[mi.Spectrum, mi.Bool, list[mi.Float]]:
        """Radiance along the ray, validity, and the layers it is the sum of."""
        active = mi.Bool(active)
        laser, ambient = mi.Float(0), mi.Float(0)
        if self.sheets:
            laser = self._walk(scene, sampler, mi.Ray3f(ray), active)
        if self.has_ambient:
            ambient = self._ambient(scene, sampler, mi.Ray3f(ray), active)
        return mi.Spectrum(laser + ambient), active, [laser, ambient]

    @dr.syntax
    def _walk(
        self, scene: mi.Scene, sampler: mi.Sampler, ray: mi.Ray3f, active: mi.Bool
    ) -> mi.Float:
        """Light of two and more orders along the ray: a random walk that connects at each step."""
        total, weight = mi.Float(0), mi.Float(1)
        # Of the step before: the density of its direction, where it was a surface's.
        turned = mi.Float(0)
        step = mi.UInt32(0)
        active = mi.Bool(active)
        while active:
            si = scene.ray_intersect(ray, active)
            for sheet in self.sheets:
                total += weight * self._found(scene, sheet, ray, si, turned, active)
            # Russian roulette, which leaves the mean as it is.
            survival = dr.select(step == 0, 1.0, dr.minimum(weight, SURVIVAL))
            active &= sampler.next_1d(active) < survival
            weight /= dr.maximum(survival, 1e-12)
            aimed = dr.select(step == 0, mi.Float(1), LATER)
            total += weight * self._reflections(scene, sampler, ray, si, aimed, active)
            aim = self.sheets[0].apex(ray.time)
            if self.has_water:
                for number, sheet in enumerate(self.sheets):
                    light, spot = self._in_water(scene, sheet, sampler, ray, si, active)
                    total += weight * light
                    # The spot of any of the sheets, each as likely.
                    chosen = spot.valid & (sampler.next_1d(active) < 1 / (number + 1))
                    aim = dr.select(chosen, spot.si.p, aim)

            # The next vertex: in the water with the odds of its loss, else on the surface.
            free = -dr.log(1 - sampler.next_1d(active)) / dr.maximum(self.extinction, 1e-20)
            in_water = active & (free < si.t) & mi.Bool(self.has_water)
            on_surface = active & ~in_water & si.is_valid()
            vertex = dr.select(in_water, ray(free), si.p)
            onward, worth, density = self._turn(
                sampler, ray, si, vertex, aim, aimed, in_water, on_surface
            )
            weight *= worth
            reached = dr.select(si.is_valid(), dr.exp(-self.extinction * si.t), 0.0)
            turned = dr.select(on_surface, density * reached, 0.0)
            spawned = si.spawn_ray(onward)
            ray.o = dr.select(in_water, vertex, spawned.o)
            ray.d = onward
            active = (in_water | on_surface) & (weight > 0) & (step < LONGEST_WALK)
            step += 1
        return total

    @dr.syntax
    def _reflections(
        self,
        scene: mi.Scene,
        sampler: mi.Sampler,
        ray: mi.Ray3f,
        si: mi.SurfaceInteraction3f,
        aimed: mi.Float,
        active: mi.Bool,
    ) -> mi.Float:
        """Interreflection: the mean over several rays of the laser.

        In a valley a ray of the laser finds the opposite side or does not, so one is noisy;
        the line would be read wrong by chance.
        """
        total = mi.Float(0)
        count = mi.UInt32(0)
        seen = active & si.is_valid()
        while count < REFLECTIONS:
            for sheet in self.sheets:
                beam = drawn_beam(sheet, sampler, si.p, ray.time, seen)
                spot = self._spot(scene, sheet, beam, ray.time, seen)
                total += self._surface_surface(scene, ray, si, spot, aimed, seen)
            count += 1
        return total / REFLECTIONS

    def _turn(
        self,
        sampler: mi.Sampler,
        ray: mi.Ray3f,
        si: mi.SurfaceInteraction3f,
        vertex: mi.Point3f,
        aim: mi.Point3f,
        aimed: mi.Float,
        in_water: mi.Bool,
        on_surface: mi.Bool,
    ) -> tuple[mi.Vector3f, mi.Float, mi.Float]:
        """Where a walk goes from a vertex: the direction, its weight and its ``_turn_density``.

        Either as water or surface scatter, or scattered from the direction to the apex or to
        ``aim``, a point of the line: light that was turned a little on its way from there is
        hardly found otherwise.  aimed: what factor the shares of such turns have.
        """
        active = in_water | on_surface
        to_apex = self._to_apex(vertex, ray.time)
        to_aim = dr.normalize(aim - vertex)
        choice = sampler.next_1d(active)
        aimed = aimed if self.has_water else mi.Float(0)
        natural = choice >= aimed * (TO_APEX + TO_LINE)
        about = dr.select(choice < aimed * TO_APEX, to_apex, dr.select(natural, ray.d, to_aim))
        context = mi.BSDFContext()
        bs, _ = si.bsdf().sample(
            context, si, sampler.next_1d(active), sampler.next_2d(active), on_surface & natural
        )
        scattered = self.phase.sample_direction(about, sampler.next_2d(active))
        onward = dr.select(on_surface & natural, si.to_world(bs.wo), scattered)
        onward = dr.normalize(onward)

        value, pdf = si.bsdf().eval_pdf(context, si, si.to_local(onward), on_surface)
        angle = angle_between(ray.d, onward)
        albedo = self.scattering / dr.maximum(self.extinction, 1e-20)
        worth = dr.select(in_water, albedo * self.phase.value(angle), value.x)
        own = dr.select(in_water, self.phase.direction_density(angle), pdf)
        without_aim = self._turn_density(own, to_apex, onward, aimed)
        density = without_aim
        if self.has_water:
            lobe = self.phase.direction_density(angle_between(to_aim, onward))
            density = without_aim + aimed * TO_LINE * lobe
        return onward, dr.select(density > 0, worth / density, 0.0), without_aim

    def _to_apex(self, point: mi.Point3f, time: mi.Float) -> mi.Vector3f:
        return dr.normalize(self.sheets[0].apex(time) - point)  # all sheets have one apex

    def _turn_density(
        self, scattering: mi.Float, to_apex: mi.Vector3f, onward: mi.Vector3f, aimed: mi.Float
    ) -> mi.Float:
        """Density per steradian of a walk's turns, but for those that aim at the line.

        The heuristic that weighs interreflection needs one that knows of no point aimed at.
        """
        if not self.has_water:
            return scattering
        lobe = self.phase.direction_density(angle_between(to_apex, onward))
        return (1 - aimed * (TO_APEX + TO_LINE)) * scattering + aimed * TO_APEX * lobe

    def _in_water(
        self,
        scene: mi.Scene,
        sheet: LaserSheet,
        sampler: mi.Sampler,
        ray: mi.Ray3f,
        si: mi.SurfaceInteraction3f,
        active: mi.Bool,
    ) -> tuple[mi.Float, Spot]:
        """Light along the ray that had two vertices, one at least in the water; a lit spot."""
        end = dr.select(si.is_valid(), dr.minimum(si.t, self.far), self.far)
        beam = drawn_beam(sheet, sampler, ray(end), ray.time, active)
        spot = self._spot(scene, sheet, beam, ray.time, active)
        light = (
            self._surface_water(scene, sheet, sampler, ray, si, beam, active)
            + self._water_surface(scene, sampler, ray, end, spot, active)
            + self._water_water(scene, sheet, sampler, ray, si, end, beam, active)
        )
        return light, spot

    def _spot(
        self,
        scene: mi.Scene,
        sheet: LaserSheet,
        beam: Beam,
        time: mi.Float,
        active: mi.Bool,
    ) -> Spot:
        """Where the beam, as wide as where the sheet's middle meets a surface, meets one."""
        apex = sheet.apex(time)
        middle = sheet.direction(beam.phi)
        unit = self._unit_slope(scene, sheet, apex, middle, time, active)
        towards = dr.normalize(middle + sheet.normal * (unit * beam.lateral))
        si = scene.ray_intersect(mi.Ray3f(apex, towards, time, []), active)
        density = ray_density(beam.density / unit, sheet.normal, towards)
        facing = dr.abs(dr.dot(si.n, towards))
        loss = dr.exp(-self.extinction * si.t)
        flux = sheet.irradiance(si.p, time) * dr.square(si.t) / density * loss
        valid = active & si.is_valid() & (facing > 1e-6) & (density > 0) & (flux > 0)
        return Spot(
            si=si,
            to_apex=-towards,
            flux=dr.select(valid, flux / facing, 0.0),
            density=dr.select(valid, density * facing / dr.square(si.t), 0.0),
            valid=valid,
        )

    def _unit_slope(
        self,
        scene: mi.Scene,
        sheet: LaserSheet,
        apex: mi.Point3f,
        middle: mi.Vector3f,
        time: mi.Float,
        active: mi.Bool,
    ) -> mi.Float:
        """The sheet's standard deviation where its middle meets a surface, over rho there."""
        length = dr.norm(middle)
        ray = mi.Ray3f(apex, middle / length, time, [])
        hit = scene.ray_intersect_preliminary(ray, coherent=False, active=active)
        waist = dr.maximum(dr.abs(sheet.waist_distance), 100.0)
        rho = dr.select(hit.is_valid(), hit.t / length, waist)
        return 0.5 * sheet.half_width(rho) / rho

    def _found(
        self,
        scene: mi.Scene,
        sheet: LaserSheet,
        ray: mi.Ray3f,
        si: mi.SurfaceInteraction3f,
        turned: mi.Float,
        active: mi.Bool,
    ) -> mi.Float:
        """Interreflection, found by a ray that left a surface and meets the line by chance.

        turned: the density of its direction.
        """
        possible = active & (turned > 0) & si.is_valid()
        possible &= sheet.irradiance(si.p, ray.time) > 0
        light = direct_light(scene, sheet, self.extinction, si, possible)
        possible &= light > 0
        chance = turned * dr.abs(dr.dot(si.n, ray.d)) / dr.square(si.t)

        apex = sheet.apex(ray.time)
        phi, rho, s = sheet.coordinates(si.p, ray.time)
        unit = self._unit_slope(scene, sheet, apex, sheet.direction(phi), ray.time, possible)
        towards = si.p - apex
        distance = dr.norm(towards)
        towards /= distance
        beam = beam_density(sheet, ray.o, ray.time).density(phi, s / (rho * unit))
        density = ray_density(beam / unit, sheet.normal, towards)
        drawn = density * dr.abs(dr.dot(si.n, towards)) / dr.square(distance)
        return dr.select(possible, light * _power_heuristic(chance, REFLECTIONS * drawn), 0.0)

    def _surface_surface(
        self,
        scene: mi.Scene,
        ray: mi.Ray3f,
        si: mi.SurfaceInteraction3f,
        spot: Spot,
        aimed: mi.Float,
        active: mi.Bool,
    ) -> mi.Float:
        """Interreflection: laser - line - surface - ray."""
        lit = active & si.is_valid() & spot.valid
        offset = spot.si.p - si.p
        distance = dr.norm(offset)
        towards = offset / distance
        context, outgoing = mi.BSDFContext(), si.to_local(towards)
        reflected, pdf = si.bsdf().eval_pdf(context, si, outgoing, lit)
        lit &= (reflected.x > 0) & (distance > 0)
        light = _reflected(spot, -towards, lit)
        lit &= light > 0
        lit &= ~scene.ray_test(si.spawn_ray_to(spot.si.p), lit)
        loss = dr.exp(-self.extinction * (si.t + distance))
        value = reflected.x * light * loss / dr.square(distance)
        cosine = dr.abs(dr.dot(spot.si.n, towards))
        turn = self._turn_density(pdf, self._to_apex(si.p, ray.time), towards, aimed)
        chance = turn * dr.exp(-self.extinction * si.t) * cosine / dr.square(distance)
        return dr.select(lit, value * _power_heuristic(REFLECTIONS * spot.density, chance), 0.0)

    def _surface_water(
        self,
        scene: mi.Scene,
        sheet: LaserSheet,
        sampler: mi.Sampler,
        ray: mi.Ray3f,
        si: mi.SurfaceInteraction3f,
        beam: Beam,
        active: mi.Bool,
    ) -> mi.Float:
        """Light scattered onto the target: laser - water - surface - ray."""
        lit = active & si.is_valid() & (beam.power > 0)
        origin, direction, stretch = self._laser_line(sheet, beam, si.p, ray.time)
        near = approach(self.phase, origin, direction, self.far, si.p)
        place = near.sample(self.phase, sampler.next_1d(active))
        lit &= (place > 0) & (place < self.far)
        light, point = self._source(scene, sheet, beam, place * stretch, si.p, ray.time, si.t, lit)
        towards = dr.normalize(point - si.p)
        reflected = si.bsdf().eval(mi.BSDFContext(), si, si.to_local(towards), lit)
        lit &= (reflected.x > 0) & (light > 0)
        lit &= ~scene.ray_test(si.spawn_ray_to(point), lit)
        density = near.density(self.phase, place)
        return dr.select(lit, light * reflected.x * stretch / density, 0.0)

    def _water_surface(
        self,
        scene: mi.Scene,
        sampler: mi.Sampler,
        ray: mi.Ray3f,
        end: mi.Float,
        spot: Spot,
        active: mi.Bool,
    ) -> mi.Float:
        """The halo about the line: laser - line - water - ray."""
        near = approach(self.phase, ray.o, ray.d, end, spot.si.p)
        t = near.sample(self.phase, sampler.next_1d(active))
        lit = active & spot.valid & (t > 0) & (t < end)
        point = ray(t)
        offset = point - spot.si.p
        distance = dr.norm(offset)
        outgoing = offset / distance
        light = _reflected(spot, outgoing, lit)
        lit &= light > 0
        lit &= ~scene.ray_test(spot.si.spawn_ray_to(point), lit)
        phase = self.phase.value(angle_between(outgoing, -ray.d))
        loss = dr.exp(-self.extinction * (t + distance))
        value = self.scattering * phase * light * loss / dr.square(distance)
        return dr.select(lit, value / near.density(self.phase, t), 0.0)

    def _water_water(
        self,
        scene: mi.Scene,
        sheet: LaserSheet,
        sampler: mi.Sampler,
        ray: mi.Ray3f,
        si: mi.SurfaceInteraction3f,
        end: mi.Float,
        beam: Beam,
        active: mi.Bool,
    ) -> mi.Float:
        """The veil's blur: laser - water - water - ray, either vertex drawn from the other."""
        apex = sheet.apex(ray.time)
        middle = dr.normalize(sheet.direction(beam.phi))
        _, foot, _ = _closest(ray.o, ray.d, apex, middle)
        place = apex + middle * dr.clip(foot, 0, self.far)
        origin, direction, stretch = self._laser_line(sheet, beam, place, ray.time)
        t_near, l_near, gap = _closest(ray.o, ray.d, origin, direction)
        on_ray = line_density(t_near, gap, end)
        on_laser = line_density(l_near, gap, self.far)

        first = sampler.next_1d(active) < 0.5
        sample = sampler.next_1d(active)
        t, place = on_ray.sample(sample), on_laser.sample(sample)
        sample = sampler.next_1d(active)
        # The other vertex, about the first one.
        start = mi.Point3f(dr.select(first, origin, ray.o))
        along = mi.Vector3f(dr.select(first, direction, ray.d))
        about = mi.Point3f(dr.select(first, ray(t), origin + direction * place))
        other = approach(self.phase, start, along, dr.select(first, self.far, end), about)
        drawn = other.sample(self.phase, sample)
        t, place = dr.select(first, t, drawn), dr.select(first, drawn, place)

        lit = active & (beam.power > 0) & (t > 0) & (t < end) & (place > 0) & (place < self.far)
        point = ray(t)
        light, source = self._source(scene, sheet, beam, place * stretch, point, ray.time, t, lit)
        offset = point - source
        distance = dr.norm(offset)
        outgoing = offset / distance
        lit &= light > 0
        lit &= ~scene.ray_test(_segment(source, outgoing, distance, ray.time), lit)
        phase = self.phase.value(angle_between(outgoing, -ray.d))

        from_ray = approach(self.phase, origin, direction, self.far, point)
        from_laser = approach(self.phase, ray.o, ray.d, end, origin + direction * place)
        density = 0.5 * (
            on_ray.density(t) * from_ray.density(self.phase, place)
            + on_laser.density(place) * from_laser.density(self.phase, t)
        )
        value = light * self.scattering * phase * stretch
        return dr.select(lit & (density > 0), value / density, 0.0)

    def _laser_line(
        self, sheet: LaserSheet, beam: Beam, about: mi.Point3f, time: mi.Float
    ) -> tuple[mi.Point3f, mi.Vector3f, mi.Float]:
        """The beam as a straight line, displaced as it is nearest to ``about``.

        Its origin, its unit direction, and rho per mm along it.
        """
        middle = sheet.direction(beam.phi)
        stretch = dr.rcp(dr.norm(middle))
        direction = middle * stretch
        apex = sheet.apex(time)
        rho = dr.maximum(dr.dot(about - apex, direction) * stretch, 0)
        aside = sheet.normal * (beam.lateral * 0.5 * sheet.half_width(rho))
        return apex + aside, direction, stretch

    def _source(
        self,
        scene: mi.Scene,
        sheet: LaserSheet,
        beam: Beam,
        rho: mi.Float,
        target: mi.Point3f,
        time: mi.Float,
        beyond: mi.Float,
        active: mi.Bool,
    ) -> tuple[mi.Float, mi.Point3f]:
        """Light the beam scatters at ``rho`` towards ``target``, and the point of the water.

        Per mm of rho, over the squared distance, with the loss from the apex to ``target``
        and ``beyond`` mm more.
        """
        aside = beam.lateral * 0.5 * sheet.half_width(rho)
        apex = sheet.apex(time)
        point = apex + sheet.direction(beam.phi) * rho + sheet.normal * aside
        incoming = point - apex
        depth = dr.norm(incoming)
        incoming /= depth
        offset = target - point
        distance = dr.norm(offset)
        phase = self.phase.value(angle_between(incoming, offset / distance))
        lit = active & (distance > 0) & (depth > 0)
        lit &= ~scene.ray_test(_segment(apex, incoming, depth, time), lit)
        loss = dr.exp(-self.extinction * (depth + distance + beyond))
        light = beam.power * self.scattering * phase * loss / dr.square(distance)
        return dr.select(lit, light, 0.0), point

    @dr.syntax
    def _ambient(
        self, scene: mi.Scene, sampler: mi.Sampler, ray: mi.Ray3f, active: mi.Bool
    ) -> mi.Float:
        """Ambient light that met more than one surface.

        Along each leg the water dims it and adds b/c L (1 - exp(-c t)), as in the first order.
        """
        total, weight = mi.Float(0), mi.Float(1)
        albedo = self.scattering / dr.maximum(self.extinction, 1e-20)
        step = mi.UInt32(0)
        active = mi.Bool(active)
        while active:
            si = scene.ray_intersect(ray, active)
            hit = si.is_valid()
            reached = dr.select(hit, dr.exp(-self.extinction * si.t), 0.0)
            # The first leg's water and an open second leg are the other integrator's.
            open_sky = dr.select(step > 1, 1.0, 0.0)
            veil = dr.select(step > 0, albedo * (1 - reached), 0.0)
            total += weight * dr.select(hit, veil, open_sky)
            bs, value = si.bsdf().sample(
                mi.BSDFContext(), si, sampler.next_1d(active), sampler.next_2d(active), active
            )
            weight *= value.x * reached
            survival = dr.select(step < 4, 1.0, dr.minimum(weight, SURVIVAL))
            active &= hit & (sampler.next_1d(active) < survival) & (step < LONGEST_WALK)
            weight /= dr.maximum(survival, 1e-12)
            onward = si.spawn_ray(si.to_world(bs.wo))
            ray.o, ray.d = onward.o, onward.d
            step += 1
        return total * self.ambient_radiance


def _power_heuristic(mine: mi.Float, other: mi.Float) -> mi.Float:
    """Weight of a sample that could have been drawn in two ways (Veach 1997, sec. 9.2)."""
    ratio = other / dr.maximum(mine, 1e-30)
    return dr.select(mine > 0, 1 / (1 + dr.square(ratio)), 0.0)


def _reflected(spot: Spot, outgoing: mi.Vector3f, active: mi.Bool) -> mi.Float:
    """mW/sr that the spot sends along ``outgoing``.

    The BSDF is asked in the camera's sense, as stock integrators do, whose shading normals
    count towards the laser.
    """
    si = mi.SurfaceInteraction3f(spot.si)
    si.wi = si.to_local(outgoing)
    value = si.bsdf().eval(mi.BSDFContext(), si, si.to_local(spot.to_apex), active)
    return value.x * dr.abs(dr.dot(si.n, outgoing)) * spot.flux


def _closest(
    o: mi.Point3f, d: mi.Vector3f, p: mi.Point3f, e: mi.Vector3f
) -> tuple[mi.Float, mi.Float, mi.Float]:
    """Where two lines are closest: mm along each, and their gap over the sine between them."""
    w = o - p
    b, along, across = dr.dot(d, e), dr.dot(d, w), dr.dot(e, w)
    squared = dr.maximum(1 - dr.square(b), 1e-6)
    t, u = (b * across - along) / squared, (across - b * along) / squared
    gap = dr.norm(w + d * t - e * u)
    return t, u, gap * dr.rsqrt(squared)


def _segment(start: mi.Point3f, towards: mi.Vector3f, length: mi.Float, time: mi.Float) -> mi.Ray3f:
    return mi.Ray3f(start, towards, length, time, [])


mi.register_integrator("multiple", MultipleIntegrator)
