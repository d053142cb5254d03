"""What the integrators of the first and of all higher orders share: water, sheets, layers."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import drjit as dr
import mitsuba as mi

from sim.render.plugins.beams import FARTHEST_MM
from sim.render.plugins.opaque import opaque, opaque_vector
from sim.render.plugins.phase import PhaseTable
from sim.render.plugins.sheet import LaserSheet
from sim.scene.matter import AmbientLight
from sim.water import Optics

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
