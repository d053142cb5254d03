"""The tank: from a scene to radiance, in layers, wherever the head stands."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np
import trimesh
from numpy.typing import NDArray

from sim.meshes import Part, scene_parts
from sim.plugins.camera import RefractiveCamera
from sim.plugins.integrator import LAYERS, SheetIntegrator
from sim.plugins.sheet import LaserSheet
from sim.scene import Scene, camera_pose, head_pose
from sim.water import Optics, water_optics

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
        tank = scene.tank
        self.water = water_optics(tank.water, tank.laser.wavelength_nm)
        self._camera = self.make_camera()
        self.sheet = self._make_sheet()
        self.integrator = SheetIntegrator(mi.Properties())
        self.integrator.configure(
            self.water, self.sheet, tank.light.ambient_w_m2_sr / W_PER_M2_IN_MW_PER_MM2
        )
        self.place(scene.rig.plan.start_mm)
        self.mitsuba_scene = mi.load_dict(self._scene_dict())

    def make_camera(
        self,
        window: tuple[int, int, int, int] | None = None,
        medium: Mapping[str, Any] | None = None,
        jitter: bool = False,
    ) -> RefractiveCamera:
        """A camera of the scene, the head at track position 0, for any integrator.

        window: (left, top, width, height) px of the picture to render, all of it if None.
        medium: a stock medium to stand in, which integrators of Mitsuba's own need.
        jitter: random sub-pixel positions.  Without it they lie on a regular grid: the
            picture is a smooth function of position, for which the grid converges at once
            and adds no noise.
        """
        section = self.scene.rig.camera
        left, top, width, height = window or (0, 0, section.width_px, section.height_px)
        settings: dict[str, Any] = {
            "type": "refractive_camera",
            "film": {
                "type": "hdrfilm",
                "width": section.width_px,
                "height": section.height_px,
                "crop_offset_x": left,
                "crop_offset_y": top,
                "crop_width": width,
                "crop_height": height,
                "pixel_format": "luminance",
                "component_format": "float32",
                "rfilter": {"type": "box"},
            },
            "sampler": {"type": "stratified", "jitter": jitter},
        }
        if medium is not None:
            settings["medium"] = medium
        camera = mi.load_dict(settings)
        assert isinstance(camera, RefractiveCamera)
        camera.configure(self.scene.tank.lens, self.scene.tank.port, self.water.index)
        head = self.scene.tank.head
        camera.place(head_pose(head, 0.0) @ camera_pose(head))
        return camera

    def place(self, position_mm: float) -> None:
        """Move the head, camera and laser, to a track position in mm."""
        head = head_pose(self.scene.tank.head, position_mm)
        self._camera.place(head @ camera_pose(self.scene.tank.head))
        if self.sheet is not None:
            self.sheet.place(head)

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
        lights = {} if self.sheet is None else {"sheet": self.sheet}
        return {"type": "scene", **parts, **lights}


def stock_medium(water: Optics) -> dict[str, Any]:
    """The water as a stock homogeneous medium: nested blends of its lobes and Rayleigh's."""
    phase: dict[str, Any] = {"type": "rayleigh"}
    share = water.molecular_weight
    weights = (1 - water.molecular_weight) * water.hg_weights
    for weight, g in zip(weights, water.hg_g, strict=True):
        share += weight
        lobe = {"type": "hg", "g": float(g)}
        # blendphase = (1 - w) first + w second
        blend = float(weight / share)
        phase = {"type": "blendphase", "weight": blend, "first": phase, "second": lobe}
    return {
        "type": "homogeneous",
        "sigma_t": water.extinction_per_mm,
        "albedo": water.scattering_per_mm / water.extinction_per_mm,
        "phase": phase,
        "has_spectral_extinction": False,
    }


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
