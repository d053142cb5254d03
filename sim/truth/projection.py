"""Where a point of the water is seen: port, pinhole, Brown-Conrady distortion.

Domes are in sim.truth.dome.  A flat port's normal is the camera's axis turned by the port's
tilts, in the camera frame Ry(tilt_y) Rx(tilt_x) (0, 0, 1).  A ray from the pinhole crosses
``gap_mm`` of air (index 1), ``thickness_mm`` of glass, then water; sines times indices are
conserved, so a point at height z along the normal and r beside it obeys a monotone equation
in one unknown (physics.md section 6), solved here for the tangent of the angle in air.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lscan.errors import InputError
from lscan.records import Floats
from sim.scene import FlatPort, Lens, Port, Pose, Scene, camera_pose, rotation_x, rotation_y
from sim.truth.dome import dome_rays
from sim.truth.roots import increasing_roots
from sim.water import glass_index, water_optics


@dataclass(frozen=True)
class Camera:
    """All that decides where a point is seen.

    pose: camera frame to head frame.  port: its glass given by number.  water_index:
    relative to air.
    """

    pose: Pose
    lens: Lens
    port: Port
    water_index: float

    @property
    def normal(self) -> Floats:
        """(3,) unit normal of a flat port in the camera frame, towards the water."""
        assert isinstance(self.port, FlatPort)
        return flat_normal(self.port)


@dataclass(frozen=True)
class Rays:
    """The rays from the pinhole that reach N points; camera frame; NaN where none does.

    direction: (N, 3) in the air, of any length.  entry_mm: (N, 3) where the ray leaves the
    glass and enters the water.
    """

    direction: Floats
    entry_mm: Floats


def camera_of(scene: Scene) -> Camera:
    """The scene's camera, looking into the scene's water at the laser's wavelength."""
    tank, wavelength_nm = scene.tank, scene.tank.laser.wavelength_nm
    index = water_optics(tank.water, wavelength_nm).index
    glass = {"glass_index": glass_index(tank.port.glass_index, wavelength_nm)}
    return Camera(camera_pose(tank.head), tank.lens, tank.port.model_copy(update=glass), index)


def project(scene: Scene, points_head_mm: Floats) -> Floats:
    """(N, 2) pixels (u, v) of (N, 3) points in the head frame, mm.

    NaN where the camera forms no image: points not beyond the port's glass, seen 90 degrees
    or more off the axis, or so far off it that the distortion polynomial folds back.  A pixel
    may lie outside the picture.  Raises InputError where the points are not finite or not
    (N, 3).
    """
    camera = camera_of(scene)
    return image(camera, rays_to(camera, points_head_mm).direction)


def entry_points(scene: Scene, points_head_mm: Floats) -> Floats:
    """(N, 3) where the camera's rays to (N, 3) points enter the water; head frame, mm.

    NaN for points not beyond the port's glass; InputError as ``project``.
    """
    camera = camera_of(scene)
    return camera.pose.apply(rays_to(camera, points_head_mm).entry_mm)


def rays_to(camera: Camera, points_head_mm: Floats) -> Rays:
    """The rays from the pinhole to (N, 3) points of the water, head frame, mm."""
    points = np.asarray(points_head_mm, dtype=float)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise InputError("points to project", value=points.shape, allowed="finite, (N, 3)")
    local = camera.pose.invert(points)
    if isinstance(camera.port, FlatPort):
        return Rays(*flat_rays(camera.port, camera.water_index, local))
    return Rays(*dome_rays(camera.port, camera.water_index, local))


def flat_rays(port: FlatPort, water_index: float, points_mm: Floats) -> tuple[Floats, Floats]:
    """Directions in the air and places where the rays enter the water, each (N, 3).

    points_mm: (N, 3).  All in the camera frame, mm.  NaN for points not beyond the glass.
    """
    normal = flat_normal(port)
    height = points_mm @ normal
    beside = points_mm - height[:, np.newaxis] * normal
    r = np.linalg.norm(beside, axis=1)
    depth = height - port.gap_mm - port.thickness_mm
    depth = np.where(depth > 0, depth, np.nan)

    reached = ~np.isnan(depth)
    tangent = np.full(len(points_mm), np.nan)
    tangent[reached] = air_tangent(r[reached], depth[reached], port, water_index)
    outward = beside / np.where(r > 0, r, 1.0)[:, np.newaxis]
    direction = normal + tangent[:, np.newaxis] * outward
    in_glass = port.thickness_mm * refracted_tangent(tangent, float(port.glass_index))
    aside = (port.gap_mm * tangent + in_glass)[:, np.newaxis]
    entry = (port.gap_mm + port.thickness_mm) * normal + aside * outward
    return direction, np.where(reached[:, np.newaxis], entry, np.nan)


def flat_normal(port: FlatPort) -> Floats:
    """(3,) unit normal of a flat port in the camera frame, towards the water."""
    turned = rotation_y(port.tilt_y_deg) @ rotation_x(port.tilt_x_deg)
    return turned @ np.array([0.0, 0.0, 1.0])


def air_tangent(r_mm: Floats, depth_mm: Floats, port: FlatPort, water_index: float) -> Floats:
    """(N,) tangent of the angle in air of the ray to points beyond a flat port.

    r_mm: (N,) distance from the normal through the pinhole; depth_mm: (N,) beyond the
    glass, positive.  The distance a ray has come from the normal is a concave function of
    the tangent: it lies below its slope at 0 and above the air gap's part alone, which
    brackets the root.
    """
    glass = float(port.glass_index)

    def excess(tangent: Floats) -> tuple[Floats, Floats]:
        reach, slope = port.gap_mm * tangent, np.full_like(tangent, port.gap_mm)
        layers = ((port.thickness_mm, glass), (depth_mm, water_index))
        for thickness, index in layers:
            reach = reach + thickness * refracted_tangent(tangent, index)
            slope = slope + thickness * refracted_slope(tangent, index)
        return reach - r_mm, slope

    steepest = port.gap_mm + port.thickness_mm / glass + depth_mm / water_index
    return increasing_roots(excess, r_mm / steepest, r_mm / port.gap_mm)


def refracted_tangent(tangent: Floats, index: float) -> Floats:
    """Tangent behind a flat face of a ray that has ``tangent`` in air: Snell's law."""
    return tangent / np.sqrt(index**2 + (index**2 - 1) * tangent**2)


def refracted_slope(tangent: Floats, index: float) -> Floats:
    """Derivative of ``refracted_tangent`` by the tangent in air."""
    return index**2 / (index**2 + (index**2 - 1) * tangent**2) ** 1.5


def image(camera: Camera, direction: Floats) -> Floats:
    """(N, 2) pixels of (N, 3) directions in air, camera frame; NaN where there is no image.

    Distortion as OpenCV's documentation writes it (Brown 1971, Conrady 1919).
    """
    lens = camera.lens
    ahead = np.where(direction[:, 2] > 0, direction[:, 2], np.nan)
    x, y = direction[:, 0] / ahead, direction[:, 1] / ahead
    q = x**2 + y**2
    q = np.where(np.hypot(x, y) < fold_radius(lens), q, np.nan)
    radial = 1 + q * (lens.k1 + q * (lens.k2 + q * lens.k3))
    distorted = np.column_stack(
        [
            x * radial + 2 * lens.p1 * x * y + lens.p2 * (q + 2 * x**2),
            y * radial + lens.p1 * (q + 2 * y**2) + 2 * lens.p2 * x * y,
        ]
    )
    return lens.focal_px * distorted + np.array(lens.centre_px)


def fold_radius(lens: Lens) -> float:
    """Undistorted radius where the radial distortion turns back; infinite where it never does."""
    # In the inverse of the squared radius the polynomial's first coefficient is 1.
    inverse = np.roots([1.0, 3 * lens.k1, 5 * lens.k2, 7 * lens.k3])
    real = inverse.real[(np.abs(inverse.imag) < 1e-12) & (inverse.real > 0)]
    return float(1 / np.sqrt(real.max())) if len(real) else np.inf
