"""The emitter plugin: a Gaussian laser sheet whose fan opens from an apex inside the water.

The laser sits behind a port of its own, but light that reaches a point through two specular
interfaces cannot be found by a path tracer, so the emitter stands on the water side: a delta
light whose strength at a point is the sheet's irradiance there.  Stock integrators can connect
to it.

Coordinates of the sheet: phi, the angle in the fan; rho, the distance from the apex along the
fan's plane; s, the offset from the sheet's middle along its normal.  A sheet that left the
laser through a tilted window is bowed: its middle rises by q(phi) rho above the plane.

In the fan's plane light comes from the apex.  Across it light runs along a Gaussian beam's
hyperbolas, on each of which s is a constant share of the half width w(rho).  So one direction
belongs to each point, its hyperbola's there, and one source on the line through the apex along
the sheet's normal, where the hyperbola begins: whatever stands on the straight way to the source
shades the point (docs/explanation/physics.md, section 4).
"""

from math import erf, pi, radians, sqrt

import drjit as dr
import mitsuba as mi
import numpy as np

from lscan.records import Floats
from sim.render.plugins.arrays import floats, opaque, opaque_vector
from sim.scene import Laser, LaserLine, Pose, sheet_pose

BOW_NODES = 16385  # linear between them: q is good to 1e-8 where the window is tilted by 12 deg


class LaserSheet(mi.Emitter):
    """Light of one laser sheet; configured with ``configure``, moved with ``place``."""

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.m_flags = int(mi.EmitterFlags.DeltaPosition)

    def configure(self, laser: Laser, line: LaserLine, water_index: float, nm: float) -> None:
        """Set power, fan and beam; every number becomes opaque, so no kernel is recompiled.

        nm: the wavelength of the moment.
        """
        self.settings = laser, line, water_index, nm
        half_angle = radians(laser.fan_half_angle_deg)
        self.is_gaussian_fan = laser.fan == "gaussian"
        self.power = opaque(laser.power_mw * line.share)
        self.half_angle = opaque(half_angle)
        self.fan_peak = opaque(fan_peak_density(laser, half_angle))
        self.fan_rise = opaque(laser.fan_rise)
        self.waist, self.waist_distance = opaque(laser.waist_mm), opaque(laser.waist_distance_mm)
        self.rayleigh = opaque(rayleigh_length_mm(laser, water_index, nm))
        self.is_bowed = laser.port_tilt_deg != 0
        self.bow_table = floats(bow(laser, water_index))
        self._in_head = sheet_pose(laser, line)
        self.is_moving = False

    def place(self, head: Pose, velocity_mm_s: Floats | None = None) -> None:
        """Move the sheet with the head, whose pose in the world is ``head`` at time 0.

        velocity_mm_s: (3,) of the head in the world; it stands still if None.
        """
        pose = head @ self._in_head
        self.rest = mi.Point3f(opaque_vector(pose.origin_mm))
        x, y, z = pose.rotation.T
        self.across, self.normal, self.axis = (opaque_vector(v) for v in (x, y, -z))
        self.is_moving = velocity_mm_s is not None and bool(np.any(velocity_mm_s))
        if velocity_mm_s is not None:
            self.velocity = opaque_vector(velocity_mm_s)

    def apex(self, time: mi.Float) -> mi.Point3f:
        """The apex at a time in s."""
        return self.rest + self.velocity * time if self.is_moving else self.rest

    def coordinates(self, point: mi.Point3f, time: mi.Float) -> tuple[mi.Float, mi.Float, mi.Float]:
        """phi, rho and s of a point, s from the sheet's middle."""
        offset = point - self.apex(time)
        lateral, depth = dr.dot(offset, self.across), dr.dot(offset, self.axis)
        rho = dr.sqrt(dr.square(lateral) + dr.square(depth))
        phi = dr.atan2(lateral, depth)
        s = dr.dot(offset, self.normal)
        return phi, rho, s - rho * self.slope(phi) if self.is_bowed else s

    def direction(self, phi: mi.Float) -> mi.Vector3f:
        """Along the sheet's middle at ``phi``; its length in the fan's plane is 1."""
        sine, cosine = dr.sincos(phi)
        flat = self.across * sine + self.axis * cosine
        return flat + self.normal * self.slope(phi) if self.is_bowed else flat

    def ray_through(
        self, phi: mi.Float, rho: mi.Float, s: mi.Float, time: mi.Float
    ) -> tuple[mi.Vector3f, mi.Point3f]:
        """Which way light travels at a place of the sheet, a unit vector, and its source."""
        along = self.direction(phi) + self.normal * (s * self.curvature(rho))
        at_apex = s * (self.half_width(mi.Float(0)) / self.half_width(rho))
        return dr.normalize(along), self.apex(time) + self.normal * at_apex

    def arrival(self, point: mi.Point3f, time: mi.Float) -> tuple[mi.Vector3f, mi.Point3f]:
        """``ray_through`` a point of the world."""
        return self.ray_through(*self.coordinates(point, time), time)

    def irradiance(self, point: mi.Point3f, time: mi.Float) -> mi.Float:
        """mW/mm2 on a surface that faces the light at ``point``, without the water's loss.

        E = P f(phi) / rho * sqrt(2/pi) / w * exp(-2 s2 / w2), the fan's
        power per arc of radius rho, spread over the Gaussian of 1/e2 half width w
        (docs/explanation/physics.md, section 4).
        """
        phi, rho, s = self.coordinates(point, time)
        width = self.half_width(rho)
        across = sqrt(2 / pi) / width * dr.exp(-2 * dr.square(s / width))
        return self.power_density(phi) / rho * across

    def half_width(self, rho: mi.Float) -> mi.Float:
        """1/e2 half width of the sheet in mm at a distance in mm from the apex."""
        return self.waist * dr.sqrt(1 + dr.square((rho - self.waist_distance) / self.rayleigh))

    def curvature(self, rho: mi.Float) -> mi.Float:
        """Of the wavefront across the sheet, 1/mm: positive where light spreads.

        1 / R = z / (z2 + z_R2), z from the waist; it is also the slope of a hyperbola over its s
        (docs/explanation/physics.md, section 4).
        """
        z = rho - self.waist_distance
        return z / (dr.square(z) + dr.square(self.rayleigh))

    def power_density(self, phi: mi.Float) -> mi.Float:
        """mW per radian of the fan."""
        relative = dr.square(phi / self.half_angle)
        shape = dr.exp(-2 * relative) if self.is_gaussian_fan else 1 + self.fan_rise * relative
        inside = dr.abs(phi) <= self.half_angle
        return dr.select(inside, self.power * self.fan_peak * shape, 0.0)

    def slope(self, phi: mi.Float) -> mi.Float:
        """q(phi): how far the bowed sheet's middle rises above the plane, per rho."""
        place = (phi / pi + 1) * (0.5 * (BOW_NODES - 1))
        cell = dr.clip(mi.UInt32(place), 0, BOW_NODES - 2)
        low, high = (dr.gather(mi.Float, self.bow_table, cell + k) for k in (0, 1))
        return dr.lerp(low, high, place - mi.Float(cell))

    def sample_direction(
        self, it: mi.Interaction3f, sample: mi.Point2f, active: mi.Bool = True
    ) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
        """Where light comes from at ``it`` and the sheet's irradiance, a delta light's weight.

        ``d`` is the local direction, by which light is scattered and reflected; ``p`` and ``dist``
        are the source's, towards which integrators ask what stands in the way.
        """
        along, source = self.arrival(it.p, it.time)
        ds = dr.zeros(mi.DirectionSample3f)
        ds.p = source
        ds.n = mi.Normal3f(self.axis)
        ds.time = it.time
        ds.pdf = 1.0
        ds.delta = True
        ds.emitter = mi.EmitterPtr(self)
        ds.d = -along
        ds.dist = dr.norm(source - it.p)
        return ds, mi.Spectrum(dr.select(active, self.irradiance(it.p, it.time), 0.0))

    def pdf_direction(
        self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool = True
    ) -> mi.Float:
        """Zero: a delta position is never hit by chance."""
        return mi.Float(0.0)

    def eval_direction(
        self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool = True
    ) -> mi.Spectrum:
        """The sheet's irradiance at the reference point."""
        return mi.Spectrum(dr.select(active, self.irradiance(it.p, it.time), 0.0))

    def eval(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Spectrum:
        """Zero: the emitter has no surface."""
        return mi.Spectrum(0.0)

    def bbox(self) -> mi.ScalarBoundingBox3f:
        """An empty box: the emitter adds nothing to the scene's extent."""
        return mi.ScalarBoundingBox3f()


def fan_peak_density(laser: Laser, half_angle: float) -> float:
    """f(0) in 1/rad of the fan's power per angle, whose integral over the fan is 1.

    "uniform": 1 + fan_rise (phi/half_angle)2.  "gaussian": exp(-2 phi2/half_angle2), cut off
    at the half angle.
    """
    if laser.fan == "uniform":
        return 1 / (2 * half_angle * (1 + laser.fan_rise / 3))
    return 1 / (half_angle * sqrt(pi / 2) * erf(sqrt(2)))


def rayleigh_length_mm(laser: Laser, water_index: float, wavelength_nm: float) -> float:
    """Distance in mm from the waist at which the sheet is sqrt(2) as thick.

    z_R = pi w0^2 n / (lambda M2), docs/explanation/physics.md, section 4.
    """
    return pi * laser.waist_mm**2 * water_index / (wavelength_nm * 1e-6 * laser.m2)


def bow(laser: Laser, water_index: float) -> Floats:
    """(BOW_NODES,) q(phi) at angles from -pi to pi of a sheet that left a tilted window.

    Snell's law keeps each ray's component along the window, divided by the water's index.
    With the window's normal N and its tangent T across the sheet, the fan's ray at the angle
    f in air leaves along (sin f, -cos f sin tilt) / n in (x, T).  q is followed from the
    straight ray's plane; beyond the largest angle the window lets through, it is held.
    """
    tilt = radians(laser.port_tilt_deg)
    f = np.linspace(-pi / 2, pi / 2, 20001)
    lateral = np.sin(f) / water_index
    tangent = -np.cos(f) * np.sin(tilt) / water_index
    normal = np.sqrt(1 - lateral**2 - tangent**2)
    straight = len(f) // 2
    ahead = tangent * tangent[straight] + normal * normal[straight]
    rise = tangent * normal[straight] - normal * tangent[straight]
    phi = np.arctan2(lateral, ahead)
    q = rise / np.hypot(lateral, ahead)
    return np.interp(np.linspace(-pi, pi, BOW_NODES), phi, q)


mi.register_emitter("laser_sheet", LaserSheet)
