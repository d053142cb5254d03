"""The tank: from a scene to radiance, in layers, wherever the head stands."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi
import numpy as np
import trimesh
from numpy.typing import NDArray

from sim.meshes import Part, scene_parts
from sim.plugins.camera import RefractiveCamera
from sim.plugins.integrator import LAYERS, SheetIntegrator
from sim.plugins.sheet import LaserSheet
from sim.scene import Scene, camera_pose, head_pose
from sim.water import water_optics

Radiance = NDArray[np.float32]
W_PER_M2_IN_MW_PER_MM2 = 1e3  # 1 mW/mm2 is 1000 W/m2; scenes are in mW and mm


@dataclass(frozen=True)
class Layers:
    """What reaches the lens, (H, W) float32 each, W/(m2 sr) in the air behind the port.

    direct: laser light reflected by a surface.  scattered: laser light scattered by the
    water (the veil).  ambient: everything that is not the laser's.
    """

    direct: Radiance
    scattered: Radiance
    ambient: Radiance

    @property
    def laser(self) -> Radiance:
        """Direct and scattered light together."""
        return self.direct + self.scattered


class Tank:
    """A scene loaded into Mitsuba; only the head moves, so geometry is built once."""

    def __init__(self, scene: Scene) -> None:
        """Load meshes and plugins; InputError where a mesh cannot be read."""
        self.scene = scene
        tank, camera = scene.tank, scene.rig.camera
        self.water = water_optics(tank.water, tank.laser.wavelength_nm)
        self._camera = mi.load_dict(
            {
                "type": "refractive_camera",
                "film": {
                    "type": "hdrfilm",
                    "width": camera.width_px,
                    "height": camera.height_px,
                    "pixel_format": "luminance",
                    "component_format": "float32",
                    "rfilter": {"type": "box"},
                },
                # Sub-pixel positions on a regular grid: the picture is a smooth function of
                # position, for which the grid converges at once and adds no noise.
                "sampler": {
                    "type": "stratified",
                    "sample_count": tank.render.samples,
                    "jitter": False,
                },
            }
        )
        assert isinstance(self._camera, RefractiveCamera)
        self._camera.configure(tank.lens, tank.port, self.water.index)
        self._sheet = self._make_sheet()
        self.integrator = SheetIntegrator(mi.Properties())
        self.integrator.configure(
            self.water, self._sheet, tank.light.ambient_w_m2_sr / W_PER_M2_IN_MW_PER_MM2
        )
        self.place(scene.rig.plan.start_mm)
        self.mitsuba_scene = mi.load_dict(self._scene_dict())

    def place(self, position_mm: float) -> None:
        """Move the head, camera and laser, to a track position in mm."""
        head = head_pose(self.scene.tank.head, position_mm)
        self._camera.place(head @ camera_pose(self.scene.tank.head))
        if self._sheet is not None:
            self._sheet.place(head)

    def render(self, position_mm: float, samples: int | None = None) -> Layers:
        """The layers seen from a track position; ``samples`` a pixel, the scene's if None."""
        self.place(position_mm)
        image = mi.render(
            self.mitsuba_scene,
            sensor=self._camera,
            integrator=self.integrator,
            spp=samples or self.scene.tank.render.samples,
            seed=self.scene.tank.render.seed,
        )
        channels = np.array(image)[..., -len(LAYERS) :] * np.float32(W_PER_M2_IN_MW_PER_MM2)
        return Layers(*(np.ascontiguousarray(channels[..., k]) for k in range(len(LAYERS))))

    def _make_sheet(self) -> LaserSheet | None:
        if not self.scene.tank.laser.on:
            return None
        sheet = mi.load_dict({"type": "laser_sheet"})
        assert isinstance(sheet, LaserSheet)
        sheet.configure(self.scene.tank.laser, self.water.index)
        return sheet

    def _scene_dict(self) -> dict[str, object]:
        parts = {f"part-{k}": _shape(part) for k, part in enumerate(scene_parts(self.scene))}
        lights = {} if self._sheet is None else {"sheet": self._sheet}
        return {"type": "scene", **parts, **lights}


def _shape(part: Part) -> mi.Mesh:
    """The part as a Mitsuba mesh with a two-sided diffuse surface."""
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(
        {
            "type": "twosided",
            "bsdf": {
                "type": "diffuse",
                "reflectance": {"type": "spectrum", "value": part.albedo},
            },
        }
    )
    mesh = part.mesh
    shape = mi.Mesh(
        part.name,
        vertex_count=len(mesh.vertices),
        face_count=len(mesh.faces),
        has_vertex_normals=part.smooth,
        props=props,
    )
    parameters = mi.traverse(shape)
    parameters["vertex_positions"] = _flat(mesh.vertices)
    parameters["faces"] = mi.UInt32(np.asarray(mesh.faces, dtype=np.uint32).ravel())
    if part.smooth:
        parameters["vertex_normals"] = _flat(mesh.vertex_normals)
    parameters.update()
    return shape


def _flat(vectors: trimesh.caching.TrackedArray) -> mi.Float:
    return mi.Float(np.asarray(vectors, dtype=np.float32).ravel())
