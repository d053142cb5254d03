"""The integrator plugin for light of all higher orders: two and more surfaces or places of water.

Paths are partitioned by their order, the number of their vertices between laser and camera.
The last two vertices are drawn together (sim.render.plugins.pairs).  Paths of three and more
orders are walks from the camera that end in such a pair at every step; a walk turns as surface
and water scatter, or towards the apex or the line, from where most of the light comes.
"""

import drjit as dr
import mitsuba as mi

from sim.render.plugins.base import Leg
from sim.render.plugins.beams import drawn_beam
from sim.render.plugins.pairs import REFLECTIONS, TO_APEX, TO_LINE, PairIntegrator
from sim.render.plugins.phase import angle_between

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
