"""What surface each pixel of a picture sees, through the middle of the pixel and of the pupil."""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
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
    # The pose is data of the kernel: as a constant it would have each picture compiled anew.
    axes = [mi.Vector3f(column) for column in pose.rotation.T.tolist()]
    pinhole = mi.Point3f(pose.origin_mm.tolist())
    dr.make_opaque(axes, pinhole)
    depth = dr.dot(ray.o - pinhole, axes[2]) + found.t * dr.dot(ray.d, axes[2])
    towards = dr.select(dr.dot(found.n, ray.d) > 0, -found.n, found.n)
    seen = found.is_valid() & (weight > 0)
    parts = [depth, *(dr.dot(towards, axis) for axis in axes)]
    parts = [dr.select(seen, part, dr.nan) for part in parts]
    dr.eval(parts)
    depth_mm, *normals = (np.array(part).reshape(height, width) for part in parts)
    return SeenSurfaces(depth_mm, np.stack(normals, axis=-1))
