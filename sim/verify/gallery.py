"""One small picture of each scene file, as the webcam would take it."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from lscan.disk import list_names
from lscan.documents import read_document
from lscan.records import Bytes
from sim.scene import Scene, load_scene
from sim.sensor import Webcam
from sim.tank import Tank

SAMPLES = 4
WIDTH_PX = 480
SEED = 97


@dataclass(frozen=True)
class Plate:
    """A picture for the page: its scene's name and file, and the JPEG as a data URI."""

    name: str
    file: str
    uri: str


def gallery(scenes: Path) -> tuple[Plate, ...]:
    """A plate of every scene file beneath ``scenes``; InputError where one is wrong."""
    return tuple(plate(load_scene(path), path.relative_to(scenes)) for path in scene_files(scenes))


def scene_files(scenes: Path) -> list[Path]:
    """The files that describe a whole, named scene; those that only serve others are none."""
    list_names(scenes)  # refuses a folder that is not there
    whole = {"name", "target"}
    return [path for path in sorted(scenes.rglob("*.toml")) if whole <= set(read_document(path))]


def plate(scene: Scene, file: Path) -> Plate:
    """The scene's first picture, few samples a pixel, made small."""
    layers = Tank(scene).render(scene.rig.plan.start_mm, SAMPLES)
    generator = np.random.default_rng(SEED)
    image = Webcam(scene).expose(layers, scene.rig.camera.exposure_ms, generator)
    return Plate(name=scene.rig.name, file=str(file), uri=_thumbnail(image))


def _thumbnail(image: Bytes) -> str:
    height, width = image.shape[:2]
    size = (WIDTH_PX, round(height * WIDTH_PX / width))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    _, encoded = cv2.imencode(".jpg", small[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85])
    return f"data:image/jpeg;base64,{base64.b64encode(encoded.tobytes()).decode('ascii')}"
