"""The bending of rays at a flat port: Snell's law, forwards and backwards.

A ray from the pinhole crosses air, glass and water; its sine times the index is the same in
each.  A point of the water, ``depth`` beyond the glass and r beside the normal through the
pinhole, therefore obeys (docs/explanation/physics.md, section 6; written for tangents t in air)

    gap t + thickness T(t, glass_index) + depth T(t, water_index) = r,
    T(t, n) = t / sqrt(n^2 + (n^2 - 1) t^2),

whose left side rises and is concave in t, so that Newton's method climbs to the root from
below without ever passing it.
"""

import numpy as np

from lscan.camera.model import PortModel
from lscan.records import Floats

SMALL_STEP = 1e-13  # relative to 1 + t: float64's rounding
MOST_STEPS = 100


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
    glass, water = (_refracted(along, normal, n) for n in (port.glass_index, port.water_index))
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


def _refracted(along: Floats, normal: Floats, index: float) -> Floats:
    """(N, 3) unit rays in a medium: Snell's law for the part ``along`` the face of a ray in air.

    NaN where an index below 1, which a search for it may try, reflects all of the ray.
    """
    inside = along / index
    return inside + _root(1 - (inside**2).sum(axis=1))[:, None] * normal


def _root(square: Floats) -> Floats:
    """(N,) square roots; NaN of what is below 0: an index below 1 may reflect all of a ray."""
    root: Floats = np.sqrt(np.where(square >= 0, square, np.nan))
    return root


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
        for _ in range(MOST_STEPS):
            reach, derivative = port.gap_mm * tangent, np.full_like(tangent, port.gap_mm)
            for thickness, index in layers:
                root = np.sqrt(index**2 + (index**2 - 1) * tangent**2)
                reach = reach + thickness * tangent / root
                derivative = derivative + thickness * index**2 / root**3
            step = (r - reach) / derivative
            tangent = tangent + step
            if not (np.abs(step) > SMALL_STEP * (1 + np.abs(tangent))).any():
                break
        arrived = np.abs(step) <= SMALL_STEP * (1 + np.abs(tangent))
    return np.where(arrived, tangent, np.nan)
