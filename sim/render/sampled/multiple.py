"""The integrator plugin for light of all higher orders: two and more surfaces or places of water.

Paths are partitioned by their order, the number of their vertices between laser and camera.
The last two vertices are drawn together (sim.render.sampled.multiple).  Paths of three and more
orders are walks from the camera that end in such a pair at every step; a walk turns as surface
and water scatter, or towards the apex or the line, from where most of the light comes.
"""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from sim.render.plugins.sheet import LaserSheet
from sim.render.plugins.water import angle_between, approach
from sim.render.sampled.beams import Beam, beam_density, drawn_beam, line_density, straight_rays
from sim.render.sampled.integrator import Leg, WaterIntegrator

# Light of two vertices, the last two before the camera: each way in which they can be drawn.
#
# x, on the ray at hand, and y, where the laser's light first turns, are drawn together, because a
# chance ray never meets a thin sheet or its line:
#
#     x on a surface, y on a surface   interreflection
#     x on a surface, y in the water   light scattered onto the target
#     x in the water, y on a surface   the halo about the line
#     x in the water, y in the water   the veil's own blur
#
# A ray of the laser is drawn near the ray at hand (sim.render.sampled.beams); places in the water
# are drawn by the angle of scattering (sim.render.plugins.water), from the surface's point or, in
# the last family, from each other, in either order, weighted by the balance heuristic (Veach 1997,
# sec. 9.2).  Interreflection is weighted against the surface's own sampling by the power heuristic,
# for light that meets a surface near a corner.


# Shares of a walk's first turns that are drawn about the direction to the apex, and to the
# line: what is not drawn so weighs the more, by 1 / (1 - both) a turn.
TO_APEX, TO_LINE = 0.25, 0.35
REFLECTIONS = 4  # rays of the laser that look for interreflection at each step of a walk


@dataclass(frozen=True)
class Spot:
    """Where a ray of the laser meets a surface.

    to_laser: where its light comes from.  flux: mW that arrive there per unit of the ray's
    density, after the water's loss, over the cosine.  density: probability per mm2 of drawing
    the point.
    """

    si: mi.SurfaceInteraction3f
    to_laser: mi.Vector3f
    flux: mi.Float
    density: mi.Float
    valid: mi.Bool

    def sent(self, outgoing: mi.Vector3f, active: mi.Bool) -> mi.Float:
        """mW/sr that the spot sends along ``outgoing``.

        The BSDF is asked in the camera's sense, as stock integrators do, whose shading normals
        count towards the laser.
        """
        si = mi.SurfaceInteraction3f(self.si)
        si.wi = si.to_local(outgoing)
        value = si.bsdf().eval(mi.BSDFContext(), si, si.to_local(self.to_laser), active)
        return value.x * dr.abs(dr.dot(si.n, outgoing)) * self.flux


class PairIntegrator(WaterIntegrator):
    """The estimators of all pairs of vertices, for a walk that connects at each step."""

    def in_water(self, leg: Leg, sheet: LaserSheet) -> tuple[mi.Float, Spot]:
        """Light along the ray that had two vertices, one at least in the water; a lit spot."""
        ray, si = leg.ray, leg.si
        end = dr.select(si.is_valid(), dr.minimum(si.t, self.far), self.far)
        beam = drawn_beam(sheet, leg.sampler, ray(end), ray.time, leg.active)
        spot = self.spot(leg, sheet, beam, leg.active)
        light = (
            self.surface_water(leg, sheet, beam)
            + self._water_surface(leg, end, spot)
            + self._water_water(leg, sheet, end, beam)
        )
        return light, spot

    def spot(self, leg: Leg, sheet: LaserSheet, beam: Beam, active: mi.Bool) -> Spot:
        """Where the beam, straight to where the sheet's middle meets a surface, meets one."""
        time = leg.ray.time
        straight = straight_rays(leg.scene, sheet, beam.phi, time, active)
        origin, along = straight.line(beam.lateral)
        stretch = dr.rcp(dr.norm(along))
        si = leg.scene.ray_intersect(mi.Ray3f(origin, along * stretch, time, []), active)
        density = beam.density / straight.area(si.t * stretch, along, si.n)
        loss = dr.exp(-self.extinction * si.t)
        flux = sheet.irradiance(si.p, time) / density * loss
        valid = active & si.is_valid() & (density > 0) & dr.isfinite(density) & (flux > 0)
        to_source, _ = sheet.arrival(si.p, time)
        return Spot(
            si=si,
            to_laser=-to_source,
            flux=dr.select(valid, flux, 0.0),
            density=dr.select(valid, density, 0.0),
            valid=valid,
        )

    def found(self, leg: Leg, sheet: LaserSheet, turned: mi.Float) -> mi.Float:
        """Interreflection, found by a ray that left a surface and meets the line by chance.

        turned: the density of its direction.
        """
        ray, si = leg.ray, leg.si
        possible = leg.active & (turned > 0) & si.is_valid()
        possible &= sheet.irradiance(si.p, ray.time) > 0
        light = self.direct(Leg(leg.scene, leg.sampler, ray, si, possible), sheet)
        possible &= light > 0
        chance = turned * dr.abs(dr.dot(si.n, ray.d)) / dr.square(si.t)

        phi, rho, s = sheet.coordinates(si.p, ray.time)
        straight = straight_rays(leg.scene, sheet, phi, ray.time, possible)
        lateral = s / straight.unit(rho)
        _, along = straight.line(lateral)
        beam = beam_density(sheet, ray.o, ray.time).density(phi, lateral)
        drawn = beam / straight.area(rho, along, si.n)
        drawn = dr.select(dr.isfinite(drawn), drawn, 0.0)
        return dr.select(possible, light * _power_heuristic(chance, REFLECTIONS * drawn), 0.0)

    def surface_surface(self, leg: Leg, spot: Spot, aimed: mi.Float) -> mi.Float:
        """Interreflection: laser - line - surface - ray."""
        ray, si = leg.ray, leg.si
        lit = leg.active & si.is_valid() & spot.valid
        offset = spot.si.p - si.p
        distance = dr.norm(offset)
        towards = offset / distance
        context, outgoing = mi.BSDFContext(), si.to_local(towards)
        reflected, pdf = si.bsdf().eval_pdf(context, si, outgoing, lit)
        lit &= (reflected.x > 0) & (distance > 0)
        light = spot.sent(-towards, lit)
        lit &= light > 0
        lit &= ~leg.scene.ray_test(si.spawn_ray_to(spot.si.p), lit)
        loss = dr.exp(-self.extinction * (si.t + distance))
        value = reflected.x * light * loss / dr.square(distance)
        cosine = dr.abs(dr.dot(spot.si.n, towards))
        turn = self.turn_density(pdf, self.to_apex(si.p, ray.time), towards, aimed)
        chance = turn * dr.exp(-self.extinction * si.t) * cosine / dr.square(distance)
        return dr.select(lit, value * _power_heuristic(REFLECTIONS * spot.density, chance), 0.0)

    def to_apex(self, point: mi.Point3f, time: mi.Float) -> mi.Vector3f:
        """Unit direction to the apex, which is one for all sheets."""
        return dr.normalize(self.sheets[0].apex(time) - point)

    def turn_density(
        self, scattering: mi.Float, to_apex: mi.Vector3f, onward: mi.Vector3f, aimed: mi.Float
    ) -> mi.Float:
        """Density per steradian of a walk's turns, but for those that aim at the line.

        The heuristic that weighs interreflection needs one that knows of no point aimed at.
        """
        if not self.has_water:
            return scattering
        lobe = self.phase.direction_density(angle_between(to_apex, onward))
        return (1 - aimed * (TO_APEX + TO_LINE)) * scattering + aimed * TO_APEX * lobe

    def surface_water(self, leg: Leg, sheet: LaserSheet, beam: Beam) -> mi.Float:
        """Light scattered onto the target: laser - water - surface - ray."""
        si, time = leg.si, leg.ray.time
        lit = leg.active & si.is_valid() & (beam.power > 0)
        origin, direction, stretch = self._laser_line(sheet, beam, si.p, time)
        near = approach(self.phase, origin, direction, self.far, si.p)
        place = near.sample(self.phase, leg.sampler.next_1d(leg.active))
        lit &= (place > 0) & (place < self.far)
        light, point = self._source(leg, sheet, beam, place * stretch, si.p, si.t, lit)
        towards = dr.normalize(point - si.p)
        reflected = si.bsdf().eval(mi.BSDFContext(), si, si.to_local(towards), lit)
        lit &= (reflected.x > 0) & (light > 0)
        lit &= ~leg.scene.ray_test(si.spawn_ray_to(point), lit)
        density = near.density(self.phase, place)
        return dr.select(lit, light * reflected.x * stretch / density, 0.0)

    def _water_surface(self, leg: Leg, end: mi.Float, spot: Spot) -> mi.Float:
        """The halo about the line: laser - line - water - ray."""
        ray = leg.ray
        near = approach(self.phase, ray.o, ray.d, end, spot.si.p)
        t = near.sample(self.phase, leg.sampler.next_1d(leg.active))
        lit = leg.active & spot.valid & (t > 0) & (t < end)
        point = ray(t)
        offset = point - spot.si.p
        distance = dr.norm(offset)
        outgoing = offset / distance
        light = spot.sent(outgoing, lit)
        lit &= light > 0
        lit &= ~leg.scene.ray_test(spot.si.spawn_ray_to(point), lit)
        phase = self.phase.value(angle_between(outgoing, -ray.d))
        loss = dr.exp(-self.extinction * (t + distance))
        value = self.scattering * phase * light * loss / dr.square(distance)
        return dr.select(lit, value / near.density(self.phase, t), 0.0)

    def _water_water(self, leg: Leg, sheet: LaserSheet, end: mi.Float, beam: Beam) -> mi.Float:
        """The veil's blur: laser - water - water - ray, either vertex drawn from the other."""
        ray, sampler = leg.ray, leg.sampler
        apex = sheet.apex(ray.time)
        middle = dr.normalize(sheet.direction(beam.phi))
        _, foot, _ = _closest(ray.o, ray.d, apex, middle)
        place = apex + middle * dr.clip(foot, 0, self.far)
        origin, direction, stretch = self._laser_line(sheet, beam, place, ray.time)
        t_near, l_near, gap = _closest(ray.o, ray.d, origin, direction)
        on_ray = line_density(t_near, gap, end)
        on_laser = line_density(l_near, gap, self.far)

        first = sampler.next_1d(leg.active) < 0.5
        sample = sampler.next_1d(leg.active)
        t, place = on_ray.sample(sample), on_laser.sample(sample)
        sample = sampler.next_1d(leg.active)
        # The other vertex, about the first one.
        start = mi.Point3f(dr.select(first, origin, ray.o))
        along = mi.Vector3f(dr.select(first, direction, ray.d))
        about = mi.Point3f(dr.select(first, ray(t), origin + direction * place))
        other = approach(self.phase, start, along, dr.select(first, self.far, end), about)
        drawn = other.sample(self.phase, sample)
        t, place = dr.select(first, t, drawn), dr.select(first, drawn, place)

        lit = leg.active & (beam.power > 0)
        lit &= (t > 0) & (t < end) & (place > 0) & (place < self.far)
        point = ray(t)
        light, source = self._source(leg, sheet, beam, place * stretch, point, t, lit)
        offset = point - source
        distance = dr.norm(offset)
        outgoing = offset / distance
        lit &= light > 0
        lit &= ~leg.scene.ray_test(mi.Ray3f(source, outgoing, distance, ray.time, []), lit)
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
        """The beam as a straight line, its tangent where it is nearest to ``about``.

        Its origin, where rho is 0, its unit direction, and rho per mm along it.
        """
        middle, apex = sheet.direction(beam.phi), sheet.apex(time)
        rho = dr.maximum(dr.dot(about - apex, middle) / dr.squared_norm(middle), 0)
        aside = beam.lateral * 0.5 * sheet.half_width(rho)
        slope = aside * sheet.curvature(rho)
        along = middle + sheet.normal * slope
        stretch = dr.rcp(dr.norm(along))
        return apex + sheet.normal * (aside - slope * rho), along * stretch, stretch

    def _source(
        self,
        leg: Leg,
        sheet: LaserSheet,
        beam: Beam,
        rho: mi.Float,
        target: mi.Point3f,
        beyond: mi.Float,
        active: mi.Bool,
    ) -> tuple[mi.Float, mi.Point3f]:
        """Light the beam scatters at ``rho`` towards ``target``, and the point of the water.

        Per mm of rho, over the squared distance, with the loss from the laser to ``target`` and
        ``beyond`` mm more.
        """
        time = leg.ray.time
        aside = beam.lateral * 0.5 * sheet.half_width(rho)
        point = sheet.apex(time) + sheet.direction(beam.phi) * rho + sheet.normal * aside
        incoming, source = sheet.ray_through(beam.phi, rho, aside, time)
        way = point - source
        depth = dr.norm(way)
        offset = target - point
        distance = dr.norm(offset)
        phase = self.phase.value(angle_between(incoming, offset / distance))
        lit = active & (distance > 0) & (depth > 0)
        lit &= ~leg.scene.ray_test(mi.Ray3f(source, way / depth, depth, time, []), lit)
        loss = dr.exp(-self.extinction * (depth + distance + beyond))
        light = beam.power * self.scattering * phase * loss / dr.square(distance)
        return dr.select(lit, light, 0.0), point


def _power_heuristic(mine: mi.Float, other: mi.Float) -> mi.Float:
    """Weight of a sample that could have been drawn in two ways (Veach 1997, sec. 9.2)."""
    ratio = other / dr.maximum(mine, 1e-30)
    return dr.select(mine > 0, 1 / (1 + dr.square(ratio)), 0.0)


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


# The integrator plugin for light of all higher orders: two and more surfaces or places of water.


# What is left at later turns of the shares that are drawn about apex and line: their weight
# would grow beyond bounds over the many turns in turbid water.
LATER = 0.15
SURVIVAL = 0.95  # of a walk whose weight has not fallen
LONGEST_WALK = 256


class MultipleIntegrator(PairIntegrator):
    """Laser light of the second and all higher orders, and ambient light's interreflection."""

    layers = ("scattered", "ambient")

    def light(
        self, scene: mi.Scene, sampler: mi.Sampler, ray: mi.Ray3f, active: mi.Bool
    ) -> list[mi.Float]:
        """Radiance along the ray of each layer."""
        laser, ambient = mi.Float(0), mi.Float(0)
        if self.sheets:
            laser = self._walk(scene, sampler, mi.Ray3f(ray), active)
        if self.has_ambient:
            ambient = self._ambient(scene, sampler, mi.Ray3f(ray), active)
        return [laser, ambient]

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
            arrived = Leg(scene, sampler, ray, si, mi.Bool(active))
            for sheet in self.sheets:
                total += weight * self.found(arrived, sheet, turned)
            # Russian roulette, which leaves the mean as it is.
            survival = dr.select(step == 0, 1.0, dr.minimum(weight, SURVIVAL))
            active &= sampler.next_1d(active) < survival
            weight /= dr.maximum(survival, 1e-12)
            leg = Leg(scene, sampler, ray, si, mi.Bool(active))
            aimed = dr.select(step == 0, mi.Float(1), LATER)
            total += weight * self._reflections(leg, aimed)
            aim = self.sheets[0].apex(ray.time)
            if self.has_water:
                for number, sheet in enumerate(self.sheets):
                    light, spot = self.in_water(leg, sheet)
                    total += weight * light
                    # The spot of any of the sheets, each as likely.
                    chosen = spot.valid & (sampler.next_1d(active) < 1 / (number + 1))
                    aim = dr.select(chosen, spot.si.p, aim)

            # The next vertex: in the water with the odds of its loss, else on the surface.
            free = -dr.log(1 - sampler.next_1d(active)) / dr.maximum(self.extinction, 1e-20)
            in_water = active & (free < si.t) & mi.Bool(self.has_water)
            on_surface = active & ~in_water & si.is_valid()
            vertex = dr.select(in_water, ray(free), si.p)
            onward, worth, density = self._turn(leg, vertex, aim, aimed, in_water, on_surface)
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
    def _reflections(self, leg: Leg, aimed: mi.Float) -> mi.Float:
        """Interreflection: the mean over several rays of the laser.

        In a valley a ray of the laser finds the opposite side or does not, so one is noisy;
        the line would be read wrong by chance.
        """
        total = mi.Float(0)
        count = mi.UInt32(0)
        seen = leg.active & leg.si.is_valid()
        while count < REFLECTIONS:
            for sheet in self.sheets:
                beam = drawn_beam(sheet, leg.sampler, leg.si.p, leg.ray.time, seen)
                spot = self.spot(leg, sheet, beam, seen)
                total += self.surface_surface(leg, spot, aimed)
            count += 1
        return total / REFLECTIONS

    def _turn(
        self,
        leg: Leg,
        vertex: mi.Point3f,
        aim: mi.Point3f,
        aimed: mi.Float,
        in_water: mi.Bool,
        on_surface: mi.Bool,
    ) -> tuple[mi.Vector3f, mi.Float, mi.Float]:
        """Where a walk goes from a vertex: the direction, its weight and its ``turn_density``.

        Either as water or surface scatter, or scattered from the direction to the apex or to
        ``aim``, a point of the line: light that was turned a little on its way from there is
        hardly found otherwise.  aimed: what factor the shares of such turns have.
        """
        ray, si, sampler = leg.ray, leg.si, leg.sampler
        active = in_water | on_surface
        to_apex = self.to_apex(vertex, ray.time)
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
        without_aim = self.turn_density(own, to_apex, onward, aimed)
        density = without_aim
        if self.has_water:
            lobe = self.phase.direction_density(angle_between(to_aim, onward))
            density = without_aim + aimed * TO_LINE * lobe
        return onward, dr.select(density > 0, worth / density, 0.0), without_aim

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


mi.register_integrator("multiple", MultipleIntegrator)
