"""The sensor plugin: a distorting lens behind a port, looking into water.

A ray starts in the lens in air, crosses the port (sim.render.plugins.camera) and leaves the glass's
outer face into the water, so no specular interface stands in the scene and any integrator
can connect to it.  Through an aperture of its own size the lens blurs by defocus; a head that
moves while the shutter is open blurs by motion.
"""

from dataclasses import dataclass
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi

from lscan.errors import InputError
from lscan.records import Floats
from sim.render.plugins.arrays import opaque, opaque_vector
from sim.scene import Lens, PlanePort, Port, Pose, rotation
from sim.scene.instrument import DomePort

# Ports in closed form: where a ray from the air comes out into the water, and what is lost.
#
# Everything is in the camera frame (origin at the pinhole, x right, y down, z ahead), mm.  Each
# face is crossed by Snell's law with its normal pointing along the way, towards the water.
# Single precision suffices: places are within some 100 mm of the pinhole.


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


# The sensor plugin: a distorting lens behind a port, looking into water.


# Newton converges quadratically; from the distorted point as a start, a wide-angle barrel
# (k1 = -0.3 at a radius of 0.6) is at single precision after four steps.
UNDISTORT_STEPS = 6
WIDE_STEPS = 12  # of a rational lens, from which the way is longer: 75 degrees off the axis take 9
MS_PER_S = 1e3


class RefractiveCamera(mi.Sensor):
    """Rays of a webcam behind a port: ``configure``, ``place``, and ``move`` if it does.

    fineness: parts of a pixel's side that the film cuts it into (sim.render.layers), a property
    of the plugin, 1 if it is not given; ``configure`` then takes the finer lens.
    """

    def __init__(self, props: mi.Properties) -> None:
        """Stand still until ``move`` says otherwise.

        Parameters
        ----------
        props : Properties, of the plugin, with film and ``fineness``
        """
        super().__init__(props)
        self.fineness = int(props.get("fineness", 1))
        self.lens_is_open = self.is_moving = False

    def configure(
        self,
        lens: Lens,
        port: Port,
        glass_index: float,
        water_index: float,
        *,
        aperture_mm: float = 0.0,
    ) -> None:
        """Set the optics; every number becomes an opaque value, so no kernel is recompiled.

        Parameters
        ----------
        lens : Lens, of the picture, px
        port : Port, its air gap and its glass
        glass_index, water_index : float, relative to air
        aperture_mm : float, mm, diameter of the entrance pupil of a thin lens in the pinhole's
            plane; 0 is a pinhole

        Raises
        ------
        InputError
            An open aperture lacks the distance it is focused at.
        """
        if aperture_mm > 0 and lens.focus_mm is None:
            what = "focus_mm of a lens with an open aperture"
            raise InputError(what, value=None, allowed="a distance in mm")
        self.lens_is_open = aperture_mm > 0
        self.pupil_radius = opaque(aperture_mm / 2)
        self.focus = opaque(lens.focus_mm or 1.0)
        self.focal, self.cx, self.cy = (
            opaque(v) for v in (lens.focal_px, lens.centre_px[0], lens.centre_px[1])
        )
        self.model = lens.model
        self.k1, self.k2, self.k3, self.k4, self.k5, self.k6, self.p1, self.p2 = (
            opaque(getattr(lens, name)) for name in ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
        )
        self.port = self.make_port(port, glass_index, water_index)

    def make_port(self, port: Port, glass_index: float, water_index: float) -> PortOptics:
        """The port as this kind of camera sees through it: in closed form.

        Parameters
        ----------
        port : Port, its air gap and its glass
        glass_index, water_index : float, relative to air
        """
        if isinstance(port, PlanePort):
            return FlatOptics(port, glass_index, water_index)
        return DomeOptics(port, glass_index, water_index)

    def place(self, pose: Pose) -> None:
        """Put the camera at a pose.

        Parameters
        ----------
        pose : Pose, camera frame (x right, y down, z forward) to world
        """
        self.axes = [opaque_vector(column) for column in pose.rotation.T]
        self.origin = mi.Point3f(opaque_vector(pose.origin_mm))

    def move(self, velocity_mm_s: Floats, exposure_ms: float, readout_ms: float) -> None:
        """Move the camera while the picture is taken, about the pose it is placed at.

        Rays have the time, in seconds, (row / height - 1/2) readout + (shutter sample - 1/2)
        exposure, and start displaced by velocity times it; all times are 0 where neither velocity
        nor readout is set.

        Parameters
        ----------
        velocity_mm_s : (3,) array, mm/s, world frame
        exposure_ms : float, ms, of each row
        readout_ms : float, ms, how long a rolling shutter takes over all rows
        """
        self.is_moving = any(velocity_mm_s) or readout_ms != 0
        self.velocity = opaque_vector(velocity_mm_s)
        self.exposure, self.readout = opaque(exposure_ms / MS_PER_S), opaque(readout_ms / MS_PER_S)
        # Mitsuba draws a shutter sample, uniform between 0 and this, only where it is not 0.
        shutter = mi.traverse(self)
        shutter["shutter_open_time"] = 1.0 if self.is_moving else 0.0
        shutter.update()

    def sample_ray(
        self,
        time: mi.Float,
        wavelength_sample: mi.Float,
        position_sample: mi.Point2f,
        aperture_sample: mi.Point2f,
        active: mi.Bool = True,
    ) -> tuple[mi.Ray3f, mi.Spectrum]:
        """A ray in the water, world frame, and its weight (sim.render.plugins.camera.PortCrossing).

        Parameters
        ----------
        time : Float, the shutter sample, 0 to 1
        wavelength_sample : Float, not used; there is one wavelength
        position_sample : Point2f, place in the picture, 0 to 1 along each side
        aperture_sample : Point2f, place in the entrance pupil, 0 to 1 along each side
        active : Bool, which of the rays are wanted
        """
        pupil = self.pupil_point(position_sample, aperture_sample) if self.lens_is_open else None
        ray, weight = self.ray_through(position_sample, pupil)
        if self.is_moving:
            ray.time = self._time(self._place(position_sample), time)
            ray.o += self.velocity * ray.time
        return ray, weight

    def ray_through(
        self, position_sample: mi.Point2f, pupil: mi.Point2f | None = None
    ) -> tuple[mi.Ray3f, mi.Spectrum]:
        """A ray as of ``sample_ray``, at time 0, through a given point of the entrance pupil.

        Parameters
        ----------
        position_sample : Point2f, place in the picture, 0 to 1 along each side
        pupil : Point2f or None, in radii of the pupil from its middle; that if None
        """
        place = self._place(position_sample)
        u, v = place.x - 0.5, place.y - 0.5
        x, y = self._undistort((u - self.cx) / self.focal, (v - self.cy) / self.focal)
        crossing = self.port.cross(*self._in_air(x, y, pupil))

        ray = dr.zeros(mi.Ray3f)
        ray.o = self.origin + self._to_world(crossing.point)
        ray.d = dr.normalize(self._to_world(crossing.direction))
        ray.maxt = dr.largest(mi.Float)
        ray.wavelengths = []
        return ray, mi.Spectrum(crossing.weight)

    def pupil_point(self, position_sample: mi.Point2f, aperture_sample: mi.Point2f) -> mi.Point2f:
        """Point of the pupil, in its radii from its middle, of a sample moved round by pixel.

        Parameters
        ----------
        position_sample, aperture_sample : Point2f, as of ``sample_ray``
        """
        place, sample = self._place(position_sample), aperture_sample
        moved = (self._shift(value, place, k) for k, value in enumerate((sample.x, sample.y)))
        return mi.Point2f(mi.warp.square_to_uniform_disk_concentric(mi.Point2f(*moved)))

    def sample_ray_differential(self, *sample: Any) -> tuple[mi.RayDifferential3f, mi.Spectrum]:
        """As ``sample_ray``; the differentials are left out, no texture here needs them.

        Parameters
        ----------
        *sample : as of ``sample_ray``
        """
        ray, weight = self.sample_ray(*sample)
        return mi.RayDifferential3f(ray), weight

    def bbox(self) -> mi.ScalarBoundingBox3f:
        """An empty box: the camera adds nothing to the scene's extent."""
        return mi.ScalarBoundingBox3f()

    def _place(self, position_sample: mi.Point2f) -> mi.Point2f:
        """Place in the whole film, px from its top left edge.

        The one place where Mitsuba's film convention meets ours: the sample spans [0, 1] of the
        film's crop window from edge to edge, our pixel (0, 0) is the centre of the top-left one of
        the whole picture.
        """
        film = self.film()
        return position_sample * mi.Vector2f(film.crop_size()) + mi.Vector2f(film.crop_offset())

    def _in_air(
        self, x: mi.Float, y: mi.Float, pupil: mi.Point2f | None
    ) -> tuple[mi.Point3f, mi.Vector3f]:
        """Start and unit direction in the air, camera frame, of the ray at tangents (x, y).

        A thin lens sends what passes any point of its pupil to where the ray through its
        middle meets the plane of focus.
        """
        through_middle = mi.Vector3f(x, y, 1.0)
        if pupil is None:
            return mi.Point3f(0.0), dr.normalize(through_middle)
        start = mi.Point3f(pupil.x * self.pupil_radius, pupil.y * self.pupil_radius, 0.0)
        return start, dr.normalize(through_middle * self.focus - mi.Vector3f(start))

    def _time(self, place: mi.Point2f, shutter_sample: mi.Float) -> mi.Float:
        """Seconds from the mid-exposure of the middle row, height / 2; rows are read whole.

        All parts of a pixel are read with the first of its rows.
        """
        rows_read = dr.floor(place.y) / self.film().size().y
        rows_late = mi.Float(mi.UInt32(place.y) % self.fineness) / self.film().size().y
        shutter = self._shift(shutter_sample, place, 2)
        moment = (rows_read - 0.5) * self.readout + (shutter - 0.5) * self.exposure
        return moment - rows_late * self.readout

    def _shift(self, sample: mi.Float, place: mi.Point2f, dimension: int) -> mi.Float:
        """The sample in [0, 1) moved round by an amount that each pixel has of its own.

        A stratified sampler without jitter draws the same few values in every pixel: pupil
        and shutter would be seen at those alone, and a blurred edge would be a staircase.
        Moved round by a uniform shift (Cranley & Patterson 1976) every value is as likely,
        and the few in a pixel stay as well spread.
        """
        pixel = mi.UInt32(place.y) * self.film().size().x + mi.UInt32(place.x)
        moved = sample + mi.sample_tea_float32(pixel, mi.UInt32(dimension))
        return moved - dr.floor(moved)

    def _undistort(self, xd: mi.Float, yd: mi.Float) -> tuple[mi.Float, mi.Float]:
        """Solve the lens's equations for the undistorted point by Newton's method."""
        if self.model == "fisheye":
            return self._undistort_fisheye(xd, yd)
        rational = self.model == "rational"
        x, y = mi.Float(xd), mi.Float(yd)
        for _ in range(WIDE_STEPS if rational else UNDISTORT_STEPS):
            r2 = x * x + y * y
            radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
            slope = self.k1 + r2 * (2 * self.k2 + r2 * 3 * self.k3)  # d radial / d r2
            if rational:
                below = 1 + r2 * (self.k4 + r2 * (self.k5 + r2 * self.k6))
                sinks = self.k4 + r2 * (2 * self.k5 + r2 * 3 * self.k6)
                radial /= below
                slope = (slope - radial * sinks) / below
            ex = x * radial + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x) - xd
            ey = y * radial + self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y - yd
            xx = radial + 2 * x * x * slope + 2 * self.p1 * y + 6 * self.p2 * x
            yy = radial + 2 * y * y * slope + 6 * self.p1 * y + 2 * self.p2 * x
            xy = 2 * x * y * slope + 2 * self.p1 * x + 2 * self.p2 * y
            determinant = xx * yy - xy * xy
            x -= (yy * ex - xy * ey) / determinant
            y -= (xx * ey - xy * ex) / determinant
        return x, y

    def _undistort_fisheye(self, xd: mi.Float, yd: mi.Float) -> tuple[mi.Float, mi.Float]:
        """As ``_undistort``: the angle off the axis is found, whose tangent is the radius."""
        radius = dr.hypot(xd, yd)
        angle = mi.Float(radius)
        for _ in range(UNDISTORT_STEPS):
            s = angle * angle
            found = angle * (1 + s * (self.k1 + s * (self.k2 + s * (self.k3 + s * self.k4))))
            growth = 1 + s * (3 * self.k1 + s * (5 * self.k2 + s * (7 * self.k3 + s * 9 * self.k4)))
            angle -= (found - radius) / growth
        longer = dr.select(radius > 0, dr.tan(angle) / radius, 1.0)
        return xd * longer, yd * longer

    def _to_world(self, vector: mi.Vector3f) -> mi.Vector3f:
        right, down, forward = self.axes
        return right * vector.x + down * vector.y + forward * vector.z


mi.register_sensor("refractive_camera", RefractiveCamera)
