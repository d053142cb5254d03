"""Boards as photographs show them: large, in a penumbra, misread in places, cut, squeezed."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from lscan.benchmark.drawn import BOARDS, OPTICS, image_px, reading_of
from lscan.board import read_board
from lscan.board.chessboard import read_chessboard
from lscan.calibration.calibrate import Calibration, calibrate
from lscan.calibration.marks import without
from lscan.calibration.metric.solve import calibrate_metric
from lscan.calibration.metric.views import CalibrationView, LinePoints
from lscan.config.board import Board, Grid
from lscan.config.rig import OpticsSection
from lscan.errors import BoardNotFound, MeasurementError
from lscan.files.pictures import write_picture
from lscan.records import BoardReading, Floats, Marks, Mask, Status
from sim.render.tank import Tank
from sim.scene import into_head, load_scene, target_pose
from sim.truth import board_truth, project
from tests.validation.exposures import pictures
from tests.validation.rows import Row, measured_rows, row
from tests.validation.surfaces import largeboard
from tests.validation.surfaces.drawn import (
    DrawnView,
    FieldEffort,
    chessboard_grey,
    dots_cover,
    photographed,
)

# Chessboards with slivers of further squares at the rim, and cameras with oblong pixels.


ROOT = Path(__file__).resolve().parents[3]
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


# Boards as photographs show them: large, in a penumbra, misread in places, cut, squeezed.


LARGE_VIEW = DrawnView((2560, 2160), 3000.0, 790.0, (295.0, -245.0), (8.0, -6.0, 2.0), 0.08)
SMALL_VIEW = DrawnView((640, 540), 3000.0, 790.0, (70.0, -55.0), (8.0, -6.0, 2.0), 0.08)
LARGE_S = {"polynomial-5": 3.0, "spline": 3.0, "auto": 20.0}

SHADED = Board(grid=Grid(columns=40, rows=30, pitch_mm=10.0, dot_diameter_mm=5.0, whole=False))
SHADED_VIEW = DrawnView((800, 600), 900.0, 500.0, (195.0, -145.0), (10.0, 5.0, 2.0), 0.05)
RIGHT_PX, RIGHT_SIGMAS = 0.1, 4.0  # off its place: what the steep light may do, and noise

WRONG_PART, WRONG_PX = 0.03, (1.0, 5.0)  # of the marks, and how far off
PLACES = 1000


def board_rows(scenes: Path, effort: FieldEffort) -> list[Row]:
    """The rows of boards as photographs show them, drawn or in the tank of the scene files."""
    return [
        *measured_rows("large dot board", lambda: large_rows(effort)),
        *measured_rows("dot board in a penumbra", lambda: [penumbra_row(effort)]),
        *measured_rows("penumbra in the tank", lambda: [tank_penumbra_row(scenes, effort)]),
        *measured_rows("wrong marks", lambda: wrong_mark_rows(effort)),
        *measured_rows("chessboards with slivers", lambda: sliver_rows(effort)),
        *measured_rows("chessboard in the tank", lambda: [tank_chessboard_row(scenes, effort)]),
        *measured_rows("pixels that are not square", lambda: [squeezed_row(effort)]),
    ]


def large_rows(effort: FieldEffort) -> list[Row]:
    """Seconds from the file of a picture of 5.5 million pixels to the file of its calibration.

    Of processor time, with one thread for linear algebra, in a process of its own: other chapters
    run beside this one, and the clock would count their work.
    """
    board, view = (largeboard.SMALL, SMALL_VIEW) if effort.plain else (largeboard.LARGE, LARGE_VIEW)
    grid = board.grid
    cover = dots_cover(view, (grid.rows, grid.columns), 10.0, 5.0, 0.8)
    picture = photographed(0.9 - 0.8 * cover, 2.0, np.random.default_rng(1))
    rows = []
    with TemporaryDirectory() as name:
        file = Path(name) / "board.png"
        write_picture(file, picture)
        for plane_map, bar in LARGE_S.items():
            arguments = f"({str(file)!r}, {plane_map!r}, {effort.plain})"
            call = (
                f"import sys; sys.path.insert(0, {str(ROOT)!r}); "
                f"from {largeboard.__name__} import calibrate_large; calibrate_large{arguments}"
            )
            one_thread = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
            seconds = subprocess.check_output([sys.executable, "-c", call], env=one_thread)
            rows.append(row("board-large", float(seconds), bar=bar, plane_map=plane_map))
    return rows


def penumbra_row(effort: FieldEffort) -> Row:
    """Share of the dots read, of a board with one side in the dark, that are where they are."""
    right, read = 0, 0
    for seed in effort.seeds:
        rng = np.random.default_rng(seed)
        u = SHADED_VIEW.pixels()[..., 0]
        light = 1 / (1 + np.exp((u - rng.uniform(350, 550)) / rng.uniform(15, 60)))
        cover = dots_cover(SHADED_VIEW, (30, 40), 10.0, 5.0, 0.8)
        picture = photographed(light * (0.9 - 0.7 * cover), rng.uniform(1, 3), rng, 1.5)
        reading = read_board(picture, SHADED)
        near = _near_its_dot(reading, SHADED_VIEW)
        right, read = right + int(near.sum()), read + len(near)
    share = 100 * right / read
    return row("board-penumbra", share, boards="drawn boards", dots=read, seeds=effort.seeded)


def tank_penumbra_row(scenes: Path, effort: FieldEffort) -> Row:
    """The same of the paper's board in the tank, one side in the shadow."""
    scene = load_scene(scenes / "field" / "penumbra.toml").with_tank(render={"samples": 16})
    assert scene.rig.board is not None
    truth = board_truth(scene, 0.0).centres.grid
    right, read = 0, 0
    for picture in pictures(scene, Tank(scene).render(0.0), effort.seeds):
        grid = read_board(picture, scene.rig.board).grid
        miss = np.hypot(*(grid.image_px - truth.image_px)[grid.found].T)
        right += int((miss <= RIGHT_PX + RIGHT_SIGMAS * grid.sigma_px[grid.found]).sum())
        read += int(grid.found.sum())
    what, share = "a board of the tank", 100 * right / read
    return row("board-penumbra", share, boards=what, dots=read, seeds=effort.seeded)


def _near_its_dot(reading: BoardReading, view: DrawnView) -> Mask:
    """(N,) mask of the dots found that lie where the truth has them.

    Which dot was taken for the first one is what most of them say.
    """
    found = reading.grid.found
    index = np.rint(reading.grid.board_mm[found] / reading.pitch_mm)
    seen = np.rint(view.board_mm(reading.grid.image_px[found]) / reading.pitch_mm)
    shift = np.median(seen - index, axis=0)
    true_px = view.image_px((index + shift) * reading.pitch_mm)
    miss = np.hypot(*(reading.grid.image_px[found] - true_px).T)
    near: Mask = miss <= RIGHT_PX + RIGHT_SIGMAS * reading.grid.sigma_px[found]
    return near


def wrong_mark_rows(effort: FieldEffort) -> list[Row]:
    """How many wrong marks are named, and the map's error beside that of a board without them."""
    named = {"hit": 0, "false": 0, "wrong": 0}
    errors: dict[str, list[tuple[float, float]]] = {"spline": [], "polynomial-5": []}
    for seed in effort.seeds:
        for label in ("paper", "dense"):
            rng = np.random.default_rng([seed, len(label)])
            sound = reading_of(BOARDS[label], 0.02, rng)
            wrong, faulty = _spoilt(sound, rng)
            on_rulers = sum(len(ruler.marks.status) for ruler in sound.rulers)
            left_out = without(sound, np.concatenate([wrong, np.zeros(on_rulers, dtype=bool)]))
            places = sound.grid.board_mm.min(axis=0) + rng.random((PLACES, 2)) * np.ptp(
                sound.grid.board_mm, axis=0
            )
            for plane_map, pairs in errors.items():
                solved = calibrate(faulty, plane_map, OPTICS)
                clean = calibrate(left_out, plane_map, OPTICS)
                pairs.append((_rms_mm(solved, places), _rms_mm(clean, places)))
            told = {tuple(place) for place in solved.outliers_mm.tolist()}
            truly = {tuple(place) for place in sound.grid.board_mm[wrong].tolist()}
            named["hit"] += len(told & truly)
            named["false"] += len(told - truly)
            named["wrong"] += len(truly)
    share = 100 * (named["hit"] - named["false"]) / named["wrong"]
    return [
        row("board-wrong-named", share, seeds=effort.seeded, **named),
        *(
            row("board-wrong-error", _ratio(pairs), plane_map=name, seeds=effort.seeded)
            for name, pairs in errors.items()
        ),
    ]


def _spoilt(reading: BoardReading, rng: np.random.Generator) -> tuple[Mask, BoardReading]:
    """Which control points are displaced, and the reading with them."""
    grid = reading.grid
    wrong = np.zeros(len(grid.status), dtype=bool)
    found = np.flatnonzero(grid.found)
    wrong[rng.permutation(found)[: int(np.ceil(WRONG_PART * len(found)))]] = True
    angle, far = rng.uniform(0, 2 * np.pi, len(wrong)), rng.uniform(*WRONG_PX, len(wrong))
    shift = (wrong * far)[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    return wrong, replace(reading, grid=replace(grid, image_px=grid.image_px + shift))


def _rms_mm(calibration: Calibration, places: Floats) -> float:
    """Rms distance of the map's answers from the truth."""
    answer = calibration.plane_map.to_plane(image_px(places))
    known = answer.status == Status.OK
    return float(np.sqrt(np.mean((answer.xz_mm - places)[known] ** 2)))


def _ratio(pairs: list[tuple[float, float]]) -> float:
    """The largest of the first over the second of each pair."""
    spoilt, clean = np.array(pairs).T
    return float((spoilt / clean).max())
