"""The board: the map on the sheet, Tables I and II, and how often their intervals are right."""

from collections.abc import Sequence

import numpy as np

from lscan.board import read_board
from lscan.calibration.calibrate import Calibration, calibrate
from lscan.config.board import Board
from lscan.measure import diameters, distances
from lscan.records import BoardReading, Floats, Length, Status
from sim.render.tank import Tank
from sim.scene import Scene
from sim.truth import project
from sim.validation.accuracy.exposures import pictures

STEP_MM = 10.0  # of the grid of places at which the map is judged


def readings(scene: Scene, seeds: Sequence[int]) -> list[BoardReading]:
    """The board of ``scene`` read from one picture for each seed."""
    layers = Tank(scene).render(scene.rig.plan.start_mm)
    return [
        read_board(image, scene.board(), channel=scene.rig.calibration.channel)
        for image in pictures(scene, layers, seeds)
    ]


def calibrations(scene: Scene, seeds: Sequence[int], map_name: str) -> list[Calibration]:
    """The calibrations of the board's readings; map_name: of the plane map that is solved."""
    return [calibrate(reading, map_name, scene.rig.optics) for reading in readings(scene, seeds)]


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


def lengths(board: Board, calibration: Calibration) -> dict[str, Length]:
    """Tables I and II together, of the picture that the calibration was solved from."""
    given = (calibration.reading, board, calibration.plane_map)
    return {**distances(*given), **diameters(*given)}
