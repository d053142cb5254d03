"""Chessboards with slivers of further squares at the rim, and cameras with oblong pixels."""

from pathlib import Path

import numpy as np

from lscan.board.chessboard import read_chessboard
from lscan.calibration.metric.solve import calibrate_metric
from lscan.calibration.metric.views import CalibrationView, LinePoints
from lscan.config.rig import OpticsSection
from lscan.errors import BoardNotFound, MeasurementError
from lscan.records import Floats, Marks, Status
from sim.render.tank import Tank
from sim.scene import into_head, load_scene, target_pose
from sim.truth import project
from sim.validation.accuracy.exposures import pictures
from sim.validation.field.drawn import DrawnView, chessboard_grey, photographed
from sim.validation.field.effort import FieldEffort
from sim.validation.rows import Row, row

INNER = (6, 9)  # rows, columns
SQUARE_MM = 20.0
CORNER_PX = 0.5  # a corner farther off is another one
MIDDLE_MM = (80.0, -50.0)
TANK_CORNER_MM = (26.0, 130.0)  # the first inner corner on the plate of field/chessboard.toml

SIZE = (640, 480)
VIEWS, LINE_POINTS = 9, 60
NOISE_PX = 0.03
HEIGHTS = (1.0, 0.75, 1.0, 1.25, 1.0, 0.97, 1.0, 4 / 3)  # of pixels, over their width
FOCAL_PX, RIGHT_FOCAL = 703.0, 0.005  # and by what part of it a solution may be off
# The sheet q . X = 1 of the camera frame: half a metre away, leaning by 30 degrees.
SHEET_PER_MM = np.array([0.0, np.tan(np.radians(30.0)), 1.0]) / 500.0


def sliver_rows(effort: FieldEffort) -> list[Row]:
    """Share of the corners read that are the right ones, and of the boards that are read."""
    right, read, found = 0, 0, 0
    for seed in effort.seeds:
        rng = np.random.default_rng(seed)
        turn = (*rng.uniform(-30, 30, 2), rng.uniform(-15, 15))
        view = DrawnView((960, 720), 1000.0, rng.uniform(280, 420), MIDDLE_MM, turn, 0.1)
        slivers = rng.uniform(0.05, 0.6, 4) * (rng.random(4) < 0.7)
        left, right_side, top, bottom = slivers.tolist()
        edges = (left, right_side, top, bottom)
        grey = chessboard_grey(view, INNER, SQUARE_MM, edges, 0.9)
        picture = photographed(0.1 + 0.8 * grey, 3.0, rng, 0.7)
        try:
            marks = read_chessboard(picture, INNER[1], INNER[0], SQUARE_MM)
        except BoardNotFound:
            continue
        found += 1
        right += _right(marks, view.image_px(marks.board_mm))
        read += int(marks.found.sum())
    share = 100 * right / read if read else 100.0
    return [
        row("chess-slivers", share, boards="drawn boards", corners=read, seeds=effort.seeded),
        row("chess-found", 100 * found / len(effort.seeds), seeds=effort.seeded),
    ]


def tank_chessboard_row(scenes: Path, effort: FieldEffort) -> Row:
    """Share of the corners read that are the right ones, of the chessboard in the tank.

    The laser's line runs across a row of its corners.
    """
    scene = load_scene(scenes / "field" / "chessboard.toml")
    right, read = 0, 0
    for picture in pictures(scene, Tank(scene).render(0.0), effort.seeds):
        marks = read_chessboard(picture, INNER[1], INNER[0], SQUARE_MM)
        on_plate = np.pad(TANK_CORNER_MM + marks.board_mm, ((0, 0), (0, 1)))
        places = into_head(scene.tank.head, target_pose(scene).apply(on_plate), 0.0)
        right += _right(marks, project(scene, places))
        read += int(marks.found.sum())
    share = 100 * right / read
    what = "a board of the tank"
    return row("chess-slivers", share, boards=what, corners=read, seeds=effort.seeded)


def _right(marks: Marks, truth_px: Floats) -> int:
    """How many corners lie where the truth has them, counted from either end of the board."""
    turned = truth_px[::-1] if _far(marks, truth_px[::-1]).mean() < 0.5 else truth_px
    return int((_far(marks, turned) == 0).sum())


def _far(marks: Marks, truth_px: Floats) -> Floats:
    """(K,) 1 for each corner found that is far from its true place, else 0."""
    miss = np.hypot(*(marks.image_px - truth_px)[marks.found].T)
    return (miss > CORNER_PX).astype(float)


def squeezed_row(effort: FieldEffort) -> Row:
    """Share of the cameras solved right, or refused where their pixels are not square."""
    good = 0
    for number, seed in enumerate(effort.seeds):
        height = HEIGHTS[number % len(HEIGHTS)]
        views = _views(height, np.random.default_rng(seed))
        size = (SIZE[0], round(SIZE[1] / height))
        try:
            solved = calibrate_metric(views, OpticsSection(port="none"), size)
        except MeasurementError as refusal:
            good += height != 1.0 and "not square" in str(refusal)
            continue
        focal = solved.plane_map.view.theta[0]
        good += height == 1.0 and abs(focal / FOCAL_PX - 1) < RIGHT_FOCAL
    return row("pixels-oblong", 100 * good / len(effort.seeds), seeds=effort.seeded)


def _views(height: float, rng: np.random.Generator) -> list[CalibrationView]:
    """Marks and laser lines on a board in several poses; height: of a pixel, over its width."""
    views = []
    for number in range(VIEWS):
        side = 2 * np.pi * (number + rng.uniform(-0.3, 0.3)) / VIEWS
        tilt = rng.uniform(20, 35)
        turn = (tilt * np.cos(side), tilt * np.sin(side), rng.uniform(-10, 10))
        view = DrawnView(SIZE, FOCAL_PX, rng.uniform(450, 550), MIDDLE_MM, turn, 0.05)
        column, row_ = np.meshgrid(np.arange(INNER[1]), np.arange(INNER[0]))
        corners = SQUARE_MM * np.column_stack([column.ravel(), -row_.ravel()]).astype(np.float64)
        line = view.line_mm(SHEET_PER_MM, np.linspace(-20.0, 180.0, LINE_POINTS))
        on_board, on_line = (
            (view.image_px(places) + NOISE_PX * rng.standard_normal(places.shape)) / [1.0, height]
            for places in (corners, line)
        )
        sigma = np.full(len(corners), NOISE_PX)
        status = np.full(len(corners), int(Status.OK), dtype=np.int64)
        marks = Marks(corners, on_board, sigma, status)
        stripe = LinePoints(on_line, np.full(len(line), NOISE_PX), "columns")
        views.append(CalibrationView(f"pose-{number}", marks, stripe))
    return views
