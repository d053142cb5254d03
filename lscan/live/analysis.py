"""What is measured of one picture for the live page, and how it goes over the wire."""

import json
import struct
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from lscan.board import read_board
from lscan.calibration.calibrate import calibrate, in_picture, residuals
from lscan.calibration.metric.planemap import Metric
from lscan.calibration.offsheet import LinesOfSight, OffSheet, off_sheet, seen_from
from lscan.calibration.planemap import PlaneMap
from lscan.config.board import Board
from lscan.config.rig import Rig, SheetSection, StripeSection
from lscan.errors import BoardNotFound, LscanError, MeasurementError
from lscan.files.pictures import eight_bit, encode_picture
from lscan.records import (
    BoardReading,
    Floats,
    GreyValues,
    Picture,
    PlanePoints,
    Status,
    Stripe,
    has_value,
    status_counts,
)
from lscan.stripe import extract_stripe
from lscan.stripe.peaks import crests, line_width
from lscan.stripe.picture import PictureLines, constant_variance, lines_of

# What is measured of one picture for the live page.


FULL_WIDTH = 2 * np.sqrt(2 * np.log(2))
"""Full width at half height of a Gaussian of unit standard deviation."""

FOCUS_REACH_PX = 24
"""Pixels to either side of the line that its sharpness is measured over."""

BAND_PX = 48
"""Pixels kept to either side of the line: several times its width, so that a column's median
is still that of its background."""

LEAST_LIGHT = 5.0
"""Standard deviations by which the energy of the light must exceed that of the noise."""


@dataclass(frozen=True)
class StripeFigures:
    """The line in one picture.

    width_px: full width at half height of its columns laid over each other; snr: median of
    its peaks over the standard deviation of a dark pixel; slope: px across it for each px along
    it, as :func:`slope_of`.  None where there is no line.
    """

    stripe: Stripe
    width_px: float | None
    snr: float | None
    slope: float | None = None


@dataclass(frozen=True)
class Figures:
    """One picture measured.

    saturated_percent: pixels of the stripe's channel at the end of the camera's range.
    focus: as :func:`sharpness`.  line: None in board mode.  profile: the points of the line, one
    for each of its entries; None without a map.
    """

    saturated_percent: float
    focus: float
    line: StripeFigures | None
    profile: PlanePoints | None


def measure_line(image: Picture, settings: StripeSection, plane_map: PlaneMap | None) -> Figures:
    """The line, the profile and the figures of one picture, (H, W) or (H, W, 3) RGB.

    All but saturation and noise is taken from the band of the picture that holds the line, which is
    quicker; a column's background is then the band's, not the whole column's.
    Raises InputError for another shape or type and for an extractor that cannot be used.
    """
    whole = lines_of(image, settings.channel, settings.axis)
    band = band_of_line(whole.grey, settings.threshold_dn)
    part = image[band] if settings.axis == "columns" else image[:, band]
    stripe = extract_stripe(part, settings)
    grey, at = whole.grey[:, band], np.flatnonzero(has_value(stripe.status))
    variance = constant_variance(whole.grey)
    # About the line's centres, above the median of each column.
    middle = np.rint(stripe.centre_px[at]).astype(np.int64)[:, None]
    rows = middle + np.arange(-FOCUS_REACH_PX, FOCUS_REACH_PX + 1)
    window = grey[at[:, None], np.clip(rows, 0, grey.shape[1] - 1)].astype(np.float64)
    focus = sharpness(window - np.median(grey[at], axis=1, keepdims=True), variance)
    line = StripeFigures(
        stripe=replace(stripe, centre_px=stripe.centre_px + band.start),
        width_px=FULL_WIDTH * line_width(grey, at, crests(grey)[at]) if len(at) else None,
        snr=float(np.median(stripe.peak[at]) / np.sqrt(variance)) if len(at) else None,
        slope=slope_of(stripe.centre_px),
    )
    profile = None
    if plane_map is not None:
        profile = plane_map.to_plane(line.stripe.image_px, line.stripe.sigma_px)
    return Figures(_saturated_percent(whole), focus, line, profile)


def band_of_line(grey: GreyValues, threshold_dn: float) -> slice:
    """The part of the lines (N, L) within BAND_PX of any pixel above the threshold.

    As an extractor does, the median of each line is taken for its background, here that of
    every eighth pixel.  All of it where nothing is above.
    """
    ground = np.median(grey[:, ::8], axis=1, keepdims=True)
    bright = np.flatnonzero((grey > ground + threshold_dn).any(axis=0))
    if len(bright) == 0:
        return slice(0, grey.shape[1])
    return slice(max(int(bright[0]) - BAND_PX, 0), min(int(bright[-1]) + BAND_PX, grey.shape[1]))


def measure_picture(image: Picture, settings: StripeSection) -> Figures:
    """Saturation and focus of a picture without a line, such as the board's."""
    lines = lines_of(image, settings.channel, settings.axis)
    grey = lines.grey.astype(np.float64)
    focus = sharpness(grey - grey.mean(), constant_variance(grey))
    return Figures(_saturated_percent(lines), focus, None, None)


def sharpness(light: Floats, variance: float) -> float:
    """How sharp a picture is: the energy of its gradient over that of its light, in 1000/px².

    light: (N, L) in DN above the ground, differences taken along the last axis.  variance: of
    the noise of a pixel, DN², whose part in both energies is taken off.  0 where the light
    does not exceed the noise.

    The energy of the image gradient is one of the measures of Subbarao, Choi and Nikzad,
    "Focusing techniques", Opt. Eng. 32 (1993) 2824; over the energy of the light it does not
    change with exposure.  A Gaussian line of standard deviation s px has
    2000 (1 - exp(-1 / (4 s²))), about 500 / s².
    """
    if light.size == 0:
        return 0.0
    steps = np.diff(light, axis=-1)
    energy = float(np.vdot(light, light)) - light.size * variance
    if energy <= LEAST_LIGHT * variance * np.sqrt(2 * light.size):
        return 0.0
    rough = float(np.vdot(steps, steps)) - 2 * steps.size * variance
    return 1000 * max(rough, 0.0) / energy


def slope_of(centre_px: Floats) -> float | None:
    """Slope of the straight line through centres (N,), one a column, NaN where there is none.

    The median slope of the pairs of columns half the picture apart: a quarter of the columns
    may hold something else (Sen, "Estimates of the regression coefficient based on Kendall's
    tau", J. Am. Stat. Assoc. 63 (1968) 1379, on fewer pairs).  None where there is no pair.
    """
    apart = len(centre_px) // 2
    rises = centre_px[apart:] - centre_px[: len(centre_px) - apart]
    known = rises[np.isfinite(rises)]
    return float(np.median(known) / apart) if len(known) and apart else None


def _saturated_percent(lines: PictureLines) -> float:
    return 100 * float(lines.clipped.mean())


# What the live page says of the calibration board: its marks, residuals, place off the sheet.


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
    image: Picture, board: Board, rig: Rig, plane_map: PlaneMap | None
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


# What goes over the wire for one picture: its figures as JSON, and the picture as JPEG.
#
# 4 bytes   length of the JSON, big-endian JSON      UTF-8; numbers that are not known are null JPEG
# the picture as the camera sees it


JPEG_QUALITY = 80


def picture_answer(document: dict[str, Any], jpeg: bytes) -> bytes:
    """The answer to a browser that asked for a picture."""
    text = json.dumps(document, allow_nan=False, separators=(",", ":")).encode()
    return struct.pack(">I", len(text)) + text + jpeg


def jpeg_of(image: Picture) -> bytes:
    """The picture, (H, W) grey or (H, W, 3) RGB, as JPEG."""
    return encode_picture(
        eight_bit(image), ".jpg", [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY], where="the live page"
    )


def figures_json(figures: Figures) -> dict[str, Any]:
    """Saturation, focus, stripe and profile."""
    return {
        "saturated_percent": round(figures.saturated_percent, 3),
        "focus": round(figures.focus, 2),
        "stripe": figures.line and _stripe_json(figures.line),
        "profile": figures.profile and _profile_json(figures.profile),
    }


def _stripe_json(line: StripeFigures) -> dict[str, Any]:
    status = line.stripe.status
    return {
        "axis": line.stripe.axis,
        "centre_px": _json_number(line.stripe.centre_px, 2),
        "found": int(has_value(status).sum()),
        "of": len(status),
        "clipped": int((status == Status.SATURATED).sum()),
        "clipped_at": np.flatnonzero(status == Status.SATURATED).tolist(),
        "width_px": _json_number(line.width_px, 2),
        "snr": _json_number(line.snr, 1),
        "slope": _json_number(line.slope, 5),
        "status": status_counts(status),
    }


def _profile_json(profile: PlanePoints) -> dict[str, Any]:
    sigma = profile.sigma_mm[np.isfinite(profile.sigma_mm[:, 1]), 1]
    return {
        "x_mm": _json_number(profile.xz_mm[:, 0], 3),
        "z_mm": _json_number(profile.xz_mm[:, 1], 3),
        "sigma_mm": round(float(np.median(sigma)), 4) if len(sigma) else None,
    }


def board_json(board: BoardFigures, age_s: float) -> dict[str, Any]:
    """The board's reading, ``age_s`` after its picture was taken."""
    rms_mm, _ = board.residual_mm or (None, None)
    rms_px, max_px = board.residual_px or (None, None)
    return {
        "found": board.found,
        "expected": board.expected,
        "message": board.message,
        "marks_px": _json_number(board.marks_px, 2),
        "residual_rms_px": _json_number(rms_px, 4),
        "residual_max_px": _json_number(max_px, 4),
        "residual_rms_mm": _json_number(rms_mm, 4),
        "offset": board.offset and _offset_json(board.offset),
        "offset_message": board.offset_message,
        "age_s": round(age_s, 2),
    }


def _offset_json(offset: OffSheet) -> dict[str, Any]:
    return {
        "distance_mm": _json_number(offset.distance_mm, 3),
        "sigma_mm": _json_number(offset.distance_sigma_mm, 3),
        "tilt_x_deg": _json_number(np.degrees(offset.tilt_x_rad), 4),
        "tilt_x_sigma_deg": _json_number(np.degrees(offset.tilt_x_sigma_rad), 4),
        "tilt_z_deg": _json_number(np.degrees(offset.tilt_z_rad), 4),
        "tilt_z_sigma_deg": _json_number(np.degrees(offset.tilt_z_sigma_rad), 4),
        "corners_mm": _json_number(offset.corners_mm, 3),
    }


def _json_number(values: Floats | float | None, decimals: int) -> Any:
    """A number or an array of any shape in JSON types, None for what is not known."""
    if values is None:
        return None
    numbers = np.round(values, decimals)
    return np.where(np.isnan(numbers), np.array(None), numbers).tolist()


# The greatest sharpness at the head's present position, the reference of the others.


MOVED_MM = 0.1
"""A head within this of where it stood looks at the same place: a track may report it so often
that its readings scatter, and a line does not change within a tenth of a millimetre."""


class BestFocus:
    """The greatest sharpness since the head last moved.

    Another place of the target may be nearer or lit in another way: a best from there is not
    to be reached here, whatever is done to the lens.
    """

    def __init__(self) -> None:
        self._best, self._position_mm = 0.0, None  # type: float, float | None

    def forget(self) -> None:
        """Begin anew."""
        self._best = 0.0

    def among(self, focus: float, position_mm: float | None) -> float:
        """The best up to this picture, taken at ``position_mm``, None where that is not known."""
        if self._has_moved_to(position_mm):
            self._best, self._position_mm = 0.0, position_mm
        self._best = max(self._best, focus)
        return self._best

    def _has_moved_to(self, position_mm: float | None) -> bool:
        if position_mm is None or self._position_mm is None:
            return position_mm is not self._position_mm
        return abs(position_mm - self._position_mm) > MOVED_MM
