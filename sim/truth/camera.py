"""Where a point of the water is seen: port, pinhole, distortion."""

from dataclasses import dataclass
from itertools import pairwise
from math import hypot

import numpy as np
from numpy.polynomial import Polynomial
from scipy.optimize import brentq
from scipy.optimize.elementwise import find_root

from lscan.errors import InputError, MeasurementError
from lscan.records import Floats
from sim.scene import Lens, PlanePort, Port, Pose, Scene, camera_pose, rotation
from sim.scene.instrument import DomePort
from sim.water import glass_index, water_index

# The ray from the pinhole to a point of the water, through a flat port.
#
# By Fermat's principle: of all ways from the pinhole over a point of either face of the glass to
# the point, light takes the one of the shortest optical path,
#
#     hypot(gap, a) + n_glass hypot(thickness, b - a) + n_water hypot(depth, r - b),
#
# r being the point's distance from the normal through the pinhole, and a and b those of the places
# where the faces are crossed.  The sum is convex in a and b and is minimised numerically; no law
# of refraction is used.  The port's normal is the camera's axis turned by the port's tilts, in
# the camera frame Ry(tilt_y) Rx(tilt_x) (0, 0, 1).


# A step this small, relative to 1 + r mm, leaves an error at the rounding of float64.
SMALL_STEP = 1e-13
MOST_STEPS = 500
ENOUGH = 0.1  # share of the shortening that the slope promises, for a step to be taken (Armijo)
ROUNDING = 1e-15  # of a path's length, relative


def flat_rays(port: PlanePort, water_index: float, points_mm: Floats) -> tuple[Floats, Floats]:
    """Directions in the air and places where the rays enter the water, each (N, 3).

    points_mm: (N, 3).  All in the camera frame, mm.  NaN for points not beyond the glass.
    """
    normal = flat_normal(port)
    height = points_mm @ normal
    beside = points_mm - height[:, np.newaxis] * normal
    r = np.linalg.norm(beside, axis=1)
    depth = height - port.gap_mm - port.thickness_mm
    reached = depth > 0
    inner, outer = np.full((2, len(r), 1), np.nan)
    inner[reached, 0], outer[reached, 0] = crossed_at(port, water_index, r[reached], depth[reached])
    outward = beside / np.where(r > 0, r, 1.0)[:, np.newaxis]
    direction = normal + inner / port.gap_mm * outward
    return direction, (port.gap_mm + port.thickness_mm) * normal + outer * outward


def flat_normal(port: PlanePort) -> Floats:
    """(3,) unit normal of a flat port in the camera frame, towards the water."""
    return rotation("YX", (port.tilt_y_deg, port.tilt_x_deg))[:, 2]


def crossed_at(port: PlanePort, water_index: float, r_mm: Floats, depth_mm: Floats) -> Floats:
    """(2, N) distances from the normal at which the rays to N points cross the glass's faces, mm.

    By Newton's method, with steps halved until the path becomes shorter.

    Parameters
    ----------
    port, water_index
        The port, and the water's index relative to air.
    r_mm, depth_mm
        (N,) of the points from the normal through the pinhole, and beyond the glass.

    Raises
    ------
    MeasurementError
        Where the search does not converge.
    """
    index = np.array([[1.0], [float(port.glass_index)], [water_index]])
    layers = [np.full_like(r_mm, port.gap_mm), np.full_like(r_mm, port.thickness_mm), depth_mm]
    thickness = np.stack(layers)

    def ways_in_layers(places: Floats) -> tuple[Floats, Floats]:
        """(3, N) how far aside a way runs in each layer, and how long it is there."""
        ends = np.stack([np.zeros_like(r_mm), *places, r_mm])
        aside = np.diff(ends, axis=0)
        return aside, np.hypot(aside, thickness)

    paraxial = np.cumsum(thickness / index, axis=0)
    places: Floats = r_mm * paraxial[:2] / paraxial[2]
    aside, length = ways_in_layers(places)
    for _ in range(MOST_STEPS):
        path = (index * length).sum(axis=0)
        pull = index * aside / length
        first, second = gradient = pull[:2] - pull[1:]
        a, b, c = index * thickness**2 / length**3
        # The inverse of the matrix of second derivatives, ((a + b, -b), (-b, b + c)).
        step = np.stack([(b + c) * first + b * second, b * first + (a + b) * second])
        step /= a * b + a * c + b * c
        promised = ENOUGH * (gradient * step).sum(axis=0)
        share = np.ones_like(r_mm)
        while True:
            aside, length = ways_in_layers(places - share * step)
            excess = (index * length).sum(axis=0) - path + share * promised
            long = excess > ROUNDING * path
            if not long.any():
                break
            share[long] /= 2
        places = places - share * step
        if np.all(np.abs(share * step) <= SMALL_STEP * (1 + r_mm)):
            return places
    raise MeasurementError("the truth's shortest path was not found")


# The ray from the pinhole to a point of the water, through a spherical port.
#
# All of it lies in the plane of pinhole, dome centre and point.  About the centre, index times the
# distance at which the ray (drawn on) passes the centre is the same in air, glass and water:
# Bouguer's theorem (Born & Wolf, Principles of Optics, sec. 3.2).  Polar angles about the centre
# are counted from the radius through the pinhole; a straight ray that passes the centre at ``p``
# and goes out from radius a to b advances by arcsin(p/a) - arcsin(p/b).


Shells = tuple[tuple[float, float, Floats | float], ...]  # index, inner and outer radius, mm
# A dome nearer to the pinhole than this is centred; below, dividing by the distance loses digits.
CENTRED_MM = 1e-100


def dome_rays(port: DomePort, water_index: float, points_mm: Floats) -> tuple[Floats, Floats]:
    """Unit directions in the air and places where the rays enter the water, each (N, 3).

    points_mm: (N, 3).  All in the camera frame, mm.  NaN for points that do not lie beyond
    the glass; every other point has exactly one ray (``polar_angle`` is increasing).
    """
    centre = np.array(port.centre_mm)
    from_centre = hypot(*port.centre_mm)  # safe from underflow
    # A centred dome has no axis of its own: any will do.
    axis = -centre / from_centre if from_centre > CENTRED_MM else np.array([0.0, 0.0, 1.0])
    outer = port.radius_mm + port.thickness_mm

    local = points_mm - centre
    distance = np.linalg.norm(local, axis=1)
    height = local @ axis
    beside = local - height[:, np.newaxis] * axis
    r = np.linalg.norm(beside, axis=1)
    outward = beside / np.where(r > 0, r, 1.0)[:, np.newaxis]

    start, entry = np.full((2, len(local)), np.nan)
    out = distance > outer
    glass: Shells = ((float(port.glass_index), port.radius_mm, outer),)

    def excess(angle: Floats, target: Floats, distance: Floats) -> Floats:
        water: Shells = ((water_index, outer, distance),)
        return polar_angle(angle, from_centre, port.radius_mm, glass + water) - target

    target = np.arctan2(r[out], height[out])
    start[out] = find_root(excess, (0.0, np.pi), args=(target, distance[out])).x
    entry[out] = polar_angle(start[out], from_centre, port.radius_mm, glass)
    return _towards(start, axis, outward), centre + outer * _towards(entry, axis, outward)


def polar_angle(start: Floats, from_centre_mm: float, radius_mm: float, shells: Shells) -> Floats:
    """(N,) polar angle about the dome's centre at which rays leave the last shell.

    start: (N,) angle of the ray at the pinhole.  In the air the ray turns from ``start`` to
    its angle of incidence at ``radius_mm``.  For indices of 1 or more and a pinhole inside
    the dome the polar angle increases with ``start``: in its derivative each shell's sum of
    inverse roots has the sign that works against the air's, and is smaller.
    """
    passing = from_centre_mm * np.sin(start)
    angle = start - np.arcsin(passing / radius_mm)
    for index, inner, outer in shells:
        angle = angle + np.arcsin(passing / (index * inner)) - np.arcsin(passing / (index * outer))
    return angle


def _towards(angle: Floats, axis: Floats, outward: Floats) -> Floats:
    """(N, 3) unit vectors at (N,) angles from the axis towards ``outward``."""
    return np.cos(angle)[:, np.newaxis] * axis + np.sin(angle)[:, np.newaxis] * outward


# Where a point of the water is seen: port, pinhole, distortion.


MOST_HALVINGS = 2000  # more than float64 has numbers between 0 and 1, halved


@dataclass(frozen=True)
class TrueCamera:
    """All that decides where a point is seen.

    pose: camera frame to head frame.  port: its glass given by number.  water_index:
    relative to air.
    """

    pose: Pose
    lens: Lens
    port: Port
    water_index: float


@dataclass(frozen=True)
class RaysToPoints:
    """The rays from the pinhole that reach N points; camera frame; NaN where none does.

    direction: (N, 3) in the air, of any length.  entry_mm: (N, 3) where the ray leaves the
    glass and enters the water.
    """

    direction: Floats
    entry_mm: Floats


def camera_of(scene: Scene) -> TrueCamera:
    """The scene's camera, looking into the scene's water at the laser's wavelength.

    Parameters
    ----------
    scene : Scene, its head, lens, port and water

    Raises
    ------
    InputError
        An index is not known at that wavelength.
    """
    tank, wavelength_nm = scene.tank, scene.tank.laser.wavelength_nm
    index = water_index(tank.water, wavelength_nm)
    glass = {"glass_index": glass_index(tank.port.glass_index, wavelength_nm)}
    return TrueCamera(camera_pose(tank.head), tank.lens, tank.port.model_copy(update=glass), index)


def project(scene: Scene, points_head_mm: Floats) -> Floats:
    """The pixels that points of the water are seen in.

    Parameters
    ----------
    scene
        The tank.
    points_head_mm
        (N, 3), head frame, mm.

    Returns
    -------
    (N, 2) pixels (u, v), which may lie outside the picture; NaN where the camera forms no image:
    points not beyond the port's glass, seen 90 degrees or more off the axis, or so far off it that
    the distortion polynomial folds back.

    Raises
    ------
    InputError
        Where the points are not finite or not (N, 3).
    """
    camera = camera_of(scene)
    return image(camera, rays_to(camera, points_head_mm).direction)


def entry_points(scene: Scene, points_head_mm: Floats) -> Floats:
    """(N, 3) where the camera's rays to (N, 3) points enter the water; head frame, mm.

    NaN for points not beyond the port's glass; InputError as ``project``.
    """
    camera = camera_of(scene)
    return camera.pose.apply(rays_to(camera, points_head_mm).entry_mm)


def rays_to(camera: TrueCamera, points_head_mm: Floats) -> RaysToPoints:
    """The rays from the pinhole to points of the water.

    Parameters
    ----------
    camera : TrueCamera
    points_head_mm : (N, 3) array, mm, head frame
    """
    points = np.asarray(points_head_mm, dtype=float)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise InputError("points to project", value=points.shape, allowed="finite, (N, 3)")
    local = camera.pose.invert(points)
    if isinstance(camera.port, PlanePort):
        return RaysToPoints(*flat_rays(camera.port, camera.water_index, local))
    return RaysToPoints(*dome_rays(camera.port, camera.water_index, local))


def image(camera: TrueCamera, direction: Floats) -> Floats:
    """(N, 2) pixels of (N, 3) directions in air, camera frame; NaN where there is no image.

    Distortion as OpenCV's documentation writes it (Brown 1971, Conrady 1919; of a fisheye, the
    angle off the axis in its place: Kannala and Brandt, IEEE PAMI 28 (2006) 1335).

    Parameters
    ----------
    camera : TrueCamera, its lens
    direction : (N, 3) array, of any length
    """
    lens = camera.lens
    ahead = np.where(direction[:, 2] > 0, direction[:, 2], np.nan)
    x, y = direction[:, 0] / ahead, direction[:, 1] / ahead
    if lens.model == "fisheye":
        beside = np.hypot(direction[:, 0], direction[:, 1])
        angle = np.arctan2(beside, ahead)
        angle = np.where(angle < fold_radius(lens), angle, np.nan)
        bends = [0, 1, 0, lens.k1, 0, lens.k2, 0, lens.k3, 0, lens.k4]
        radius = Polynomial(bends)(angle) / np.where(beside > 0, beside, 1.0)
        return lens.focal_px * radius[:, None] * direction[:, :2] + np.array(lens.centre_px)
    q = x**2 + y**2
    q = np.where(np.hypot(x, y) < fold_radius(lens), q, np.nan)
    radial = 1 + q * (lens.k1 + q * (lens.k2 + q * lens.k3))
    radial = radial / (1 + q * (lens.k4 + q * (lens.k5 + q * lens.k6)))
    distorted = np.column_stack(
        [
            x * radial + 2 * lens.p1 * x * y + lens.p2 * (q + 2 * x**2),
            y * radial + lens.p1 * (q + 2 * y**2) + 2 * lens.p2 * x * y,
        ]
    )
    return lens.focal_px * distorted + np.array(lens.centre_px)


def fold_radius(lens: Lens) -> float:
    """Undistorted radius where the radial distortion turns back; infinite where it never does.

    Of a fisheye it is an angle, rad.  The distorted radius is a polynomial of the undistorted one,
    or one over another that must not vanish before; it grows up to the first root of its
    derivative's numerator.
    """
    above = Polynomial([0, 1, 0, lens.k1, 0, lens.k2, 0, lens.k3])
    below = Polynomial([1, 0, lens.k4, 0, lens.k5, 0, lens.k6])
    if lens.model == "fisheye":
        above = Polynomial([*above.coef, 0, lens.k4])
        below = Polynomial([1])
    growth = above.deriv() * below - above * below.deriv()
    return min(_first_root(growth), _first_root(below))


def _first_root(polynomial: Polynomial) -> float:
    """The first root above 0 of an even polynomial that is 1 at 0; infinite where it has none.

    It is bracketed in w = 1 / r^2 from above: between places where the polynomial of w turns there
    is one root at most.
    """
    in_w = Polynomial(polynomial.coef[::2][::-1]).trim()
    largest = max(_roots_above_0(in_w), default=0.0)
    return float(1 / np.sqrt(largest)) if largest > 0 else float("inf")


def _roots_above_0(polynomial: Polynomial) -> list[float]:
    """The roots above 0 at which a polynomial changes sign, one between two of its turns."""
    if polynomial.degree() < 1:
        return []
    largest = polynomial.coef[-1]
    beyond = 1 + float(np.abs(polynomial.coef / largest).max())  # Cauchy's bound of the roots
    places = [0.0, *_roots_above_0(polynomial.deriv()), beyond]
    return [
        brentq(polynomial, low, high, xtol=np.finfo(float).tiny, maxiter=MOST_HALVINGS)
        for low, high in pairwise(places)
        if polynomial(low) * polynomial(high) < 0
    ]
