"""The camera plugin behind a port that is real dielectric geometry instead of a closed form.

Geometry, refraction and Fresnel's loss are Mitsuba's own: stock shapes with the stock
``dielectric``, in a small scene of the camera frame that moves with the camera.  So it checks
sim.render.plugins.camera without sharing a formula with it, and can stand in for it in any picture.
"""

from collections.abc import Mapping
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from lscan.records import Floats
from sim.render.plugins.camera import PortCrossing, PortOptics, RefractiveCamera, port_rotation
from sim.scene import PlanePort, Port

# A port has an inner and an outer face.
FACES = 2
# A refracted ray starts this much past the face it has crossed, so as not to meet it again.
# Along the ray: Mitsuba's own spawn_ray steps aside along the normal, by up to 9e-3 mm where
# coordinates are 100 mm, which moves a ray at 45 degrees by 0.01 px at 0.5 m.
STEP_MM = 1e-3
# Half the side of a flat port's faces over its distance: rays up to 84 degrees pass.
FLAT_REACH = 10.0


class TracedPort:
    """A port of any shapes with ``dielectric`` BSDFs, two of them on the way of each ray.

    shapes: Mitsuba dictionaries or objects by name, in the camera frame, mm.  Meshes serve
    as well as analytic shapes, as finely as they are tessellated.
    """

    def __init__(self, shapes: Mapping[str, Any]) -> None:
        """Build the port's own scene."""
        self.scene = mi.load_dict({"type": "scene", **shapes})
        # Lobe 0 of a dielectric is its reflection, lobe 1 its transmission.  Alone, a lobe
        # is drawn with certainty, and its weight is the share of radiance transmitted, which
        # in a light's radiance mode holds the change of index squared too.
        self.context = mi.BSDFContext()
        self.context.component = 1

    def cross(self, origin: mi.Point3f, direction: mi.Vector3f) -> PortCrossing:
        """The rays behind the second face they meet; those that meet fewer weigh 0."""
        ray = mi.Ray3f(mi.Point3f(origin), direction)
        weight, active = mi.Float(1.0), mi.Bool(True)
        for _ in range(FACES):
            si = self.scene.ray_intersect(ray, active)
            active &= si.is_valid()
            # The numbers drawn decide nothing: there is one lobe, and it is a delta.
            lobe, share = si.bsdf().sample(self.context, si, 0.5, mi.Point2f(0.5), active)
            weight *= share.x
            refracted = si.to_world(lobe.wo)
            ray = mi.Ray3f(si.p + refracted * STEP_MM, refracted)
        return PortCrossing(si.p, ray.d, dr.select(active, weight, 0.0))


class TracedCamera(RefractiveCamera):
    """As ``RefractiveCamera``, its port traced; the port's numbers are compiled in."""

    def make_port(self, port: Port, glass_index: float, water_index: float) -> PortOptics:
        """The port as dielectric geometry.

        Parameters
        ----------
        port : Port, its air gap and its glass
        glass_index, water_index : float, relative to air
        """
        return TracedPort(port_shapes(port, glass_index, water_index))


def port_shapes(port: Port, glass_index: float, water_index: float) -> dict[str, dict[str, Any]]:
    """The port's two faces as Mitsuba dictionaries, camera frame, mm, normals to the water.

    Rectangles for a flat port, analytic spheres for a dome: Mitsuba solves its spheres in
    double precision and puts the hit back on the sphere.
    """
    if isinstance(port, PlanePort):
        near, far = port.gap_mm, port.gap_mm + port.thickness_mm
        rotation = port_rotation(port)
        inner, outer = (rectangle(rotation, at, FLAT_REACH * far) for at in (near, far))
    else:
        sphere = {"type": "sphere", "center": list(port.centre_mm)}
        near, far = port.radius_mm, port.radius_mm + port.thickness_mm
        inner, outer = ({**sphere, "radius": radius} for radius in (near, far))
    return {
        "inner": {**inner, "bsdf": dielectric(1.0, glass_index)},
        "outer": {**outer, "bsdf": dielectric(glass_index, water_index)},
    }


def dielectric(inside: float, outside: float) -> dict[str, Any]:
    """A smooth interface; ``outside`` is the index on the side its normal points to."""
    return {"type": "dielectric", "int_ior": inside, "ext_ior": outside}


def rectangle(rotation: Floats, distance_mm: float, half_side_mm: float) -> dict[str, Any]:
    """A square across the last column of ``rotation``, at ``distance_mm`` along it."""
    to_world = np.eye(4)
    to_world[:3, :3] = rotation * half_side_mm
    to_world[:3, 3] = rotation[:, 2] * distance_mm
    return {"type": "rectangle", "to_world": mi.ScalarTransform4f(to_world)}


mi.register_sensor("traced_camera", TracedCamera)
