"""The board drawn to be printed, and a picture with all that was found of it."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from lscan.board.picture import bright_marks
from lscan.board.search import BOX, local_pitch
from lscan.config.board import Board
from lscan.records import BoardReading, Bytes, Floats

# A calibration board as a drawing at its true size, for a printer or a milling machine.

CHECK_BAR_MM = 100.0
STRIP_MM = 15.0  # beneath the plate, for the bar
PAPER, INK = "#ffffff", "#000000"


def board_svg(board: Board) -> str:
    """SVG of the board's face, one unit a millimetre, as large as the plate and a strip beneath.

    The strip holds a bar of 100 mm (of the plate's width, where that is less) by which a print
    can be checked with a ruler, since printers may scale.  Marks of a bright-dot board are white
    on black.

    Parameters
    ----------
    board : Board, mm, its plate and marks
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined  # who reads boards needs none

    left, right, bottom, top = board.outline_mm()
    plate, mark = (PAPER, INK) if board.marks == "dark" else (INK, PAPER)
    environment = Environment(
        loader=PackageLoader("lscan.board", ""),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters["mm"] = _mm
    return environment.get_template("plate.svg.j2").render(
        board=board,
        left=left,
        top=top,
        width=right - left,
        height=top - bottom,
        strip=STRIP_MM,
        plate=plate,
        mark=mark,
        ink=INK,
        bar=min(CHECK_BAR_MM, right - left),
        bar_y=STRIP_MM / 2 - bottom,
    )


def _mm(value: float) -> str:
    """The number without a tail: a micrometre is finer than any printer."""
    return f"{round(float(value), 4) + 0.0:.10g}"


# The picture with all that was found drawn into it: the counterpart of Fig. 12.


Colour = tuple[int, int, int]
CONTROL_POINT: Colour = (230, 30, 30)
SEED: Colour = (255, 190, 0)
SEARCH_BOX: Colour = (120, 120, 255)
RULER: Colour = (0, 150, 70)
DOT: Colour = (200, 0, 200)
RING: Colour = (0, 140, 230)
SUBPIXEL_BITS = 4


def draw_overlay(image: NDArray[Any], reading: BoardReading) -> Bytes:
    """(H, W, 3) RGB: the picture with an x on each control point found (Fig. 12).

    Boxes show where each point was searched; those of dots #1, #2 and #3 are numbered.
    Ruler marks are small crosses, named dots circles, ring points small dots.

    Parameters
    ----------
    image : (H, W) or (H, W, 3) array, grey or RGB, the picture that was read; floats are spread to
        0 to 255
    reading : BoardReading, px, of that picture

    Raises
    ------
    InputError
        For what is no picture.
    """
    canvas = _canvas(image)
    lattice = reading.grid.image_px.reshape(*reading.shape, 2)
    pitch = local_pitch(lattice)
    _draw_boxes(canvas, lattice, pitch)
    arm = float(np.clip(np.nanmedian(pitch) / 10, 2, 8)) if np.isfinite(pitch).any() else 4.0
    _crosses(canvas, reading.grid.image_px, np.array([[arm, arm], [arm, -arm]]), CONTROL_POINT)
    for ruler in reading.rulers:
        _crosses(canvas, ruler.marks.image_px, 2 * np.eye(2), RULER)
    for dot in reading.dots.values():
        _circles(canvas, dot.image_px[None], 4.0, DOT)
    for ring in reading.rings.values():
        _circles(canvas, ring.image_px, 0.7, RING)
    return canvas


def _canvas(image: NDArray[Any]) -> Bytes:
    array = np.asarray(image)
    if array.dtype != np.uint8:
        grey = bright_marks(array, "grey", "bright")
        array = (255 * (grey - grey.min()) / max(float(np.ptp(grey)), 1e-6)).astype(np.uint8)
    bright_marks(array, "grey", "bright")  # refuses what is not a picture
    return np.ascontiguousarray(np.stack([array] * 3, axis=-1) if array.ndim == 2 else array.copy())


def _draw_boxes(canvas: Bytes, lattice: Floats, pitch: Floats) -> None:
    for point, size in zip(lattice.reshape(-1, 2), pitch.ravel(), strict=True):
        if np.isfinite(size) and np.isfinite(point[0]):
            _box(canvas, point, BOX * size, SEARCH_BOX)
    for number, (row, column) in enumerate([(0, 0), (1, 0), (0, 1)], start=1):
        point, size = lattice[row, column], pitch[row, column]
        if np.isfinite(size) and np.isfinite(point[0]):
            _box(canvas, point, 1.3 * BOX * size, SEED)
            corner = np.rint(point + 1.4 * BOX * size).astype(int)
            place = (int(corner[0]), int(corner[1]))
            font = cv2.FONT_HERSHEY_SIMPLEX
            cv2.putText(canvas, f"#{number}", place, font, 0.4, SEED, 1, cv2.LINE_AA)


def _known_points(points: Floats) -> Floats:
    return points[np.isfinite(points).all(axis=-1)]


def _fixed_point(point: Floats) -> tuple[int, int]:
    u, v = np.rint(np.asarray(point) * 2**SUBPIXEL_BITS).astype(int)
    return int(u), int(v)


def _crosses(canvas: Bytes, points: Floats, halves: Floats, colour: Colour) -> None:
    for point in _known_points(points):
        for half in halves:
            ends = _fixed_point(point - half), _fixed_point(point + half)
            cv2.line(canvas, *ends, colour, 1, cv2.LINE_AA, SUBPIXEL_BITS)


def _box(canvas: Bytes, middle: Floats, half: float, colour: Colour) -> None:
    first, last = _fixed_point(middle - half), _fixed_point(middle + half)
    cv2.rectangle(canvas, first, last, colour, 1, cv2.LINE_AA, SUBPIXEL_BITS)


def _circles(canvas: Bytes, points: Floats, radius: float, colour: Colour) -> None:
    size = round(radius * 2**SUBPIXEL_BITS)
    for point in _known_points(points):
        cv2.circle(canvas, _fixed_point(point), size, colour, 1, cv2.LINE_AA, SUBPIXEL_BITS)
