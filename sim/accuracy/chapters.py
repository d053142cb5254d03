"""What the accuracy table has a figure for, a chapter each."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from lscan.records import Measured
from sim.accuracy.board import lengths, map_errors_mm, photograph
from sim.accuracy.exposures import read_scan, with_contrast
from sim.accuracy.groove import dimensions
from sim.accuracy.intervals import band_miss_percent, share_inside, share_of_lengths
from sim.accuracy.metric import metric_rows
from sim.accuracy.misaligned import misaligned_rows
from sim.accuracy.photographs import photograph_rows
from sim.accuracy.sandwave import aligned_surface, every_frame, grid_errors, slice_figures
from sim.accuracy.stripes import bound_rows
from sim.scene import Scene, load_scene
from sim.verify.rows import Row

Chapter = Callable[[Path, Path], list[Row]]

SEEDS = tuple(range(1, 21))
SPECKLE = 0.25
COVERAGE_STEP_MM = 1.0
ASKED = "required of this project"
SEEDED = f"seeds {SEEDS[0]} to {SEEDS[-1]}"


def board_chapter(scenes: Path, photographs: Path) -> list[Row]:
    """The map on the sheet, Tables I and II, and the intervals of their lengths."""
    scene = _best(scenes, "board")
    boards = photograph(scene, SEEDS, scene.rig.calibration.plane_map)
    errors = [map_errors_mm(scene, calibration)[0] for calibration in boards.calibrations]
    distance = np.concatenate([np.hypot(*error.T) for error in errors])
    tables = lengths(boards)
    name = scene.rig.calibration.plane_map
    truth = f"truth every 10 mm of the sheet, {SEEDED}"
    return [
        Row(f"map on the sheet ({name}), rms", truth, _rms(distance), 0.03, "mm", ASKED, SEEDS[0]),
        Row(f"map on the sheet ({name}), largest of all", truth, float(distance.max()), 0.10,
            "mm", ASKED, SEEDS[0]),
        *_largest("Tables I and II", tables, 0.06),
        _interval("board distances and diameters", tables),
    ]  # fmt: skip


def groove_chapter(scenes: Path, photographs: Path) -> list[Row]:
    """Table III, and the intervals of its lengths."""
    board, groove = _best(scenes, "board"), _best(scenes, "groove")
    calibrations = photograph(board, SEEDS, board.rig.calibration.plane_map).calibrations
    tables = dimensions(groove, SEEDS, [c.plane_map for c in calibrations])
    return [*_largest("Table III", tables, 0.15), _interval("groove", tables)]


def slices_chapter(scenes: Path, photographs: Path) -> list[Row]:
    """The slices of the sandwave with speckle and without, every frame of the scan."""
    rows = []
    for contrast, rmse, within in ((SPECKLE, 0.15, 0.4), (0.0, 0.05, 0.2)):
        scene = with_contrast(_best(scenes, "sandwave"), contrast)
        board = with_contrast(_best(scenes, "board"), contrast)
        solved = photograph(board, SEEDS[:1], board.rig.calibration.plane_map).calibrations[0]
        positions = scene.rig.plan.positions_mm()
        reading = read_scan(scene, positions, SEEDS[:1], scene.rig.stripe)[0]
        surface = aligned_surface(scene, reading, solved.plane_map)
        for name, found in slice_figures(scene, surface).items():
            what = f"sandwave {name}, speckle {contrast:g}"
            truth = f"eq. (4) at {found.points} points lit and seen"
            rows.append(Row(f"{what}, rmse", truth, found.rmse_mm, rmse, "mm", ASKED, SEEDS[0]))
            rows.append(
                Row(
                    f"{what}, 99 % within", truth, found.within_99_mm, within, "mm", ASKED, SEEDS[0]
                )
            )
    return rows


def grid_chapter(scenes: Path, photographs: Path) -> list[Row]:
    """The intervals of the sandwave's grid cells, a millimetre between frames."""
    scene = with_contrast(_best(scenes, "sandwave"), SPECKLE)
    board = with_contrast(_best(scenes, "board"), SPECKLE)
    calibrations = photograph(board, SEEDS, board.rig.calibration.plane_map).calibrations
    positions = every_frame(scene, COVERAGE_STEP_MM)
    readings = read_scan(scene, positions, SEEDS, scene.rig.stripe)
    cells = [
        grid_errors(scene, aligned_surface(scene, reading, calibration.plane_map))
        for reading, calibration in zip(readings, calibrations, strict=True)
    ]
    error = np.concatenate([grid.error_mm for grid in cells])
    share = share_inside(error, np.concatenate([grid.sigma_mm for grid in cells]))
    return [_interval_row("sandwave grid cells", share, len(error))]


def stripe_chapter(scenes: Path, photographs: Path) -> list[Row]:
    """The best extractor against the bound."""
    return bound_rows(_best(scenes, "groove").rig.stripe.extractor)


def metric_chapter(scenes: Path, photographs: Path) -> list[Row]:
    """The metric route in air and in water."""
    return metric_rows(scenes / "metric")


def misaligned_chapter(scenes: Path, photographs: Path) -> list[Row]:
    """The coplanar route with a board that is not coplanar."""
    scene = _best(scenes, "board")
    return misaligned_rows(scene, scene.rig.calibration.plane_map)


def photograph_chapter(scenes: Path, photographs: Path) -> list[Row]:
    """The real photographs."""
    return photograph_rows(photographs, _best(scenes, "groove").rig.stripe.extractor)


# The longest first: chapters run side by side, and no processor shall wait at the end.
CHAPTERS: Mapping[str, Chapter] = {
    "grid": grid_chapter,
    "slices": slices_chapter,
    "groove": groove_chapter,
    "board": board_chapter,
    "metric": metric_chapter,
    "stripe": stripe_chapter,
    "misaligned": misaligned_chapter,
    "photographs": photograph_chapter,
}


def _best(scenes: Path, name: str) -> Scene:
    return load_scene(scenes / "best" / f"{name}.toml")


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _largest(what: str, tables: Sequence[Mapping[str, Measured]], bar_mm: float) -> list[Row]:
    """The largest error of any entry: of the first seed's table, and of all seeds' tables."""
    worst = [max(abs(length.error_mm) for length in table.values()) for table in tables]
    what = f"{what}, largest error of any entry"
    middle = f"nominal lengths; median of the seeds {np.median(worst):.3f}"
    return [
        Row(what, f"nominal lengths, seed {SEEDS[0]}", worst[0], bar_mm, "mm", ASKED, SEEDS[0]),
        Row(f"{what}, {SEEDED}", middle, max(worst), bar_mm, "mm", ASKED, SEEDS[0]),
    ]


def _interval(what: str, tables: Sequence[Mapping[str, Measured]]) -> Row:
    every = [length for table in tables for length in table.values()]
    return _interval_row(what, share_of_lengths(every), len(every))


def _interval_row(what: str, share: float, count: int) -> Row:
    beside = f"{100 * share:.1f} % of {count} intervals hold the truth, {SEEDED}"
    miss = band_miss_percent(share)
    return Row(f"95 % intervals, {what}: off 95 %", beside, miss, 2.0, "points", ASKED, SEEDS[0])
