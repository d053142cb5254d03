"""A board that does not lie in the sheet: does anything say so?"""

from typing import Any

import numpy as np

from lscan.board import read_board
from lscan.calibration.check import check_calibration
from lscan.calibration.solve import calibrate
from lscan.records import BoardReading
from sim.render.tank import Tank
from sim.scene import Scene
from sim.validation.accuracy.board import map_errors_mm
from sim.validation.accuracy.exposures import pictures
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


def misaligned_rows(scene: Scene, map_name: str) -> list[Row]:
    """Whether a careful user notices, in either of the two ways there are.

    The uncertainty: a rig file that states how well the board was laid in has intervals
    that hold the error.  The check: a picture of the board laid in well disagrees with the
    calibration of the one laid in badly.
    """
    askew = misaligned(scene)
    badly, well, again = (_read(s, SEED + k) for k, s in enumerate((askew, scene, scene)))
    stated = scene.rig.optics.model_copy(
        update={"board_offset_mm": OFFSET_MM, "board_tilt_deg": TILT_DEG}
    )
    careful = calibrate(badly, map_name, stated)
    error, sigma = map_errors_mm(scene, careful)
    outside = 100 * float(np.mean(np.abs(error) > COVER * sigma))
    believed = calibrate(badly, map_name, scene.rig.optics)
    verdict = check_calibration(believed, well)
    sound = check_calibration(calibrate(well, map_name, scene.rig.optics), again)
    askew_by: dict[str, Any] = {"seed": SEED, "offset_mm": OFFSET_MM, "tilt_deg": TILT_DEG}
    return [
        row("misaligned-intervals", outside, **askew_by),
        row("misaligned-missed", float(verdict.agrees), **askew_by),
        row("aligned-alarms", float(not sound.agrees), seed=SEED),
    ]


def _read(scene: Scene, seed: int) -> BoardReading:
    image = pictures(scene, Tank(scene).render(0.0), [seed])[0]
    return read_board(image, scene.board(), channel=scene.rig.calibration.channel)
