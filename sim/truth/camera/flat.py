"""The ray from the pinhole to a point of the water, through a flat port.

By Fermat's principle: of all ways from the pinhole over a point of either face of the glass to
the point, light takes the one of the shortest optical path,

    hypot(gap, a) + n_glass hypot(thickness, b - a) + n_water hypot(depth, r - b),

r being the point's distance from the normal through the pinhole, and a and b those of the places
where the faces are crossed.  The sum is convex in a and b and is minimised numerically; no law
of refraction is used.  The port's normal is the camera's axis turned by the port's tilts, in
the camera frame Ry(tilt_y) Rx(tilt_x) (0, 0, 1).
"""

import numpy as np

from lscan.errors import MeasurementError
from lscan.records import Floats
from sim.scene import PlanePort, rotation

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

    def layered(places: Floats) -> tuple[Floats, Floats]:
        """(3, N) how far aside a way runs in each layer, and how long it is there."""
        ends = np.stack([np.zeros_like(r_mm), *places, r_mm])
        aside = np.diff(ends, axis=0)
        return aside, np.hypot(aside, thickness)

    paraxial = np.cumsum(thickness / index, axis=0)
    places: Floats = r_mm * paraxial[:2] / paraxial[2]
    aside, length = layered(places)
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
            aside, length = layered(places - share * step)
            excess = (index * length).sum(axis=0) - path + share * promised
            long = excess > ROUNDING * path
            if not long.any():
                break
            share[long] /= 2
        places = places - share * step
        if np.all(np.abs(share * step) <= SMALL_STEP * (1 + r_mm)):
            return places
    raise MeasurementError("the truth's shortest path was not found")
