"""Scenes and layers for the tests of the sensor: flat fields and Gaussian lines."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from places import SCENES

from lscan.records import Bytes, Floats
from sim.render.layers import Layers
from sim.scene import Scene, Sensor, load_scene
from sim.sensor import Webcam

PAPER = SCENES / "paper"
EXPOSURE_MS = 20.0


def sensor_scene(
    size_px: tuple[int, int] = (640, 480),
    lens: Mapping[str, object] | None = None,
    **sensor: object,
) -> Scene:
    """The paper's scene with another sensor; no vignetting and no blur unless ``lens`` says so."""
    scene = load_scene(PAPER / "board.toml")
    width, height = size_px
    camera = scene.rig.camera.model_copy(update={"width_px": width, "height_px": height})
    plain = {"vignetting": 0.0, "blur_px": 0.0, **(lens or {})}
    return replace(
        scene,
        rig=scene.rig.model_copy(update={"camera": camera}),
        tank=scene.tank.model_copy(
            update={
                "sensor": Sensor.model_validate(sensor),
                "lens": scene.tank.lens.model_copy(update=plain),
            }
        ),
    )


def layers_of(scene: Scene, **radiance: float | NDArray[np.floating]) -> Layers:
    """Layers in W/(m2 sr), those that are not given dark; a number stands for a flat field."""
    camera = scene.rig.camera
    dark = np.zeros((camera.height_px, camera.width_px), np.float32)
    names = ("direct", "scattered", "ambient")
    return Layers(*((dark + radiance.get(name, 0.0)).astype(np.float32) for name in names))


def line(scene: Scene, sigma_px: float, peak_e: float, centre_px: Floats) -> Layers:
    """A line of the laser, Gaussian down every column, whose red pixels peak at ``peak_e``."""
    one = Webcam(scene).mean_electrons(layers_of(scene, direct=1.0), EXPOSURE_MS)[0, 0, 0]
    rows = np.arange(scene.rig.camera.height_px)[:, None]
    shape = np.exp(-0.5 * ((rows - centre_px) / sigma_px) ** 2)
    return layers_of(scene, direct=peak_e / float(one) * shape)


def centroids(image: Bytes, black_dn: float) -> Floats:
    """(W,) centroid in px down each column of the red channel, the whole picture its window."""
    signal = image[..., 0].astype(float) - black_dn
    return (signal * np.arange(len(signal))[:, None]).sum(axis=0) / signal.sum(axis=0)
