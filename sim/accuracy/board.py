"""The board: the map on the sheet, Tables I and II, and how often their intervals are right."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lscan.board import Board
from lscan.controlpoints import read_board
from lscan.measure import diameters, distances
from lscan.planemap.calibration import Calibration, calibrate
from lscan.records import BoardReading, Floats, Measured, Status
from sim.accuracy.exposures import pictures
from sim.scene import Scene
from sim.sensor.blur import point_spread
from sim.tank import Layers, Tank
from sim.truth import project

STEP_MM = 10.0  # of the grid of places at which the map is judged
PARTS = 3  # of a pixel's side in which the light is blurred


@dataclass(frozen=True)
class Boards:
    """The board of a scene, photographed with many seeds and read.

    seeds, readings, calibrations: one each, in the same order.
    """

    scene: Scene
    board: Board
    seeds: tuple[int, ...]
    readings: tuple[BoardReading, ...]
    calibrations: tuple[Calibration, ...]


def photograph(scene: Scene, seeds: Sequence[int], map_name: str) -> Boards:
    """The board of ``scene``, its calibration by ``map_name`` solved from each picture."""
    rig, board = scene.rig, scene.rig.board
    assert board is not None
    images = pictures(*_blurred_in_parts(scene), seeds)
    readings = [read_board(image, board, channel=rig.calibration.channel) for image in images]
    calibrations = [calibrate(reading, map_name, rig.optics) for reading in readings]
    return Boards(scene, board, tuple(seeds), tuple(readings), tuple(calibrations))


def _blurred_in_parts(scene: Scene) -> tuple[Scene, Layers]:
    """The scene with a lens that does not blur, and the light that its own lens has blurred.

    A lens blurs before the pixels sum the light up.  Blurred after that, a disc of radius r px
    is displaced by 2 J1(2 pi r) / (2 pi r) / pi sin(2 pi u) px, u the place of its middle in a
    pixel: the sum over whole pixels aliases its edge (frequency 1 / px of the disc's spectrum).
    For marks of 2 px that is 0.02 px.  A blur of 0.7 px beforehand leaves 6e-5 of it, so the
    picture is rendered with a third of the pixels' side, blurred, and summed up.  The scene's
    samples a pixel are shared out among its parts.
    """
    rig, tank = scene.rig, scene.tank
    camera, lens, sensor = rig.camera, tank.lens, tank.sensor
    width, height = PARTS * camera.width_px, PARTS * camera.height_px
    middle_px = [PARTS * (middle + 0.5) - 0.5 for middle in lens.centre_px]
    fine_lens = lens.model_copy(
        update={
            "focal_px": PARTS * lens.focal_px,
            "centre_px": middle_px,
            "blur_px": PARTS * lens.blur_px,
            "glare": 0.0,
        }
    )
    fine_camera = camera.model_copy(update={"width_px": width, "height_px": height})
    fine_sensor = sensor.model_copy(update={"pixel_um": sensor.pixel_um / PARTS})
    fine = replace(
        scene,
        rig=rig.model_copy(update={"camera": fine_camera}),
        tank=tank.model_copy(update={"lens": fine_lens, "sensor": fine_sensor}),
    )
    samples = max(1, round(tank.render.samples**0.5 / PARTS)) ** 2
    light = Tank(fine).render(rig.plan.start_mm, samples)

    def of_pixels(layer: NDArray[np.float32]) -> NDArray[np.float32]:
        blurred = point_spread(layer, fine_lens)
        parts = blurred.reshape(camera.height_px, PARTS, camera.width_px, PARTS)
        mean: NDArray[np.float32] = parts.mean(axis=(1, 3))
        return mean

    layers = Layers(of_pixels(light.direct), of_pixels(light.scattered), of_pixels(light.ambient))
    sharp = replace(
        scene, tank=tank.model_copy(update={"lens": lens.model_copy(update={"blur_px": 0.0})})
    )
    return sharp, layers


def map_errors_mm(scene: Scene, calibration: Calibration) -> tuple[Floats, Floats]:
    """(N, 2) error of the map in x and z over the covered sheet, and (N, 2) its sigma, mm.

    At places every 10 mm of the board, each at the pixel where the truth says it is seen.
    """
    places = _places(scene)
    head = np.column_stack([places[:, 0], np.zeros(len(places)), places[:, 1]])
    answer = calibration.plane_map.to_plane(project(scene, head))
    known = answer.status == Status.OK
    return answer.xz_mm[known] - places[known], answer.sigma_mm[known]


def _places(scene: Scene) -> Floats:
    board = scene.rig.board
    assert board is not None
    grid = board.grid
    across = np.arange(0.0, (grid.columns - 1) * grid.pitch_mm + STEP_MM / 2, STEP_MM)
    down = -np.arange(0.0, (grid.rows - 1) * grid.pitch_mm + STEP_MM / 2, STEP_MM)
    x, z = np.meshgrid(across, down)
    return np.column_stack([x.ravel(), z.ravel()])


def lengths(boards: Boards) -> list[dict[str, Measured]]:
    """Tables I and II together, once for each picture."""
    return [
        {
            **distances(reading, boards.board, calibration.plane_map),
            **diameters(reading, boards.board, calibration.plane_map),
        }
        for reading, calibration in zip(boards.readings, boards.calibrations, strict=True)
    ]
