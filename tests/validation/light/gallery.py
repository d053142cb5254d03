"""One small picture of each scene file, as the webcam would take it."""

import base64
from dataclasses import replace
from math import ceil, sqrt
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from lscan.config.documents import read_document
from lscan.files.disk import list_names
from lscan.files.pictures import encode_picture
from lscan.records import Picture
from sim.render.layers import finer_lens
from sim.render.tank import Tank
from sim.scene import Scene, load_scene
from sim.sensor import Webcam
from tests.validation.rows import Row, ScenePicture, failed_row, row

SAMPLES, QUICK_SAMPLES = 4, 1  # at least, a pixel
# Shown side by side, with light of higher orders gathered and sampled.
BOTH_WAYS = ("harbor", "tank-1ntu", "tank-5ntu", "tank-10ntu")
QUICK_SHRINKING = 8  # of a quick run's pictures, in width and height
WIDTH_PX = 480
SEED = 97


def gallery(scenes: Path, quick: bool = False) -> tuple[list[ScenePicture], list[Row]]:
    """Pictures of all scene files beneath a folder, and the rows that say which there are not.

    Parameters
    ----------
    scenes : Path
        The folder.
    quick : bool
        Pictures an eighth as wide and high, with the fewest samples there are, in the first order
        of light but for those that show both ways of the higher ones: tables of these, one set for
        each water and laser, would take most of the time.

    Raises
    ------
    InputError
        Where there is no such folder.
    """
    plates, failed = [], []
    files = scene_files(scenes)
    for path in files:
        try:
            scene, file = load_scene(path), path.relative_to(scenes)
            if quick and path.stem not in BOTH_WAYS:
                scene = scene.with_tank(render={"scatter_samples": 0})
            plates.append(plate(scene, file, quick))
            if path.stem in BOTH_WAYS:
                for light in ("gathered", "sampled"):
                    shown = plate(scene.with_tank(render={"light": light}), file, quick)
                    name = f"{shown.name}, {light}"
                    plates.append(replace(shown, name=name, compared=True))
        except Exception as error:  # one scene's fault is a row; the others are still shown
            failed.append(failed_row(f"picture of the scene {path.relative_to(scenes)}", error))
    whole = row("scenes-without-picture", len(failed), count=len(files), folder=scenes.name)
    return plates, [whole, *failed]


def scene_files(scenes: Path) -> list[Path]:
    """The files that describe a whole, named scene; those that only serve others are none."""
    list_names(scenes)  # refuses a folder that is not there
    whole = {"name", "target"}
    return [path for path in sorted(scenes.rglob("*.toml")) if whole <= set(read_document(path))]


def plate(scene: Scene, file: Path, quick: bool = False) -> ScenePicture:
    """The scene's first picture, few samples a pixel, made small."""
    if quick:
        scene = shrunk(scene, QUICK_SHRINKING)
    samples = least_samples(QUICK_SAMPLES if quick else SAMPLES, scene.tank.render.fineness)
    layers = Tank(scene).render(scene.rig.plan.start_mm, samples)
    generator = np.random.default_rng(SEED)
    image = Webcam(scene).expose(layers, scene.rig.camera.exposure_ms, generator)
    return ScenePicture(name=scene.rig.name, file=str(file), uri=_thumbnail(image))


def least_samples(wanted: int, fineness: int) -> int:
    """The fewest samples a pixel, ``wanted`` or more, that are a square number in each part.

    fineness: parts a side of each pixel.
    """
    return (fineness * ceil(sqrt(wanted) / fineness)) ** 2


def shrunk(scene: Scene, times: int) -> Scene:
    """The same view in a picture ``times`` smaller in width and height, in px."""
    camera = scene.rig.camera
    update = {"width_px": camera.width_px // times, "height_px": camera.height_px // times}
    rig = scene.rig.model_copy(update={"camera": camera.model_copy(update=update)})
    lens = finer_lens(scene.tank.lens, 1 / times)
    return replace(scene, rig=rig, tank=scene.tank.model_copy(update={"lens": lens}))


def _thumbnail(image: Picture) -> str:
    height, width = image.shape[:2]
    size = (WIDTH_PX, round(height * WIDTH_PX / width))
    small: Any = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    jpeg = encode_picture(small, ".jpg", [cv2.IMWRITE_JPEG_QUALITY, 85])
    return f"data:image/jpeg;base64,{base64.b64encode(jpeg).decode('ascii')}"
