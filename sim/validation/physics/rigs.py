"""Scenes for the checks, built here: the evidence rests on no file that a user may edit."""

from collections.abc import Mapping
from typing import Any

import mitsuba as mi
import numpy as np

from lscan.config.documents import Document, merge
from lscan.config.rig import parse_rig
from lscan.errors import InputError
from lscan.files.disk import packaged_table
from lscan.records import Floats
from sim.render.plugins.arrays import floats
from sim.render.plugins.camera import RefractiveCamera
from sim.render.plugins.traced import TracedCamera
from sim.scene import Pose, Scene, scene_of
from sim.water import glass_index

PLUGINS = {RefractiveCamera: "refractive_camera", TracedCamera: "traced_camera"}
SCENES = packaged_table("sim.validation.physics", "scenes.toml")
RANDOM = SCENES["random"]


def scene_with(name: str = "base", **sections: Document) -> Scene:
    """The scene of that name in scenes.toml with these sections laid over it.

    InputError where they do not fit.
    """
    document = merge(merge(SCENES["base"], SCENES[name]), sections)
    return scene_of(parse_rig(document, source="verify", trusted=True))


def drawn(generator: np.random.Generator, ranges: Mapping[str, Any]) -> dict[str, Any]:
    """A value for each key: uniform between two bounds, a list where there is a list of them."""
    values = {key: generator.uniform(*np.array(pair).T) for key, pair in ranges.items()}
    return {key: np.asarray(value).tolist() for key, value in values.items()}


def random_rig(generator: np.random.Generator, kind: str) -> Scene:
    """A scene with a random lens, head and port of ``kind`` "flat" or "dome".

    Drawn again while its lens would fold the picture.
    """
    while True:
        port = {"kind": kind, **drawn(generator, RANDOM[kind])}
        if kind == "dome":
            radius = port["radius_mm"]
            port |= drawn(generator, {"centre_mm": [(-0.15 * radius, 0.15 * radius)] * 3})
        try:
            lens, head = (drawn(generator, RANDOM[name]) for name in ("lens", "head"))
            return scene_with(lens=lens, port=port, head=head)
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
    sample = mi.Point2f(*map(floats, place.T))
    ray, weight = camera.sample_ray(0.0, 0.0, sample, mi.Point2f(0.5))
    origins, directions = (np.array(vectors, dtype=float).T for vectors in (ray.o, ray.d))
    return origins, directions, np.array(weight, dtype=float).ravel()


def picture_size(scene: Scene) -> tuple[int, int]:
    """(width, height) of the scene's pictures in px."""
    return scene.rig.camera.width_px, scene.rig.camera.height_px
