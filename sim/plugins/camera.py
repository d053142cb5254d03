"""The sensor plugin: a distorting lens behind a flat port, looking into water.

A ray starts at the pinhole in air, crosses the port in closed form and leaves the glass's
outer face into the water, so no specular interface stands in the scene and any integrator
can connect to it.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from sim.plugins.opaque import opaque, opaque_vector
from sim.scene import Lens, Port, Pose, rotation_x, rotation_y

# Newton converges quadratically; from the distorted point as a start, a wide-angle barrel
# (k1 = -0.3 at a radius of 0.6) is at single precision after four steps.
UNDISTORT_STEPS = 6


class RefractiveCamera(mi.Sensor):
    """Rays of a webcam behind a flat port; see ``make_camera``."""

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.lens: Lens
        self.port_normal: mi.Vector3f

    def configure(self, lens: Lens, port: Port, water_index: float) -> None:
        """Set the optics; every number becomes an opaque value, so no kernel is recompiled."""
        self.focal, self.cx, self.cy = (
            opaque(v) for v in (lens.focal_px, lens.centre_px[0], lens.centre_px[1])
        )
        self.k1, self.k2, self.k3, self.p1, self.p2 = (
            opaque(v) for v in (lens.k1, lens.k2, lens.k3, lens.p1, lens.p2)
        )
        self.gap, self.thickness = opaque(port.gap_mm), opaque(port.thickness_mm)
        self.glass_index, self.water_index = opaque(port.glass_index), opaque(water_index)
        self.port_normal = opaque_vector(port_normal(port))

    def place(self, pose: Pose) -> None:
        """Put the camera at ``pose``, camera frame (x right, y down, z forward) to world."""
        self.axes = [opaque_vector(column) for column in pose.rotation.T]
        self.origin = mi.Point3f(opaque_vector(pose.origin_mm))

    def sample_ray(
        self,
        time: mi.Float,
        wavelength_sample: mi.Float,
        position_sample: mi.Point2f,
        aperture_sample: mi.Point2f,
        active: mi.Bool = True,
    ) -> tuple[mi.Ray3f, mi.Spectrum]:
        """A ray in the water and its weight: Fresnel transmission over the index squared."""
        film = self.film()
        # The one place where Mitsuba's film convention meets ours: the sample spans [0, 1]
        # of the film's crop window from edge to edge, our pixel (0, 0) is the centre of the
        # top-left one of the whole picture.
        u = position_sample.x * film.crop_size().x + film.crop_offset().x - 0.5
        v = position_sample.y * film.crop_size().y + film.crop_offset().y - 0.5
        x, y = self._undistort((u - self.cx) / self.focal, (v - self.cy) / self.focal)
        air = dr.normalize(mi.Vector3f(x, y, 1.0))
        point, water, transmission = self._through_port(air)

        ray = dr.zeros(mi.Ray3f)
        ray.o = self.origin + self._to_world(point)
        ray.d = dr.normalize(self._to_world(water))
        ray.time = time
        ray.maxt = dr.largest(mi.Float)
        ray.wavelengths = []
        # Radiance over index squared is invariant along a ray; the camera is in air.
        weight = transmission / dr.square(self.water_index)
        return ray, mi.Spectrum(weight)

    def sample_ray_differential(
        self,
        time: mi.Float,
        wavelength_sample: mi.Float,
        position_sample: mi.Point2f,
        aperture_sample: mi.Point2f,
        active: mi.Bool = True,
    ) -> tuple[mi.RayDifferential3f, mi.Spectrum]:
        """As ``sample_ray``; the differentials are left out, no texture here needs them."""
        ray, weight = self.sample_ray(
            time, wavelength_sample, position_sample, aperture_sample, active
        )
        return mi.RayDifferential3f(ray), weight

    def bbox(self) -> mi.ScalarBoundingBox3f:
        """An empty box: the camera adds nothing to the scene's extent."""
        return mi.ScalarBoundingBox3f()

    def _undistort(self, xd: mi.Float, yd: mi.Float) -> tuple[mi.Float, mi.Float]:
        """Solve the Brown-Conrady equations for the undistorted point by Newton's method."""
        x, y = mi.Float(xd), mi.Float(yd)
        for _ in range(UNDISTORT_STEPS):
            r2 = x * x + y * y
            radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
            slope = self.k1 + r2 * (2 * self.k2 + r2 * 3 * self.k3)  # d radial / d r2
            ex = x * radial + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x) - xd
            ey = y * radial + self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y - yd
            xx = radial + 2 * x * x * slope + 2 * self.p1 * y + 6 * self.p2 * x
            yy = radial + 2 * y * y * slope + 6 * self.p1 * y + 2 * self.p2 * x
            xy = 2 * x * y * slope + 2 * self.p1 * x + 2 * self.p2 * y
            determinant = xx * yy - xy * xy
            x -= (yy * ex - xy * ey) / determinant
            y -= (xx * ey - xy * ex) / determinant
        return x, y

    def _through_port(self, air: mi.Vector3f) -> tuple[mi.Vector3f, mi.Vector3f, mi.Float]:
        """Exit point from the pinhole, direction in the water, transmission; camera frame."""
        normal = self.port_normal
        cos_air = dr.dot(air, normal)
        glass, cos_glass = _refract(air, normal, cos_air, 1 / self.glass_index)
        water, cos_water = _refract(glass, normal, cos_glass, self.glass_index / self.water_index)
        point = air * (self.gap / cos_air) + glass * (self.thickness / cos_glass)
        transmission = fresnel_transmission(
            cos_air, cos_glass, self.glass_index
        ) * fresnel_transmission(cos_glass, cos_water, self.water_index / self.glass_index)
        return point, water, dr.select(cos_air > 0, transmission, 0)

    def _to_world(self, vector: mi.Vector3f) -> mi.Vector3f:
        right, down, forward = self.axes
        return right * vector.x + down * vector.y + forward * vector.z


def port_normal(port: Port) -> np.ndarray:
    """(3,) unit normal of the port in the camera frame, pointing into the water."""
    return rotation_y(port.tilt_y_deg) @ rotation_x(port.tilt_x_deg) @ np.array([0, 0, 1.0])


def fresnel_transmission(cos_in: mi.Float, cos_out: mi.Float, ratio: mi.Float) -> mi.Float:
    """Power transmitted by an interface for unpolarised light; ratio is n_out / n_in.

    Fresnel's equations (Born & Wolf, Principles of Optics, sec. 1.5.2).
    """
    r_s = (cos_in - ratio * cos_out) / (cos_in + ratio * cos_out)
    r_p = (ratio * cos_in - cos_out) / (ratio * cos_in + cos_out)
    return 1 - 0.5 * (dr.square(r_s) + dr.square(r_p))


def _refract(
    direction: mi.Vector3f, normal: mi.Vector3f, cos_in: mi.Float, eta: mi.Float
) -> tuple[mi.Vector3f, mi.Float]:
    """Direction behind the interface and its cosine to the normal; eta is n_in / n_out."""
    cos_out = dr.safe_sqrt(1 - dr.square(eta) * (1 - dr.square(cos_in)))
    return direction * eta + normal * (cos_out - eta * cos_in), cos_out


mi.register_sensor("refractive_camera", RefractiveCamera)
