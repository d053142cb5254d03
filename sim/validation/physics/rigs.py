"""Scenes for the checks, built here: the evidence rests on no file that a user may edit."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from lscan.config.documents import Document, merge
from lscan.config.rig import parse_rig
from lscan.errors import InputError
from lscan.records import Floats
from sim.render.plugins.camera import RefractiveCamera
from sim.render.plugins.traced import TracedCamera
from sim.scene import Pose, Scene, scene_of
from sim.water import glass_index

PLUGINS = {RefractiveCamera: "refractive_camera", TracedCamera: "traced_camera"}
BASE: Document = {
    "camera": {"driver": "sim", "width_px": 640, "height_px": 480},
    "track": {"driver": "sim"},
    "lens": {"focal_px": 600.0, "centre_px": [319.5, 239.5]},
    "head": {"camera_mm": [0.0, -700.0, 300.0], "depression_deg": 30.0},
    "port": {"kind": "flat", "gap_mm": 10.0, "thickness_mm": 6.0, "glass_index": 1.49},
    "laser": {"power_mw": 5.0, "apex_mm": [0.0, 0.0, 250.0]},
    "water": {"absorption_per_m": 0.0, "scattering_per_m": 0.0},
    "target": {"shape": "none"},
    "render": {"samples": 9, "scatter_samples": 0},
}


def scene_with(**sections: Document) -> Scene:
    """The base scene with these sections laid over it; InputError where they do not fit."""
    return scene_of(parse_rig(merge(BASE, sections), source="verify", trusted=True))


def random_rig(generator: np.random.Generator, kind: str) -> Scene:
    """A scene with a random lens, head and port of ``kind`` "flat" or "dome".

    Drawn again while its lens would fold the picture.
    """
    while True:
        port = _flat(generator) if kind == "flat" else _dome(generator)
        try:
            return scene_with(lens=_lens(generator), port=port, head=_head(generator))
        except InputError:
            continue


def random_pixels(generator: np.random.Generator, scene: Scene, count: int) -> Floats:
    """(count, 2) places (u, v) all over the picture, px."""
    camera = scene.rig.camera
    return generator.uniform(-0.5, 0.5, (count, 2)) * [camera.width_px, camera.height_px] + [
        (camera.width_px - 1) / 2,
        (camera.height_px - 1) / 2,
    ]


def make_camera(
    kind: type[RefractiveCamera], scene: Scene, water_index: float, pose: Pose
) -> RefractiveCamera:
    """The scene's camera at ``pose``, its port in closed form or traced as ``kind`` says."""
    width, height = picture_size(scene)
    film = {"type": "hdrfilm", "width": width, "height": height, "pixel_format": "luminance"}
    camera = mi.load_dict({"type": PLUGINS[kind], "film": film})
    assert isinstance(camera, kind)
    port = scene.tank.port
    glass = glass_index(port.glass_index, scene.tank.laser.wavelength_nm)
    camera.configure(scene.tank.lens, port, glass, water_index)
    camera.place(pose)
    return camera


def camera_rays(
    camera: RefractiveCamera, scene: Scene, pixels: Floats
) -> tuple[Floats, Floats, Floats]:
    """Origins (N, 3) mm, unit directions (N, 3) and weights (N,) of the rays through pixels.

    pixels: (N, 2) of (u, v).  The frame is that of the camera's pose.
    """
    place = (pixels + 0.5) / np.array(picture_size(scene))
    sample = mi.Point2f(*(mi.Float(column.astype(np.float32)) for column in place.T))
    ray, weight = camera.sample_ray(0.0, 0.0, sample, mi.Point2f(0.5))
    origins, directions = (np.array(vectors, dtype=float).T for vectors in (ray.o, ray.d))
    return origins, directions, np.array(weight, dtype=float).ravel()


def picture_size(scene: Scene) -> tuple[int, int]:
    """(width, height) of the scene's pictures in px."""
    return scene.rig.camera.width_px, scene.rig.camera.height_px


def _lens(generator: np.random.Generator) -> dict[str, Any]:
    k1, k2 = generator.uniform((-0.25, -0.05), (0.15, 0.08))
    p1, p2 = generator.uniform(-2e-3, 2e-3, 2)
    centre = generator.uniform((290.0, 210.0), (350.0, 270.0))
    return {
        "focal_px": float(generator.uniform(500, 1200)),
        "centre_px": centre.tolist(),
        "k1": float(k1),
        "k2": float(k2),
        "p1": float(p1),
        "p2": float(p2),
    }


def _head(generator: np.random.Generator) -> dict[str, Any]:
    return {
        "camera_mm": generator.uniform(-400, 400, 3).tolist(),
        "depression_deg": float(generator.uniform(-20, 60)),
        "heading_deg": float(generator.uniform(-30, 30)),
        "roll_deg": float(generator.uniform(-20, 20)),
    }


def _flat(generator: np.random.Generator) -> dict[str, Any]:
    tilts = generator.uniform(-8, 8, 2)
    return {
        "kind": "flat",
        "gap_mm": float(generator.uniform(2, 60)),
        "thickness_mm": float(generator.uniform(1, 25)),
        "glass_index": float(generator.uniform(1.4, 1.6)),
        "tilt_x_deg": float(tilts[0]),
        "tilt_y_deg": float(tilts[1]),
    }


def _dome(generator: np.random.Generator) -> dict[str, Any]:
    radius = float(generator.uniform(30, 100))
    return {
        "kind": "dome",
        "radius_mm": radius,
        "thickness_mm": float(generator.uniform(1.5, 12)),
        "glass_index": float(generator.uniform(1.4, 1.6)),
        "centre_mm": generator.uniform(-0.15 * radius, 0.15 * radius, 3).tolist(),
    }
