"""How much of the sheet a rig measures: where a level and an upright line are lit and seen."""

import numpy as np

from lscan.records import Floats
from sim.scene import Head, Scene, camera_pose
from sim.truth import project
from sim.truth.sheet import sheet_of
from sim.truth.visibility import fan_angle

PIECES = 4000
"""Of a line whose ends are looked for; between them they are found by linear interpolation."""
REACH = 3.0
"""How far the upright line is looked at beyond the aim, in distances of the camera from it."""


def aim_mm(head: Head) -> Floats:
    """(3,) where the camera's axis meets the plane y = 0, head frame, mm; refraction apart.

    Parameters
    ----------
    head : Head, whose camera looks towards the plane
    """
    pose = camera_pose(head)
    axis = pose.rotation[:, 2]
    return np.asarray(pose.origin_mm - axis * pose.origin_mm[1] / axis[1])


def measured_mm(scene: Scene) -> tuple[float, float]:
    """Measured width and depth range, mm.

    The width is that of a level line through the place in the sheet that the camera aims at, as far
    as the laser's fan reaches and the camera sees it; the depth range that of an upright line
    through the same place.  0 where the place itself is not lit or not seen.

    Parameters
    ----------
    scene : Scene, its target left out
    """
    x, y, z = aim_mm(scene.tank.head)
    apex_z = scene.tank.laser.apex_mm[2]
    far = REACH * float(np.linalg.norm(np.array(scene.tank.head.camera_mm) - [x, y, z]))
    level = np.column_stack([x + np.linspace(-far, far, PIECES + 1), np.full(PIECES + 1, z)])
    upright = np.column_stack([np.full(PIECES + 1, x), z + np.linspace(-far, far, PIECES + 1)])
    upright = upright[upright[:, 1] < apex_z]
    return _extent(scene, level, (x, z)), _extent(scene, upright, (x, z))


def _extent(scene: Scene, line_mm: Floats, middle_mm: tuple[float, float]) -> float:
    """Length of the part of a line of the sheet, about its middle, that is lit and seen.

    line_mm: (N, 2) evenly along it.
    """
    if len(line_mm) == 0:
        return 0.0
    inside = _margin(scene, line_mm)
    good = inside >= 0
    middle = int(np.argmin(np.linalg.norm(line_mm - middle_mm, axis=1)))
    if not good[middle]:
        return 0.0
    start = middle - int(np.argmin(np.append(good[middle::-1], False))) + 1
    stop = middle + int(np.argmin(np.append(good[middle:], False)))  # first that is not
    step = float(np.linalg.norm(line_mm[1] - line_mm[0]))
    length = (stop - 1 - start) * step
    for last, beyond in ((start, start - 1), (stop - 1, stop)):
        if 0 <= beyond < len(line_mm) and np.isfinite(inside[beyond]):
            length += step * inside[last] / (inside[last] - inside[beyond])
    return float(length)


def _margin(scene: Scene, line_mm: Floats) -> Floats:
    """(N,) the least share by which points are within the picture and the fan; below 0 outside."""
    pixels = project(scene, sheet_of(scene).in_head(line_mm))
    size = np.array(scene.rig.camera.size_px)
    within = np.minimum(pixels + 0.5, size - 0.5 - pixels) / size
    half = np.radians(scene.tank.laser.fan_half_angle_deg)
    lit = (half - np.abs(fan_angle(scene.tank.laser, line_mm))) / half
    margin: Floats = np.minimum(within.min(axis=1), lit)
    return margin
