"""The integrator plugin for light of the first order, without hit or miss.

The picture is a sum of parts, each an estimator of its own path family with analytic
transmittance: ``direct`` (apex - surface - camera), ``scattered`` (apex - water - camera, the
veil), ``ambient``.  They are kept apart as layers.  Light that meets more surfaces or more
places of the water is the other integrator's (sim.render.sampled.multiple): paths are partitioned
by their order, so the two pictures add up.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import pi, sqrt
from typing import ClassVar

import drjit as dr
import mitsuba as mi

from sim.render.ambient import AmbientField, OpenSky, reflectance
from sim.render.plugins.arrays import opaque, opaque_vector
from sim.render.plugins.sheet import LaserSheet
from sim.render.plugins.water import PhaseTable, angle_between
from sim.render.sampled.beams import FARTHEST_MM
from sim.scene.matter import AmbientLight
from sim.water import Optics

# What the integrators of the first and of all higher orders share: water, sheets, layers.


MM_PER_M = 1000.0
FAR_OPTICAL_DEPTH = 25.0  # what lies deeper is dimmer by 1e-11


@dataclass
class Leg:
    """One leg of a path from the camera: a ray and the surface it meets, if any.

    Not frozen, for Dr.Jit's loops put their variables back in place.
    """

    scene: mi.Scene
    sampler: mi.Sampler
    ray: mi.Ray3f
    si: mi.SurfaceInteraction3f
    active: mi.Bool


class WaterIntegrator(mi.SamplingIntegrator):
    """Laser light and ambient light in water; configured with ``configure``.

    Radiances are in mW/(mm2 sr) just inside the water, times the camera's weight.
    """

    layers: ClassVar[tuple[str, ...]]

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.sheets: Sequence[LaserSheet] = ()

    def configure(
        self,
        water: Optics,
        sheets: Sequence[LaserSheet],
        ambient_mw_mm2_sr: float,
        light: AmbientLight | None = None,
    ) -> None:
        """Set the water, the laser's sheets (none: off), the ambient radiance, and how even it is.

        light: its gradient and shadow; even if None.
        """
        self.sheets = tuple(sheets)
        self.extinction = opaque(water.extinction_per_mm)
        self.scattering = opaque(water.scattering_per_mm)
        self.has_water = water.scattering_per_mm > 0
        depth_mm = FAR_OPTICAL_DEPTH / max(water.extinction_per_mm, 1e-20)
        self.far = opaque(min(FARTHEST_MM, depth_mm))
        self.phase = PhaseTable(water.phase)
        self.has_ambient = ambient_mw_mm2_sr > 0
        self.ambient_radiance = opaque(ambient_mw_mm2_sr)
        self.penumbra = light.penumbra if light else None
        self.is_even = light is None or not any(light.gradient_per_m)
        if light is not None and not self.is_even:
            self.gradient = opaque_vector(g / MM_PER_M for g in light.gradient_per_m)
            self.middle = opaque_vector(light.centre_mm)

    def aov_names(self) -> list[str]:
        """One channel a layer, after the sum's own."""
        return list(self.layers)

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
        light = self.light(scene, sampler, mi.Ray3f(ray), active)
        return mi.Spectrum(sum(light[1:], light[0])), active, light

    def light(
        self, scene: mi.Scene, sampler: mi.Sampler, ray: mi.Ray3f, active: mi.Bool
    ) -> list[mi.Float]:
        """Radiance along the ray of each of ``layers``."""
        raise NotImplementedError

    def direct(self, leg: Leg, sheet: LaserSheet) -> mi.Float:
        """Laser to surface to ray: one shadow ray, transmittance along both legs."""
        si, scene = leg.si, leg.scene
        lit = leg.active & si.is_valid()
        ds, irradiance = sheet.sample_direction(si, mi.Point2f(0), lit)
        lit &= irradiance.x > 0
        lit &= ~scene.ray_test(si.spawn_ray_to(ds.p), lit)
        reflected = si.bsdf().eval(mi.BSDFContext(), si, si.to_local(ds.d), lit)
        loss = dr.exp(-self.extinction * (ds.dist + si.t))
        return dr.select(lit, reflected.x * irradiance.x * loss, 0.0)


# The integrator plugin for light of the first order, without hit or miss.


NEWTON_STEPS = 3  # a bow is a small deviation from a plane, whose crossing is the start
NEWTON_REACH_MM = 0.5
LEAST_SLOPE = 1e-6  # a ray along the sheet crosses it somewhere: 0.01 mm over 10 m


class SheetIntegrator(WaterIntegrator):
    """Direct light, single scattering and ambient light."""

    layers = ("direct", "scattered", "ambient")

    def __init__(self, props: mi.Properties) -> None:
        """Draw directions of the sky at random, until ``light_by`` says otherwise.

        Parameters
        ----------
        props : Properties, of the plugin
        """
        super().__init__(props)
        self.sky: AmbientField | OpenSky | None = None

    def light_by(self, sky: AmbientField | OpenSky, higher: bool) -> None:
        """Take ambient light on surfaces from what is known of it.

        Parameters
        ----------
        sky : AmbientField or OpenSky, of the scene that is rendered, whose surfaces are matt
        higher : bool, whether light by way of other surfaces is counted
        """
        self.sky, self.has_higher = sky, opaque(float(higher))

    def light(
        self, scene: mi.Scene, sampler: mi.Sampler, ray: mi.Ray3f, active: mi.Bool
    ) -> list[mi.Float]:
        """Radiance along the ray of each layer."""
        leg = Leg(scene, sampler, ray, scene.ray_intersect(ray, active), active)
        direct, scattered, ambient = mi.Float(0), mi.Float(0), mi.Float(0)
        for sheet in self.sheets:
            direct += self.direct(leg, sheet)
            if self.has_water:
                scattered += self.scattered(leg, sheet)
        if self.has_ambient:
            ambient = self.ambient(leg)
        return [direct, scattered, ambient]

    def scattered(
        self,
        leg: Leg,
        sheet: LaserSheet,
        least: mi.Float | float = 0.0,
        sample: mi.Float | None = None,
    ) -> mi.Float:
        """Laser to water to camera: the in-scattering point is drawn about the crossing.

        least: rad; light that is turned by no more is left out.  sample: 0 to 1, of the light
        along the ray; random if None.

        Along the ray the sheet is very nearly a Gaussian about the crossing t0 of its middle
        plane, with sigma = w / (2 |d.n|) (docs/explanation/physics.md, section 7).  Drawing t
        from that Gaussian, cut at the surface, leaves an integrand that hardly varies.
        """
        ray, si = leg.ray, leg.si
        end = dr.select(si.is_valid(), si.t, dr.largest(mi.Float))
        crossing, slope = crossing_of(sheet, ray)
        _, rho, _ = sheet.coordinates(ray(crossing), ray.time)
        sigma = sheet.half_width(rho) / (2 * dr.abs(slope))

        low = _normal_cdf(-crossing / sigma)
        share = _normal_cdf((end - crossing) / sigma) - low
        quantile = low + (leg.sampler.next_1d(leg.active) if sample is None else sample) * share
        z = sqrt(2) * dr.erfinv(dr.clip(2 * quantile - 1, -0.9999999, 0.9999999))
        t = crossing + sigma * z
        # The cut tails, below 1e-6 of the sheet's power, are left out.
        valid = leg.active & (share > 1e-6) & (t > 0) & (t < end) & dr.isfinite(t)

        point = ray(t)
        along, source = sheet.arrival(point, ray.time)
        to_source = source - point
        distance = dr.norm(to_source)
        shadow = mi.Ray3f(point, to_source / distance, distance, ray.time, ray.wavelengths)
        valid &= ~leg.scene.ray_test(shadow, valid)

        density = dr.exp(-0.5 * z * z) / (sqrt(2 * pi) * sigma) / share
        angle = angle_between(along, -ray.d)
        valid &= angle > least
        light = self.scattering * self.phase.value(angle) * sheet.irradiance(point, ray.time)
        loss = dr.exp(-self.extinction * (distance + t))
        return dr.select(valid, light * loss / density, 0.0)

    def ambient(self, leg: Leg) -> mi.Float:
        """Uniform ambient light: reflected where the sky is open, and scattered on the way.

        In a field of the same radiance L from every side the water adds
        b/c L (1 - exp(-c t)) along a path of length t.  Where L varies linearly from place to
        place it is that of the place at the light's mean distance, 1/c - t / (exp(c t) - 1).
        """
        si = leg.si
        lit = leg.active & si.is_valid()
        straight, indirect = self._sky_light(leg, lit)
        t = dr.select(si.is_valid(), si.t, dr.largest(mi.Float))
        transmittance = dr.exp(-self.extinction * t)
        arrived = straight * self._unshaded_share(si.p) * self._level(si.p) + indirect
        surface = dr.select(lit, arrived * transmittance, 0.0)
        albedo = dr.select(self.extinction > 0, self.scattering / self.extinction, 0.0)
        veil = albedo * (1 - transmittance)
        if not self.is_even:
            mean = 1 / dr.maximum(self.extinction, 1e-20) - t * transmittance / (1 - transmittance)
            # Where the water takes next to nothing, rounding takes the mean out of its bounds.
            mean = dr.select(mean >= 0, dr.minimum(mean, t / 2), t / 2)
            veil *= self._level(leg.ray(mean))
        light = self.ambient_radiance * (surface + veil)
        return dr.select(leg.active, light, 0.0)

    def _level(self, point: mi.Point3f) -> mi.Float:
        """Ambient light at a point over that in the middle of its gradient."""
        if self.is_even:
            return mi.Float(1)
        return dr.maximum(1 + dr.dot(point - self.middle, self.gradient), 0)

    def _sky_light(self, leg: Leg, lit: mi.Bool) -> tuple[mi.Float, mi.Float]:
        """What surfaces send on of the sky's light: that which comes straight, and the rest.

        From ``sky`` where it is known, else of one random direction, and no rest.
        """
        si, sampler = leg.si, leg.sampler
        if self.sky is not None:
            straight, indirect = self.sky.received(si, lit)
            sent = reflectance(si)
            return sent * straight, sent * indirect * self.has_higher
        bs, weight = si.bsdf().sample(
            mi.BSDFContext(), si, sampler.next_1d(lit), sampler.next_2d(lit), lit
        )
        blocked = leg.scene.ray_test(si.spawn_ray(si.to_world(bs.wo)), lit)
        return dr.select(blocked, 0.0, weight.x), mi.Float(0)

    def _unshaded_share(self, point: mi.Point3f) -> mi.Float:
        """Share of the ambient light that reaches a point of a surface."""
        if (shade := self.penumbra) is None:
            return mi.Float(1)
        into = (point.x - shade.x_mm) * (1 if shade.side == "right" else -1) / shade.width_mm
        return shade.left + (1 - shade.left) * 0.5 * (1 - dr.erf(into / sqrt(2)))


def crossing_of(sheet: LaserSheet, ray: mi.Ray3f) -> tuple[mi.Float, mi.Float]:
    """Where a ray crosses the sheet's middle, mm along it, and its slope against it there.

    Parameters
    ----------
    sheet : LaserSheet, where it is placed
    ray : Ray3f, world frame, mm
    """
    slope = dr.dot(ray.d, sheet.normal)
    slope = dr.select(dr.abs(slope) < LEAST_SLOPE, dr.copysign(mi.Float(LEAST_SLOPE), slope), slope)
    crossing = dr.dot(sheet.apex(ray.time) - ray.o, sheet.normal) / slope
    if not sheet.is_bowed:
        return crossing, slope
    for _ in range(NEWTON_STEPS):
        _, _, here = sheet.coordinates(ray(crossing), ray.time)
        _, _, there = sheet.coordinates(ray(crossing + NEWTON_REACH_MM), ray.time)
        slope = (there - here) / NEWTON_REACH_MM
        crossing -= here / slope
    return crossing, slope


def _normal_cdf(x: mi.Float) -> mi.Float:
    return 0.5 * (1 + dr.erf(x / sqrt(2)))


mi.register_integrator("sheet", SheetIntegrator)
