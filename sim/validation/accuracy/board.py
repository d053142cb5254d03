"""The board: the map on the sheet, Tables I and II, and how often their intervals are right."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lscan.board import read_board
from lscan.calibration.solve import Calibration, calibrate
from lscan.config.board import Board
from lscan.measure import diameters, distances
from lscan.records import BoardReading, Floats, Length, Status
from sim.render.tank import Tank
from sim.scene import Scene
from sim.truth import project
from sim.validation.accuracy.exposures import pictures

STEP_MM = 10.0  # of the grid of places at which the map is judged


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
    rig, board = scene.rig, scene.board()
    layers = Tank(scene).render(rig.plan.start_mm)
    images = pictures(scene, layers, seeds)
    readings = [read_board(image, board, channel=rig.calibration.channel) for image in images]
    calibrations = [calibrate(reading, map_name, rig.optics) for reading in readings]
    return Boards(scene, board, tuple(seeds), tuple(readings), tuple(calibrations))


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
    grid = scene.board().grid
    across = np.arange(0.0, (grid.columns - 1) * grid.pitch_mm + STEP_MM / 2, STEP_MM)
    down = -np.arange(0.0, (grid.rows - 1) * grid.pitch_mm + STEP_MM / 2, STEP_MM)
    x, z = np.meshgrid(across, down)
    return np.column_stack([x.ravel(), z.ravel()])


def lengths(boards: Boards) -> list[dict[str, Length]]:
    """Tables I and II together, once for each picture."""
    return [
        {
            **distances(reading, boards.board, calibration.plane_map),
            **diameters(reading, boards.board, calibration.plane_map),
        }
        for reading, calibration in zip(boards.readings, boards.calibrations, strict=True)
    ]
