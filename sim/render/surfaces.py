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
    points_mm : (H, W, 3) array, mm, from the camera's pinhole; camera frame: x right, y down, z
        along the axis.  Behind a port they do not lie on the straight line through the pixel.
    normals : (H, W, 3) array, unit vectors towards the camera's side of the surface; camera frame
    """

    points_mm: Floats
    normals: Floats

    @property
    def depth_mm(self) -> Floats:
        """(H, W) mm along the camera's axis from its pinhole."""
        return self.points_mm[..., 2]


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
    place = ray.o + found.t * ray.d - pinhole
    towards = dr.select(dr.dot(found.n, ray.d) > 0, -found.n, found.n)
    seen = found.is_valid() & (weight > 0)
    parts = [dr.dot(vector, axis) for vector in (place, towards) for axis in axes]
    parts = [dr.select(seen, part, dr.nan) for part in parts]
    dr.eval(parts)
    along = np.stack([np.array(part).reshape(height, width) for part in parts], axis=-1)
    return SeenSurfaces(along[..., :3], along[..., 3:])
