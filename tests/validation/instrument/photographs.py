"""Real photographs: the dot board, the hand-held chessboards, the laser line with its dark pair.

They are no part of the project: a folder of them is named by ``make validate
PHOTOGRAPHS=FOLDER``.
"""

from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

from lscan.benchmark.methods import time_call
from lscan.board import read_board
from lscan.board.chessboard import read_chessboard
from lscan.calibration.maps.polynomial import box, terms
from lscan.config.board import Board, Grid
from lscan.config.rig import LineChannel, StripeSection
from lscan.files.disk import packaged_table
from lscan.files.pictures import read_picture
from lscan.records import BoardReading, Floats, Mask, Picture, has_value
from lscan.stripe import extract_stripe
from tests.validation.instrument.effort import AccuracyEffort
from tests.validation.rows import Row, measured_rows, row

DOTS = 4380  # to be found, of those that lie wholly in view
# The photograph's pitch is not stated: it is called 1 mm, and a dot is about half as wide.
DOT_BOARD = Board(grid=Grid(columns=100, rows=100, pitch_mm=1.0, dot_diameter_mm=0.5, whole=False))
ORDERS = (5, 7, 9)  # of the polynomials that predict half of the dots from the others
CHESSBOARDS, COLUMNS, ROWS = 16, 11, 6
LINE = packaged_table("tests.validation.instrument", "photographs.toml")["line"]
BY_EYE_PX = 15  # reading error, half the line's width, and steps between corners
END_PX = 5  # rows that near to an end of a piece may go either way


def photograph_rows(folder: Path, scenes: Path, effort: AccuracyEffort) -> list[Row]:
    """Rows of the real photographs in ``folder``; the best groove's extractor reads the line."""
    extractor = effort.best(scenes, "groove").rig.stripe.extractor
    return [
        *measured_rows(
            "dot photograph",
            lambda: dot_rows(folder / "dots" / "dot_pattern_05.jpg", effort.repeats),
        ),
        *measured_rows("chessboard photographs", lambda: chessboard_rows(folder / "webcam")),
        *measured_rows("laser photograph", lambda: line_rows(folder / "webcam", extractor)),
    ]


def dot_rows(path: Path, repeats: int) -> list[Row]:
    """Dots that were missed, the error at held-out dots, and what reading costs.

    The cost is a ratio to OpenCV's own blob detector on the same picture, run in turn.
    """
    image = read_picture(path)
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image
    detector = cv2.SimpleBlobDetector.create()
    read_s, blobs_s = 0.0, 0.0
    for _ in range(repeats):
        seconds, reading = time_call(lambda: read_board(image, DOT_BOARD))
        read_s += seconds
        blobs_s += time_call(lambda: detector.detect(grey))[0]
    found = int(reading.grid.found.sum())
    errors = {order: held_out_rms_px(reading, order) for order in ORDERS}
    best = min(errors, key=lambda order: errors[order])
    return [
        row("dots-missed", max(0.0, float(DOTS - found)), dots=DOTS, found=found),
        row("dots-held-out", errors[best], order=best),
        row("dots-time", read_s / blobs_s, repeats=repeats),
    ]


def held_out_rms_px(reading: BoardReading, order: int) -> float:
    """Rms distance in px of every other dot from where polynomials through the rest put it."""
    grid = reading.grid
    board, image = grid.board_mm[grid.found], grid.image_px[grid.found]
    place = np.rint(board / reading.pitch_mm).astype(int)
    kept = place.sum(axis=1) % 2 == 0  # the black squares of a chessboard
    design = terms(box(board[kept]).apply(board), order)[0]
    solved = np.linalg.lstsq(design[kept], image[kept], rcond=None)[0]
    miss = image[~kept] - design[~kept] @ solved
    return float(np.sqrt(np.mean((miss**2).sum(axis=1))))


def chessboard_rows(folder: Path) -> list[Row]:
    """Reprojection error of the plain camera model on the hand-held chessboards."""
    pictures = [read_picture(folder / f"frame{k}.jpg") for k in range(CHESSBOARDS)]
    marks = [read_chessboard(picture, COLUMNS, ROWS, 1.0) for picture in pictures]
    height, width = pictures[0].shape[:2]
    flat = [np.column_stack([m.board_mm, np.zeros(len(m.board_mm))]) for m in marks]
    rms, *_ = cv2.calibrateCamera(
        [points[m.found].astype(np.float32) for points, m in zip(flat, marks, strict=True)],
        [m.image_px[m.found].astype(np.float32) for m in marks],
        (width, height),
        np.eye(3),
        np.zeros(5),
    )
    return [row("chessboards", float(rms))]


def line_rows(folder: Path, extractor: str) -> list[Row]:
    """Rows of the laser photograph without the line they carry, and rows with one they do not."""
    lit, dark = (read_picture(folder / f"bust_laser_{state}.png") for state in ("on", "off"))
    missed, false = line_faults(lit, dark, extractor)
    return [row("laser-missed", 100 * missed), row("laser-false", float(false))]


def line_faults(
    lit: Picture, dark: Picture | None, extractor: str, channel: LineChannel = "red"
) -> tuple[float, int]:
    """Share of the rows that carry the line without it, and the count of wrong ones.

    Parameters
    ----------
    lit : (H, W, 3) array, uint8, DN, the photograph with the laser on
    dark : array or None, of the same shape, with the laser off
    extractor : str, a stripe extractor
    channel : str, as in ``stripe.channel``
    """
    chosen = StripeSection(axis="rows", extractor=extractor, channel=channel)
    stripe = extract_stripe(lit, chosen, background=dark)
    found = has_value(stripe.status)
    carries, near_end, expected = _by_eye(len(found))
    right = found & (np.abs(stripe.centre_px - expected) <= BY_EYE_PX)
    missed = float(np.mean(~right[carries & ~near_end]))
    false = found & ~right & ~near_end
    return missed, int(false.sum())


def _by_eye(count: int) -> tuple[Mask, Mask, Floats]:
    """(N,) rows that carry the line, rows near the ends of its pieces, and where it is, px."""
    rows = np.arange(count)
    carries, near_end = np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
    expected = np.full(count, np.nan)
    for piece in LINE:
        u, v = np.array(piece, dtype=float).T
        on = (rows >= v[0]) & (rows <= v[-1])
        carries |= on
        expected[on] = np.interp(rows[on], v, u)
        near_end |= (np.abs(rows - v[0]) <= END_PX) | (np.abs(rows - v[-1]) <= END_PX)
    for start, end in pairwise(LINE):
        if start[-1][1] + 2 * END_PX >= end[0][1]:
            near_end |= (rows > start[-1][1]) & (rows < end[0][1])
    return carries, near_end, expected
