"""A camera behind a flat port: pinhole, lens, port and water, and rays through them, both ways."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np

from lscan.config.rig import Known, OpticsSection
from lscan.errors import InputError
from lscan.records import Floats
from lscan.water import ATMOSPHERE_MPA, SALINITY_PSU, TEMPERATURE_C, refractive_index

# What decides where a camera sees a point: pinhole, lens distortion, flat port.


@dataclass(frozen=True)
class PortModel:
    """A flat window between the camera's air and the water.

    Attributes
    ----------
    gap_mm : float, mm, air from the pinhole to the glass, along the glass's normal
    thickness_mm : float, mm, of the glass
    glass_index, water_index : float, relative to air, 1 or more
    tilt_x_deg, tilt_y_deg : float, degrees; the glass's normal is the camera's axis turned by
        Ry(tilt_y) Rx(tilt_x)

    References
    ----------
    docs/explanation/physics.md, section 6.
    """

    gap_mm: float
    thickness_mm: float
    glass_index: float
    water_index: float
    tilt_x_deg: float = 0.0
    tilt_y_deg: float = 0.0

    @property
    def normal(self) -> Floats:
        """(3,) unit normal of the glass in the camera frame, towards the water."""
        a, b = np.radians([self.tilt_x_deg, self.tilt_y_deg])
        return np.array([np.cos(a) * np.sin(b), -np.sin(a), np.cos(a) * np.cos(b)])

    @property
    def normal_derivatives(self) -> Floats:
        """(3, 2) of ``normal`` by the two tilts, per degree."""
        a, b = np.radians([self.tilt_x_deg, self.tilt_y_deg])
        by_a = [-np.sin(a) * np.sin(b), -np.cos(a), -np.sin(a) * np.cos(b)]
        by_b = [np.cos(a) * np.cos(b), 0.0, -np.cos(a) * np.sin(b)]
        return np.radians(np.column_stack([by_a, by_b]))


@dataclass(frozen=True)
class CameraModel:
    """A pinhole with a distorting lens as OpenCV writes it, behind a port or in air.

    Attributes
    ----------
    focal_px : float, px, the same for u and v (square pixels)
    centre_px : tuple of float, px, (u, v) of the axis
    k1, k2 : float, radial distortion
    p1, p2 : float, decentring distortion
    k3 : float, radial distortion
    k4, k5, k6 : float, the denominator of the radial distortion (the rational model); of a
        fisheye k4 is its fourth coefficient, and k5 and k6 are not used
    fisheye : bool, whether the radius in the picture goes with the angle off the axis (Kannala and
        Brandt's model) and not with its tangent
    port : PortModel or None, None for a camera in air
    """

    focal_px: float
    centre_px: tuple[float, float]
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0
    fisheye: bool = False
    port: PortModel | None = None


# Distortion and its inverse, in OpenCV's notation: of the tangents (x, y) of a direction, with
# q = x^2 + y^2, the lens makes (x, y) R(q) and, of Brown's and the rational model, the decentring
# terms of Brown 1971 and Conrady 1919.
#
#     R = (1 + k1 q + k2 q^2 + k3 q^3) / (1 + k4 q + k5 q^2 + k6 q^3)     Brown: no k4 to k6
#     R = t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8) / tan t,  tan^2 t = q     fisheye
#
# The latter is that of J. Kannala and S. Brandt, IEEE PAMI 28 (2006) 1335, eq. 6.


SMALL_LENS_STEP = 1e-10  # tangents; a Newton step this small leaves an error at float64's rounding
MOST_LENS_STEPS = 50
STEEPEST = 1.55  # rad, angle off the axis from which a fisheye's is sought at most


def distort(camera: CameraModel, tangents: Floats) -> Floats:
    """(N, 2) distorted tangents; NaN beyond the radius at which the radial distortion folds back.

    Parameters
    ----------
    camera : CameraModel, whose lens counts
    tangents : (N, 2) array, x/z and y/z of directions in air, camera frame
    """
    inside = np.hypot(*tangents.T) < fold_radius(camera)
    x, y = np.where(inside[:, None], tangents, np.nan).T
    return np.column_stack(_bent_tangents(camera, x, y, *_radial(camera, x, y)[:2]))


def undistort(camera: CameraModel, distorted: Floats) -> Floats:
    """(N, 2) tangents that ``distort`` takes to given ones; NaN where nothing is imaged there.

    By Newton's method from the distorted tangents, or from those of an undistorted fisheye.

    Parameters
    ----------
    camera : CameraModel, whose lens counts
    distorted : (N, 2) array, pixels less the centre, over the focal length
    """
    tangents = distorted
    if camera.fisheye:
        radius = np.hypot(*distorted.T)
        sought = np.tan(np.minimum(radius, STEEPEST))
        tangents = distorted * np.divide(sought, radius, where=radius > 0, out=radius + 1)[:, None]
    step = np.zeros_like(distorted)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for _ in range(MOST_LENS_STEPS):
            step = _newton_step(camera, tangents, distorted)
            tangents = tangents - step
            if not (np.abs(step) > SMALL_LENS_STEP).any():  # NaN never converges, and need not
                break
        arrived = (np.abs(step) <= SMALL_LENS_STEP).all(axis=1)
        arrived &= np.hypot(*tangents.T) < fold_radius(camera)
    return np.where(arrived[:, None], tangents, np.nan)


def fold_radius(camera: CameraModel) -> float:
    """Undistorted radius where the radial distortion turns back; infinite where it never does.

    Parameters
    ----------
    camera : CameraModel, whose radial distortion counts
    """
    return _fold_radius(camera.fisheye, *(getattr(camera, f"k{n}") for n in range(1, 7)))


@lru_cache(maxsize=1024)  # a fit asks for few distortions many times
def _fold_radius(
    fisheye: bool, k1: float, k2: float, k3: float, k4: float, k5: float, k6: float
) -> float:
    # Where the distorted radius grows no more, or has a pole: as a polynomial in the square of the
    # radius, or of a fisheye in that of the angle, whose least root is that of the largest inverse.
    if fisheye:
        inverse = np.roots([1.0, 3 * k1, 5 * k2, 7 * k3, 9 * k4])
    else:
        odd = np.array([1.0, 3.0, 5.0, 7.0])  # d/dr of r^n
        above, below = np.array([1.0, k1, k2, k3]), np.array([1.0, k4, k5, k6])
        growth = np.convolve(odd * above, below) - np.convolve(above, (odd - 1) * below)
        inverse = np.concatenate([np.roots(growth), np.roots(below)])
    real = inverse.real[(np.abs(inverse.imag) < 1e-12) & (inverse.real > 0)]
    least = float(1 / np.sqrt(real.max())) if len(real) else np.inf
    if fisheye:
        return float(np.tan(least)) if least < np.pi / 2 else np.inf
    return least


def _radial(camera: CameraModel, x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
    """(N,) squares q of the radius, by what factor the lens lengthens it, and the factor's d/dq."""
    q = x * x + y * y
    if not camera.fisheye:
        above = 1 + q * (camera.k1 + q * (camera.k2 + q * camera.k3))
        below = 1 + q * (camera.k4 + q * (camera.k5 + q * camera.k6))
        radial = above / below
        by_above = camera.k1 + q * (2 * camera.k2 + q * 3 * camera.k3)
        by_below = camera.k4 + q * (2 * camera.k5 + q * 3 * camera.k6)
        return q, radial, (by_above - radial * by_below) / below
    k1, k2, k3, k4 = camera.k1, camera.k2, camera.k3, camera.k4
    r = np.sqrt(q)
    t = np.arctan(r)
    s, away = t * t, q > 0
    factor = 1 + s * (k1 + s * (k2 + s * (k3 + s * k4)))
    growth = 1 + s * (3 * k1 + s * (5 * k2 + s * (7 * k3 + s * 9 * k4)))  # of t factor, by t
    radial = factor * np.divide(t, r, where=away, out=np.ones_like(r))
    by_q = np.divide(growth / (1 + q) - radial, 2 * q, where=away, out=np.full_like(q, k1 - 1 / 3))
    return q, radial, by_q


def _bent_tangents(
    camera: CameraModel, x: Floats, y: Floats, q: Floats, radial: Floats
) -> tuple[Floats, Floats]:
    """(N,) distorted tangents across and down."""
    across = x * radial + 2 * camera.p1 * x * y + camera.p2 * (q + 2 * x * x)
    down = y * radial + camera.p1 * (q + 2 * y * y) + 2 * camera.p2 * x * y
    return across, down


def undistort_derivatives(camera: CameraModel, tangents: Floats) -> tuple[Floats, Floats]:
    """Derivatives of ``undistort`` by the distorted tangents and by the coefficients.

    Parameters
    ----------
    camera : CameraModel, whose lens counts
    tangents : (N, 2) array, that ``undistort`` found

    Returns
    -------
    tuple of array
        (N, 2, 2), and (N, 2, 8) by k1, k2, p1, p2, k3, k4, k5 and k6.
    """
    x, y = tangents.T
    q, radial, by_q = _radial(camera, x, y)
    if camera.fisheye:
        t = np.arctan(np.sqrt(q))
        first = np.divide(t**3, np.sqrt(q), where=q > 0, out=np.zeros_like(q))
        by_k = [first * t**power for power in (0, 2, 4, 6)]
        by_k += [np.zeros_like(q)] * 2
    else:
        below = 1 + q * (camera.k4 + q * (camera.k5 + q * camera.k6))
        by_k = [q**power / below for power in (1, 2, 3)]
        by_k += [-radial * by_above for by_above in by_k]
    by_p = [[2 * x * y, q + 2 * x * x], [q + 2 * y * y, 2 * x * y]]
    by_coefficients = np.array(
        [
            [at * by_k[0], at * by_k[1], *of_p, *(at * by for by in by_k[2:])]
            for at, of_p in zip((x, y), by_p, strict=True)
        ]
    )
    by_x, by_other, by_y = _jacobian(camera, x, y, q, radial, by_q)
    inverse = np.array([[by_y, -by_other], [-by_other, by_x]])
    inverse = np.moveaxis(inverse / (by_x * by_y - by_other**2), 2, 0)
    return inverse, -inverse @ np.moveaxis(by_coefficients, 2, 0)


def _newton_step(camera: CameraModel, tangents: Floats, distorted: Floats) -> Floats:
    """(N, 2) by which ``tangents`` are too large, to first order."""
    x, y = tangents.T
    q, radial, by_q = _radial(camera, x, y)
    bent_x, bent_y = _bent_tangents(camera, x, y, q, radial)
    across, down = bent_x - distorted[:, 0], bent_y - distorted[:, 1]
    by_x, cross, by_y = _jacobian(camera, x, y, q, radial, by_q)
    steps = np.empty_like(tangents)
    steps[:, 0] = by_y * across - cross * down
    steps[:, 1] = by_x * down - cross * across
    return steps / (by_x * by_y - cross * cross)[:, None]


def _jacobian(
    camera: CameraModel, x: Floats, y: Floats, q: Floats, radial: Floats, by_q: Floats
) -> tuple[Floats, Floats, Floats]:
    """(N,) derivatives: of x distorted by x, of either by the other, of y distorted by y."""
    twice = 2 * by_q  # by x it is that times x
    by_x = radial + twice * x * x + 2 * camera.p1 * y + 6 * camera.p2 * x
    cross = twice * x * y + 2 * camera.p1 * x + 2 * camera.p2 * y
    by_y = radial + twice * y * y + 6 * camera.p1 * y + 2 * camera.p2 * x
    return by_x, cross, by_y


# The bending of rays at a flat port: Snell's law, forwards and backwards.
#
# A ray from the pinhole crosses air, glass and water; its sine times the index is the same in each.
# A point of the water, ``depth`` beyond the glass and r beside the normal through the pinhole,
# therefore obeys (docs/explanation/physics.md, section 6; written for tangents t in air)
#
#     gap t + thickness T(t, glass_index) + depth T(t, water_index) = r,
#     T(t, n) = t / sqrt(n^2 + (n^2 - 1) t^2),
#
# whose left side rises and is concave in t, so that Newton's method climbs to the root from below
# without ever passing it.


SMALL_PORT_STEP = 1e-13  # relative to 1 + t: float64's rounding
MOST_PORT_STEPS = 100


def leave_port(port: PortModel, air: Floats) -> tuple[Floats, Floats]:
    """Where rays from the pinhole enter the water, (N, 3) mm, and their unit directions there.

    Parameters
    ----------
    port : PortModel, flat
    air : (N, 3) array, unit directions before the glass, camera frame

    Returns
    -------
    tuple of array
        Camera frame; NaN for rays that do not meet the glass.

    References
    ----------
    docs/explanation/physics.md, section 6.
    """
    normal = port.normal
    cosine = air @ normal
    cosine = np.where(cosine > 0, cosine, np.nan)[:, None]
    along = air - cosine * normal
    inside = [along / index for index in (port.glass_index, port.water_index)]  # Snell's law
    glass, water = (s + _root(1 - (s**2).sum(axis=1))[:, None] * normal for s in inside)
    entry = air * (port.gap_mm / cosine) + glass * (port.thickness_mm / (glass @ normal))[:, None]
    return entry, water


def leave_port_derivatives(
    port: PortModel, air: Floats, by_tangents: Floats
) -> tuple[Floats, Floats]:
    """Derivatives of ``leave_port`` by the rays' tangents and by the port.

    With s the part of a ray along the glass, the same in each medium times its index m, and
    p = sqrt(m^2 - s^2), a layer of width w carries the ray on by w (normal + s / p), and its
    direction there is (s + p normal) / m.

    Parameters
    ----------
    port : PortModel, flat
    air : (N, 3) array, unit directions before the glass, camera frame
    by_tangents : (N, 3, 2) array, their derivatives by two tangents

    Returns
    -------
    tuple of array
        (N, 3, 8) of the entry into the water and of the direction there, by the two tangents and
        then by the port's gap, thickness, indices of glass and of water, and tilts.
    """
    turning, gap, thickness, glass, water = [0, 1, 6, 7], 2, 3, 4, 5
    normal = port.normal
    by_normal = np.hstack([np.zeros((3, 2)), port.normal_derivatives])
    by_air = np.concatenate([by_tangents, np.zeros_like(by_tangents)], axis=2)
    cosine = (air @ normal)[:, None]
    cosine = np.where(cosine > 0, cosine, np.nan)
    along = air - cosine * normal
    square = (along**2).sum(axis=1)
    by_cosine = normal @ by_air + air @ by_normal
    by_along = by_air - normal[:, None] * by_cosine[:, None] - cosine[:, :, None] * by_normal
    by_half_square = (along[:, None] @ by_along)[:, 0]

    entry, direction = np.zeros((2, len(air), 3, 8))
    air_layer = (port.gap_mm, gap, 1.0, None)
    glass_layer = (port.thickness_mm, thickness, port.glass_index, glass)
    for width, by_width, index, by_index in (air_layer, glass_layer):
        p = _root(index**2 - square)[:, None]
        by_ratio = (by_along + (along / p**2)[:, :, None] * by_half_square[:, None]) / p[:, None]
        entry[:, :, turning] += width * (by_normal + by_ratio)
        entry[:, :, by_width] = normal + along / p
        if by_index is not None:
            entry[:, :, by_index] = -width * index * along / p**3
    index = port.water_index
    p = _root(index**2 - square)[:, None]
    by_p = -by_half_square / p
    turned = by_along + p[:, :, None] * by_normal + normal[:, None] * by_p[:, None]
    direction[:, :, turning] = turned / index
    direction[:, :, water] = normal / p - (along + p * normal) / index**2
    return entry, direction


def _root(square: Floats) -> Floats:
    """(N,) square roots; NaN of what is below 0: an index below 1 may reflect all of a ray."""
    return np.sqrt(np.where(square >= 0, square, np.nan))


def aim_through_port(port: PortModel, points_mm: Floats) -> Floats:
    """(N, 3) directions in air, of any length, of the rays that reach points in the water.

    NaN for points not beyond the glass or that no ray reaches.

    Parameters
    ----------
    port : PortModel, flat
    points_mm : (N, 3) array, mm, camera frame

    References
    ----------
    docs/explanation/physics.md, section 6.
    """
    normal = port.normal
    height = points_mm @ normal
    beside = points_mm - height[:, None] * normal
    r = np.linalg.norm(beside, axis=1)
    depth = height - port.gap_mm - port.thickness_mm
    tangent = _air_tangent(port, r, np.where(depth > 0, depth, np.nan))
    return normal + (tangent / np.where(r > 0, r, 1.0))[:, None] * beside


def _air_tangent(port: PortModel, r: Floats, depth: Floats) -> Floats:
    """(N,) tangent of the angle in air; Newton's method from the paraxial ray."""
    layers = ((port.thickness_mm, port.glass_index), (depth, port.water_index))
    steepest = port.gap_mm + port.thickness_mm / port.glass_index + depth / port.water_index
    tangent = r / steepest
    step = np.zeros_like(tangent)
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(MOST_PORT_STEPS):
            reach, derivative = port.gap_mm * tangent, np.full_like(tangent, port.gap_mm)
            for thickness, index in layers:
                root = np.sqrt(index**2 + (index**2 - 1) * tangent**2)
                reach = reach + thickness * tangent / root
                derivative = derivative + thickness * index**2 / root**3
            step = (r - reach) / derivative
            tangent = tangent + step
            if not (np.abs(step) > SMALL_PORT_STEP * (1 + np.abs(tangent))).any():
                break
        arrived = np.abs(step) <= SMALL_PORT_STEP * (1 + np.abs(tangent))
    return np.where(arrived, tangent, np.nan)


# From pixels to rays in the water, and from points in the water to pixels.


@dataclass(frozen=True)
class Rays:
    """N rays in front of a camera; NaN where a pixel has none.

    Attributes
    ----------
    origin_mm : (N, 3) array, mm, camera frame, where the ray enters the water; the pinhole for a
        camera in air
    direction : (N, 3) array, unit, camera frame, away from the camera
    """

    origin_mm: Floats
    direction: Floats


def rays(camera: CameraModel, image_px: Floats) -> Rays:
    """The rays in the water on which a camera sees pixels.

    Parameters
    ----------
    camera : CameraModel, in air or behind a port
    image_px : (N, 2) array, px, of (u, v)

    Returns
    -------
    Rays
        N of them, camera frame; NaN for pixels that are NaN, that the distortion never reaches, or
        whose rays miss the port.

    Raises
    ------
    InputError
        Where ``image_px`` is not (N, 2).

    References
    ----------
    docs/explanation/physics.md, section 6.

    Examples
    --------
    >>> import numpy as np
    >>> from lscan.camera import CameraModel, rays
    >>> rays(CameraModel(800.0, (319.5, 239.5)), np.array([[319.5, 239.5]])).direction
    array([[0., 0., 1.]])
    """
    pixels = require_columns(image_px, "image_px", 2)
    distorted = (pixels - np.array(camera.centre_px)) / camera.focal_px
    return rays_of(camera, undistort(camera, distorted))


def rays_of(camera: CameraModel, tangents: Floats) -> Rays:
    """The rays in the water that leave the lens in given directions.

    Parameters
    ----------
    camera : CameraModel, its port
    tangents : (N, 2) array, x/z and y/z of directions in air, camera frame; as ``undistort`` gives
    """
    ahead = np.column_stack([tangents, np.ones(len(tangents))])
    air = ahead / np.linalg.norm(ahead, axis=1)[:, None]
    if camera.port is None:
        return Rays(np.where(np.isnan(air), np.nan, 0.0), air)
    return Rays(*leave_port(camera.port, air))


def project(camera: CameraModel, points_mm: Floats) -> Floats:
    """The pixels at which a camera sees points.

    Parameters
    ----------
    camera : CameraModel, in air or behind a port
    points_mm : (N, 3) array, mm, camera frame

    Returns
    -------
    array
        (N, 2) pixels (u, v), some of which may lie outside the picture.  NaN where the camera forms
        no image: points not beyond the port's glass (or not ahead of the pinhole), or so far off
        the axis that the distortion folds back.

    Raises
    ------
    InputError
        Where ``points_mm`` is not (N, 3).

    References
    ----------
    docs/explanation/physics.md, section 6.

    Examples
    --------
    >>> import numpy as np
    >>> from lscan.camera import CameraModel, project
    >>> project(CameraModel(800.0, (319.5, 239.5)), np.array([[50.0, 0.0, 1000.0]]))
    array([[359.5, 239.5]])
    """
    points = require_columns(points_mm, "points_mm", 3)
    direction = points if camera.port is None else aim_through_port(camera.port, points)
    ahead = np.where(direction[:, 2] > 0, direction[:, 2], np.nan)
    tangents = direction[:, :2] / ahead[:, None]
    return camera.focal_px * distort(camera, tangents) + np.array(camera.centre_px)


def meet_plane(seen: Rays, normal: Floats, place_mm: Floats) -> Floats:
    """(N, 3) mm where rays meet a plane; NaN if it is not ahead of them.

    Parameters
    ----------
    seen : Rays, N of them
    normal : (3,) array, of the plane, in the frame of the rays
    place_mm : (3,) array, mm, a point of the plane, in the frame of the rays
    """
    along = seen.direction @ normal
    distance = ((place_mm - seen.origin_mm) @ normal) / np.where(along != 0, along, np.nan)
    ahead = np.where(distance > 0, distance, np.nan)
    return seen.origin_mm + ahead[:, None] * seen.direction


def require_columns(array: Floats, name: str, columns: int) -> Floats:
    """(N, columns) floats, the array itself.

    Parameters
    ----------
    array : (N, columns) array
    name : str, of the argument, for the message
    columns : int, how many it must have

    Raises
    ------
    InputError
        Where it has another shape.
    """
    values = np.asarray(array, dtype=float)
    if values.ndim != 2 or values.shape[1] != columns:
        raise InputError("bad shape", where=name, value=values.shape, allowed=f"(N, {columns})")
    return values


# The refractive index of the water as [optics] states it.


UNKNOWN_WATER: Known = (1.333, 0.003)
"""Fresh or sea water of 0 to 30 C at 650 nm lies within 2.1 of these standard uncertainties."""

OF_MEDIUM = (
    "port", "gap_mm", "thickness_mm", "glass_index", "tilt_x_deg", "tilt_y_deg", "water_index",
    "temperature_c",
)  # fmt: skip
"""What an [optics] says of port and water."""

FORMULA_SIGMA = 1.8e-5
"""Of Quan & Fry's formula, rms against IAPWS R9-97 over its range; of its own data it leaves
1.5e-5.  An error of the water, alike over some 10 K: a mode of all that is seen through it."""
MPA_PER_M = 0.0101  # of sea water; in fresh water 3 % less
RISE_SIGMA = (0.03, 0.06)
"""Of the rise of the index with depth, in fresh water and of 35 psu: fresh water's pressure is 3 %
less than MPA_PER_M has it, and sea water's index rises by 4 to 6 % less than fresh water's."""


def stated_water(optics: OpticsSection) -> Known | None:
    """The index of the water relative to air and its standard uncertainty; None where not stated.

    Parameters
    ----------
    optics : OpticsSection, with ``water_index``, or ``temperature_c`` and what goes with it

    References
    ----------
    Quan & Fry 1995; docs/explanation/physics.md, section 1.

    Examples
    --------
    >>> from lscan.config.rig import OpticsSection
    >>> index, sigma = stated_water(OpticsSection(temperature_c=(20.0, 0.5)))
    >>> round(index, 5), round(sigma, 5)
    (1.33132, 5e-05)
    """
    if optics.temperature_c is None:
        return optics.water_index
    known = (optics.temperature_c, optics.salinity_psu or (0.0, 0.0), optics.depth_m or (0.0, 0.0))
    mean = np.array([value for value, _ in known])
    index = _index(mean, optics.wavelength_nm)
    variance = FORMULA_SIGMA**2
    most = (TEMPERATURE_C[1], SALINITY_PSU[1], np.inf)
    for place, (value, sigma) in enumerate(known):
        step = np.zeros(3)
        step[place] = 0.1 if value < most[place] - 0.1 else -0.1
        derivative = (_index(mean + step, optics.wavelength_nm) - index) / step[place]
        variance += (derivative * sigma) ** 2
    fresh, sea = RISE_SIGMA
    rise = index - _index(mean * [1.0, 1.0, 0.0], optics.wavelength_nm)
    variance += (rise * (fresh + (sea - fresh) * mean[1] / SALINITY_PSU[1])) ** 2
    return index, float(np.sqrt(variance))


def stated_port(optics: OpticsSection) -> Literal["flat", "none"] | None:
    """The kind of port that an [optics] states; None where it says nothing of port or water.

    A flat port is what is taken where nothing is said, and no statement.

    Parameters
    ----------
    optics : OpticsSection, of a rig or of a calibration
    """
    silent = OpticsSection()
    said = any(getattr(optics, name) != getattr(silent, name) for name in OF_MEDIUM)
    return optics.port if said else None


def _index(state: np.ndarray, wavelength_nm: float) -> float:
    temperature_c, salinity_psu, depth_m = state.tolist()
    pressure_mpa = min(ATMOSPHERE_MPA + MPA_PER_M * depth_m, 100.0)
    return refractive_index(temperature_c, salinity_psu, wavelength_nm, pressure_mpa)
