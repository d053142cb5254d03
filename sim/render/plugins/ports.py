"""Ports in closed form: where a ray from the air comes out into the water, and what is lost.

Everything is in the camera frame (origin at the pinhole, x right, y down, z ahead), mm.  Each
face is crossed by Snell's law with its normal pointing along the way, towards the water.
Single precision suffices: places are within some 100 mm of the pinhole.
"""

from dataclasses import dataclass
from typing import Protocol

import drjit as dr
import mitsuba as mi

from lscan.records import Floats
from sim.render.plugins.opaque import opaque, opaque_vector
from sim.scene import PlanePort, Port, rotation
from sim.scene.instrument import DomePort


@dataclass(frozen=True)
class PortCrossing:
    """Rays that have crossed the port; camera frame.

    point: where they enter the water, mm.  direction: unit, in the water.
    weight: radiance in the air per radiance in the water, that is Fresnel transmission of
    both faces, unpolarised, over the water's index squared (radiance over index squared is
    invariant along a ray); 0 where a ray does not reach the water.
    """

    point: mi.Point3f
    direction: mi.Vector3f
    weight: mi.Float


class PortOptics(Protocol):
    """What a camera asks of its port."""

    def cross(self, origin: mi.Point3f, direction: mi.Vector3f) -> PortCrossing:
        """Rays of the air, unit directions, behind the port."""


class FlatOptics:
    """A flat port: two parallel planes across its normal."""

    def __init__(self, port: PlanePort, glass_index: float, water_index: float) -> None:
        """Take the port's numbers as opaque values; indices are relative to air."""
        self.gap, self.thickness = opaque(port.gap_mm), opaque(port.thickness_mm)
        self.glass_index, self.water_index = opaque(glass_index), opaque(water_index)
        self.normal = opaque_vector(port_rotation(port)[:, 2])

    def cross(self, origin: mi.Point3f, direction: mi.Vector3f) -> PortCrossing:
        """The rays behind the glass; those that start beyond it or turn away weigh 0."""
        normal = self.normal
        cos_air = dr.dot(direction, normal)
        ahead = self.gap - dr.dot(origin, normal)
        glass, cos_glass, inner = cross_face(direction, normal, mi.Float(1.0), self.glass_index)
        water, _, outer = cross_face(glass, normal, self.glass_index, self.water_index)
        point = origin + direction * (ahead / cos_air) + glass * (self.thickness / cos_glass)
        weight = inner * outer / dr.square(self.water_index)
        return PortCrossing(point, water, dr.select((ahead > 0) & (cos_air > 0), weight, 0.0))


class DomeOptics:
    """A dome: two concentric spheres, the pinhole anywhere inside the inner one."""

    def __init__(self, port: DomePort, glass_index: float, water_index: float) -> None:
        """Take the port's numbers as opaque values; indices are relative to air."""
        self.inner_radius = opaque(port.radius_mm)
        self.outer_radius = opaque(port.radius_mm + port.thickness_mm)
        self.glass_index, self.water_index = opaque(glass_index), opaque(water_index)
        self.centre = opaque_vector(port.centre_mm)

    def cross(self, origin: mi.Point3f, direction: mi.Vector3f) -> PortCrossing:
        """The rays behind the glass; those that do not start inside the dome weigh 0."""
        start = mi.Vector3f(origin) - self.centre
        inside = dr.squared_norm(start) < dr.square(self.inner_radius)
        normal = sphere_exit(start, direction, self.inner_radius)
        glass, _, inner = cross_face(direction, normal, mi.Float(1.0), self.glass_index)
        start = normal * self.inner_radius
        normal = sphere_exit(start, glass, self.outer_radius)
        water, _, outer = cross_face(glass, normal, self.glass_index, self.water_index)
        point = mi.Point3f(self.centre + normal * self.outer_radius)
        weight = inner * outer / dr.square(self.water_index)
        return PortCrossing(point, water, dr.select(inside, weight, 0.0))


def closed_form(port: Port, glass_index: float, water_index: float) -> PortOptics:
    """The port's closed form; the indices of glass and water are relative to air."""
    if isinstance(port, PlanePort):
        return FlatOptics(port, glass_index, water_index)
    return DomeOptics(port, glass_index, water_index)


def port_rotation(port: PlanePort) -> Floats:
    """(3, 3) port frame to camera frame; the last column is the normal, towards the water."""
    return rotation("YX", (port.tilt_y_deg, port.tilt_x_deg))


def cross_face(
    direction: mi.Vector3f, normal: mi.Vector3f, index_in: mi.Float, index_out: mi.Float
) -> tuple[mi.Vector3f, mi.Float, mi.Float]:
    """Unit direction behind a face, its cosine to the normal, and the power transmitted.

    direction, normal: unit, the normal along the way.  Snell's law in vector form: the part
    along the face scales by n_in / n_out.
    """
    ratio = index_out / index_in
    cos_in = dr.dot(direction, normal)
    cos_out = dr.safe_sqrt(1 - (1 - dr.square(cos_in)) / dr.square(ratio))
    refracted = direction / ratio + normal * (cos_out - cos_in / ratio)
    return refracted, cos_out, fresnel_transmission(cos_in, cos_out, ratio)


def fresnel_transmission(cos_in: mi.Float, cos_out: mi.Float, ratio: mi.Float) -> mi.Float:
    """Power transmitted by an interface for unpolarised light, 0 to 1.

    Parameters
    ----------
    cos_in, cos_out : Float, cosines of the angles to the normal before and behind the interface
    ratio : Float, n_out / n_in

    References
    ----------
    Born & Wolf, Principles of Optics, sec. 1.5.2 (Fresnel's equations).
    """
    r_s = (cos_in - ratio * cos_out) / (cos_in + ratio * cos_out)
    r_p = (ratio * cos_in - cos_out) / (ratio * cos_in + cos_out)
    return 1 - 0.5 * (dr.square(r_s) + dr.square(r_p))


def sphere_exit(start: mi.Vector3f, direction: mi.Vector3f, radius: mi.Float) -> mi.Vector3f:
    """Outward unit normal where a ray from inside a sphere about the origin leaves it, mm.

    The positive root of |start + t direction| = radius, in the form that does not cancel for
    a ray that runs outwards.
    """
    outward = dr.dot(start, direction)
    missing = dr.square(radius) - dr.squared_norm(start)
    root = dr.safe_sqrt(dr.square(outward) + missing)
    t = dr.select(outward > 0, missing / (root + outward), root - outward)
    return dr.normalize(start + direction * t)
