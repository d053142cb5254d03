"""The emitter plugin: a Gaussian laser sheet that opens from an apex inside the water.

The laser sits behind a port of its own, but light that reaches a point through two specular
interfaces cannot be found by a path tracer, so the emitter stands on the water side: a delta
position at the apex whose strength at a point is the sheet's irradiance there.  Stock
integrators can connect to it.
"""

from __future__ import annotations

from math import erf, pi, radians, sqrt

import drjit as dr
import mitsuba as mi
import numpy as np

from sim.plugins.opaque import opaque, opaque_vector
from sim.scene import Laser, Pose


class LaserSheet(mi.Emitter):
    """Light of the laser sheet; configured with ``configure``, moved with ``place``."""

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.m_flags = int(mi.EmitterFlags.DeltaPosition)

    def configure(self, laser: Laser, water_index: float) -> None:
        """Set power, fan and beam; every number becomes opaque, so no kernel is recompiled."""
        half_angle = radians(laser.fan_half_angle_deg)
        self.is_gaussian_fan = laser.fan == "gaussian"
        self.power = opaque(laser.power_mw)
        self.half_angle = opaque(half_angle)
        self.fan_peak = opaque(fan_peak_density(laser.fan, half_angle))
        self.waist, self.waist_distance = opaque(laser.waist_mm), opaque(laser.waist_distance_mm)
        self.rayleigh = opaque(rayleigh_length_mm(laser, water_index))
        aim = radians(laser.aim_deg)
        self._head_axes = np.array(
            [
                [np.cos(aim), 0.0, np.sin(aim)],  # across the fan
                [0.0, 1.0, 0.0],  # the sheet's normal
                [np.sin(aim), 0.0, -np.cos(aim)],  # the fan's axis
            ]
        )
        self._head_apex = np.array(laser.apex_mm)

    def place(self, head: Pose) -> None:
        """Move the sheet with the head, whose pose in the world is ``head``."""
        self.apex = mi.Point3f(opaque_vector(head.apply(self._head_apex)))
        axes = self._head_axes @ head.rotation.T
        self.across, self.normal, self.axis = (opaque_vector(axis) for axis in axes)

    def irradiance(self, point: mi.Point3f) -> mi.Float:
        """mW/mm2 on a surface that faces the apex at ``point``, without the water's loss.

        E = P f(phi) / rho * sqrt(2/pi) / w * exp(-2 s2 / w2), physics.md section 4: the fan's
        power per arc of radius rho, spread over the Gaussian of 1/e2 half width w.
        """
        offset = point - self.apex
        lateral, depth = dr.dot(offset, self.across), dr.dot(offset, self.axis)
        rho = dr.sqrt(dr.square(lateral) + dr.square(depth))
        width = self.half_width(rho)
        s = dr.dot(offset, self.normal)
        across = sqrt(2 / pi) / width * dr.exp(-2 * dr.square(s / width))
        return self.power * self._fan_density(dr.atan2(lateral, depth)) / rho * across

    def half_width(self, rho: mi.Float) -> mi.Float:
        """1/e2 half width of the sheet in mm at a distance in mm from the apex."""
        return self.waist * dr.sqrt(1 + dr.square((rho - self.waist_distance) / self.rayleigh))

    def _fan_density(self, phi: mi.Float) -> mi.Float:
        inside = dr.abs(phi) <= self.half_angle
        shape = dr.exp(-2 * dr.square(phi / self.half_angle)) if self.is_gaussian_fan else 1.0
        return dr.select(inside, self.fan_peak * shape, 0.0)

    def sample_direction(
        self, it: mi.Interaction3f, sample: mi.Point2f, active: mi.Bool = True
    ) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
        """The direction to the apex and the sheet's irradiance, a delta position's weight."""
        ds = dr.zeros(mi.DirectionSample3f)
        ds.p = self.apex
        ds.n = mi.Normal3f(self.axis)
        ds.time = it.time
        ds.pdf = 1.0
        ds.delta = True
        ds.emitter = mi.EmitterPtr(self)
        ds.d = self.apex - it.p
        ds.dist = dr.norm(ds.d)
        ds.d /= ds.dist
        return ds, mi.Spectrum(dr.select(active, self.irradiance(it.p), 0.0))

    def pdf_direction(
        self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool = True
    ) -> mi.Float:
        """Zero: a delta position is never hit by chance."""
        return mi.Float(0.0)

    def eval_direction(
        self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool = True
    ) -> mi.Spectrum:
        """The sheet's irradiance at the reference point."""
        return mi.Spectrum(dr.select(active, self.irradiance(it.p), 0.0))

    def eval(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Spectrum:
        """Zero: the emitter has no surface."""
        return mi.Spectrum(0.0)

    def bbox(self) -> mi.ScalarBoundingBox3f:
        """An empty box: the emitter adds nothing to the scene's extent."""
        return mi.ScalarBoundingBox3f()


def fan_peak_density(fan: str, half_angle: float) -> float:
    """f(0) in 1/rad of the fan's power per angle, whose integral over the fan is 1.

    "uniform": constant over the fan.  "gaussian": exp(-2 phi2/half_angle2), cut off there.
    """
    if fan == "uniform":
        return 1 / (2 * half_angle)
    return 1 / (half_angle * sqrt(pi / 2) * erf(sqrt(2)))


def rayleigh_length_mm(laser: Laser, water_index: float) -> float:
    """Distance in mm from the waist at which the sheet is sqrt(2) as thick.

    z_R = pi w0^2 n / (lambda M2), physics.md section 4.
    """
    wavelength_mm = laser.wavelength_nm * 1e-6
    return pi * laser.waist_mm**2 * water_index / (wavelength_mm * laser.m2)


mi.register_emitter("laser_sheet", LaserSheet)
