"""The board: the map on the sheet, Tables I and II, and how often their intervals are right."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lscan.board import read_board
from lscan.calibration.calibrate import Calibration, calibrate
from lscan.calibration.check import check_calibration
from lscan.config.board import Board
from lscan.measure import diameters, distances
from lscan.records import BoardReading, Floats, Length, Status
from sim.render.tank import Tank
from sim.scene import Scene
from sim.truth import project
from tests.validation.exposures import COVER, pictures
from tests.validation.instrument.effort import AccuracyEffort
from tests.validation.rows import Row, row

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


# A board that does not lie in the sheet: whether uncertainty and check show it.


OFFSET_MM, TILT_DEG = 2.0, 0.5
SEED = 51


def misaligned(scene: Scene) -> Scene:
    """The board's middle 2 mm behind the sheet, and the board leant by half a degree."""
    _, _, bottom, top = scene.board().outline_mm()
    lean = np.radians(TILT_DEG)
    # The board is turned about O, which swings its middle out of the sheet.
    swung_mm = float(-(bottom + top) / 2 * np.sin(lean))
    update = {"position_mm": (0.0, OFFSET_MM - swung_mm, 0.0), "tilt_x_deg": TILT_DEG}
    return scene.with_tank(target=update)


def misaligned_rows(scenes: Path, effort: AccuracyEffort) -> list[Row]:
    """Whether the uncertainty holds the error, and whether ``lscan check`` notices it.

    The uncertainty: where the rig file states how well the board was aligned, the intervals hold
    the error.  The check: a picture of the aligned board disagrees with the calibration of the
    misaligned one, and not with that of another picture of the aligned one.
    """
    scene = effort.best(scenes, "board")
    map_name, optics = effort.map_name(scene), scene.rig.optics
    (wrong,), (right, again) = (
        readings(misaligned(scene), [SEED]),
        readings(scene, [SEED + 1, SEED + 2]),
    )
    alignment = {"board_offset_mm": OFFSET_MM, "board_tilt_deg": TILT_DEG}
    stated = calibrate(wrong, map_name, optics.model_copy(update=alignment))
    error, sigma = map_errors_mm(scene, stated)
    outside = 100 * float(np.mean(np.abs(error) > COVER * sigma))
    missed = check_calibration(calibrate(wrong, map_name, optics), right).agrees
    alarm = not check_calibration(calibrate(right, map_name, optics), again).agrees
    words: dict[str, Any] = {"seed": SEED, "offset_mm": OFFSET_MM, "tilt_deg": TILT_DEG}
    return [
        row("misaligned-intervals", outside, **words),
        row("misaligned-missed", float(missed), **words),
        row("aligned-alarms", float(alarm), seed=SEED),
    ]
