"""The ray from the pinhole to a point of the water, through a spherical port.

All of it lies in the plane of pinhole, dome centre and point.  About the centre, index times
the distance at which the ray (drawn on) passes the centre is the same in air, glass and
water: Bouguer's theorem (Born & Wolf, Principles of Optics, sec. 3.2).  Polar angles about
the centre are counted from the radius through the pinhole; a straight ray that passes the
centre at ``p`` and goes out from radius a to b advances by arcsin(p/a) - arcsin(p/b).
"""

from math import hypot

import numpy as np
from scipy.optimize.elementwise import find_root

from lscan.records import Floats
from sim.scene.instrument import DomePort

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
