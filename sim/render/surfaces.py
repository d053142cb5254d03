"""What surface each pixel of a picture sees, through the middle of the pixel and of the pupil."""

from dataclasses import dataclass

import drjit as dr
import numpy as np

from lscan.records import Floats
from sim.render.tank import Tank
from sim.scene import camera_pose, head_pose


@dataclass(frozen=True)
class SeenSurfaces:
    """The surfaces in a picture; NaN where a pixel sees none.

    Attributes
    ----------
    depth_mm : (H, W) array, mm, along the camera's axis from its pinhole
    normals : (H, W, 3) array, unit vectors towards the camera's side of the surface; camera frame:
        x right, y down, z along the axis
    """

    depth_mm: Floats
    normals: Floats


def surfaces_seen(tank: Tank, position_mm: float) -> SeenSurfaces:
    """The surfaces in the picture that a tank would take now.

    Parameters
    ----------
    tank : Tank, as it was rendered last
    position_mm : float, mm, along the track; where the head moves, in the middle of the read-out
    """
    width, height = tank.scene.rig.camera.size_px
    head = tank.scene.tank.head
    pose = head_pose(head, position_mm) @ camera_pose(head)
    ray, weight = tank.pixel_rays(position_mm)
    found = tank.mitsuba_scene.ray_intersect(ray)
    dr.eval(ray, weight, found)
    hit = np.array(found.is_valid()) & (np.array(weight) > 0)
    way = np.array(ray.d, dtype=float).T[hit]
    distance = np.array(found.t, dtype=float)[hit, np.newaxis]
    points = np.array(ray.o, dtype=float).T[hit] + distance * way
    normals = np.array(found.n, dtype=float).T[hit]
    normals *= -np.sign((normals * way).sum(axis=1, keepdims=True))
    depth, local = np.full(len(hit), np.nan), np.full((len(hit), 3), np.nan)
    depth[hit] = pose.invert(points)[:, 2]
    local[hit] = normals @ pose.rotation
    return SeenSurfaces(depth.reshape(height, width), local.reshape(height, width, 3))
