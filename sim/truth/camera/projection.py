"""Where a point of the water is seen: port, pinhole, distortion."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.optimize import brentq

from lscan.errors import InputError
from lscan.records import Floats
from sim.scene import Lens, PlanePort, Port, Pose, Scene, camera_pose
from sim.truth.camera.dome import dome_rays
from sim.truth.camera.flat import flat_rays
from sim.water import glass_index, water_index

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

    Distortion as OpenCV's documentation writes it (Brown 1971, Conrady 1919).

    Parameters
    ----------
    camera : TrueCamera, its lens
    direction : (N, 3) array, of any length
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
    """Undistorted radius where the radial distortion turns back; infinite where it never does.

    With w the inverse of the squared radius, the distorted radius grows as
    w^3 + 3 k1 w^2 + 5 k2 w + 7 k3 has it.  Between places where that turns there is one root at
    most, which is bracketed there; the largest is looked for.
    """
    a, b, c = 3 * lens.k1, 5 * lens.k2, 7 * lens.k3

    def growth(w: float) -> float:
        return ((w + a) * w + b) * w + c

    beyond = 1 + max(abs(a), abs(b), abs(c))  # Cauchy's bound of the roots
    root = np.sqrt(max(a * a - 3 * b, 0.0))
    turns = [turn for turn in ((root - a) / 3, (-root - a) / 3) if 0 < turn < beyond]
    for high, low in pairwise([beyond, *turns, 0.0]):
        if growth(low) < 0:
            found = brentq(growth, low, high, xtol=np.finfo(float).tiny, maxiter=MOST_HALVINGS)
            return float(1 / np.sqrt(found)) if found > 0 else np.inf
    return float("inf")
