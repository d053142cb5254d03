"""A board that does not lie in the sheet: whether uncertainty and check show it."""

from pathlib import Path
from typing import Any

import numpy as np

from lscan.calibration.calibrate import calibrate
from lscan.calibration.check import check_calibration
from sim.scene import Scene
from sim.validation.accuracy.board import map_errors_mm, readings
from sim.validation.accuracy.effort import AccuracyEffort
from sim.validation.accuracy.intervals import COVER
from sim.validation.rows import Row, row

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
