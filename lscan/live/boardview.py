"""What the live page says of the calibration board: its marks, residuals, place off the sheet."""

from dataclasses import dataclass

import numpy as np

from lscan.board import read_board
from lscan.calibration.calibrate import calibrate, in_picture, residuals
from lscan.calibration.metric.planemap import Metric
from lscan.calibration.offsheet import LinesOfSight, OffSheet, off_sheet, seen_from
from lscan.calibration.planemap import PlaneMap
from lscan.config.board import Board
from lscan.config.rig import Rig, SheetSection
from lscan.errors import BoardNotFound, LscanError, MeasurementError
from lscan.records import BoardReading, Bytes, Floats

UNCALIBRATED = "how far the board is from the sheet needs a calibration: --calibration FILE"
NO_PLACE = (
    "how far the board is from the sheet needs the camera's place: add [sheet] with camera_mm "
    "(and thickness_mm, apex_mm) to the rig file, or use a metric calibration"
)


@dataclass(frozen=True)
class BoardFigures:
    """The board in one picture.

    found, expected: control points.  message: why the board was not found, "" if it was.
    marks_px: (found, 2).  residual_mm, residual_px: (rms, greatest) of the control points, None
    where there is none.  offset: None where it is not known; offset_message says why.
    """

    found: int
    expected: int
    message: str
    marks_px: Floats
    residual_mm: tuple[float, float] | None = None
    residual_px: tuple[float, float] | None = None
    offset: OffSheet | None = None
    offset_message: str = ""


def read_live_board(
    image: Bytes, board: Board, rig: Rig, plane_map: PlaneMap | None
) -> BoardFigures:
    """The board as seen in ``image``, (H, W) or (H, W, 3) RGB uint8.

    Residuals are those to the current map once the board's pose off the sheet is taken out;
    where that is not known, to the board lying as it was when the map was solved; without a
    map, to the rig's map solved from this picture.  A picture without a board is no error.
    """
    expected = board.grid.rows * board.grid.columns
    try:
        reading = read_board(image, board, channel=rig.calibration.channel)
    except BoardNotFound as error:
        return BoardFigures(0, expected, str(error), np.zeros((0, 2)))
    if not board.grid.whole:
        expected = len(reading.grid.status)
    marks = reading.grid.image_px[reading.grid.found]
    offset, message = None, UNCALIBRATED
    mm = px = np.zeros((0, 2))
    if plane_map is None:
        try:
            solved = calibrate(reading, rig.calibration.plane_map, rig.optics)
            mm, px = solved.residuals_mm, solved.residuals_px
        except LscanError as error:
            message = str(error)
    else:
        offset, message = _offset(reading, plane_map, rig.sheet)
        if offset is None:
            mm, px = residuals(plane_map, reading)
        else:
            mm = offset.residual_mm
            px = in_picture(plane_map, reading.grid.image_px, mm)
    return BoardFigures(
        found=len(marks),
        expected=expected,
        message="",
        marks_px=marks,
        residual_mm=_rms_and_max(mm),
        residual_px=_rms_and_max(px),
        offset=offset,
        offset_message=message,
    )


def _offset(
    reading: BoardReading, plane_map: PlaneMap, sheet: SheetSection | None
) -> tuple[OffSheet | None, str]:
    """The board's offset from the sheet, or None and why that is not known."""
    grid = reading.grid
    points = plane_map.to_plane(grid.image_px, grid.sigma_px)
    if isinstance(plane_map, Metric):
        slope = plane_map.view.slopes(grid.image_px)
        sight = LinesOfSight(slope, np.zeros((*slope.shape, 0)))
    elif sheet is not None:
        sight = seen_from(sheet.camera_mm, points.xz_mm)
    else:
        return None, NO_PLACE
    lattice = grid.board_mm.reshape(*reading.shape, 2)
    corners_mm = lattice[[0, 0, -1, -1], [0, -1, -1, 0]]  # clockwise from the upper left
    try:
        return off_sheet(grid.board_mm, points, sight, corners_mm), ""
    except MeasurementError as error:
        return None, str(error)


def _rms_and_max(pairs: Floats) -> tuple[float, float] | None:
    lengths = np.hypot(*pairs.T)
    lengths = lengths[np.isfinite(lengths)]
    if len(lengths) == 0:
        return None
    return float(np.sqrt(np.mean(lengths**2))), float(lengths.max())
