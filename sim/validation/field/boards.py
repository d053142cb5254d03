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
from lscan.calibration.calibrate import Calibration, calibrate
from lscan.calibration.planemap import without
from lscan.config.board import Board, Grid
from lscan.files.pictures import write_picture
from lscan.records import BoardReading, Floats, Mask, Status
from sim.render.tank import Tank
from sim.scene import load_scene
from sim.truth import board_truth
from sim.validation.accuracy.exposures import pictures
from sim.validation.field import largeboard
from sim.validation.field.chessboards import sliver_rows, squeezed_row, tank_chessboard_row
from sim.validation.field.drawn import DrawnView, dots_cover, photographed
from sim.validation.field.effort import FieldEffort
from sim.validation.rows import Row, measured, row

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
        *measured("large dot board", lambda: large_rows(effort)),
        *measured("dot board in a penumbra", lambda: [penumbra_row(effort)]),
        *measured("penumbra in the tank", lambda: [tank_penumbra_row(scenes, effort)]),
        *measured("wrong marks", lambda: wrong_mark_rows(effort)),
        *measured("chessboards with slivers", lambda: sliver_rows(effort)),
        *measured("chessboard in the tank", lambda: [tank_chessboard_row(scenes, effort)]),
        *measured("pixels that are not square", lambda: [squeezed_row(effort)]),
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
            call = f"from {largeboard.__name__} import calibrate_large; calibrate_large{arguments}"
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
