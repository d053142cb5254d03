"""What the accuracy table has a figure for, a chapter each."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lscan.config.rig import StripeSection
from lscan.records import Length
from sim.scene import Scene, load_scene
from sim.validation.accuracy.board import lengths, map_errors_mm, photograph
from sim.validation.accuracy.effort import AccuracyEffort
from sim.validation.accuracy.exposures import read_scan, with_contrast
from sim.validation.accuracy.groove import dimensions
from sim.validation.accuracy.intervals import band_miss_percent, share_inside, share_of_lengths
from sim.validation.accuracy.metric import metric_rows
from sim.validation.accuracy.misaligned import misaligned_rows
from sim.validation.accuracy.photographs import photograph_rows
from sim.validation.accuracy.sandwave import (
    aligned_surface,
    every_frame,
    grid_errors,
    slice_figures,
)
from sim.validation.accuracy.stripes import bound_rows
from sim.validation.rows import Row, row

Chapter = Callable[[Path, AccuracyEffort], list[Row]]

SPECKLE = 0.25


def board_chapter(scenes: Path, effort: AccuracyEffort) -> list[Row]:
    """The map on the sheet, Tables I and II, and the intervals of their lengths."""
    scene = _best(scenes, effort, "board")
    boards = photograph(scene, effort.seeds, scene.rig.calibration.plane_map)
    errors = [map_errors_mm(scene, calibration)[0] for calibration in boards.calibrations]
    distance = np.concatenate([np.hypot(*error.T) for error in errors])
    tables = lengths(boards)
    words: dict[str, Any] = {"seed": effort.seeds[0], "seeded": effort.seeded}
    words["name"] = scene.rig.calibration.plane_map
    return [
        row("map-rms", _rms(distance), **words),
        row("map-largest", float(distance.max()), **words),
        *_largest("Tables I and II", tables, 0.06, effort),
        _interval("board distances and diameters", tables, effort),
    ]


def groove_chapter(scenes: Path, effort: AccuracyEffort) -> list[Row]:
    """Table III, and the intervals of its lengths."""
    board, groove = _best(scenes, effort, "board"), _best(scenes, effort, "groove")
    calibrations = photograph(board, effort.seeds, _map_name(board, effort)).calibrations
    tables = dimensions(groove, effort.seeds, [c.plane_map for c in calibrations])
    return [*_largest("Table III", tables, 0.15, effort), _interval("groove", tables, effort)]


def slices_chapter(
    scenes: Path, effort: AccuracyEffort, contrast: float, rmse_mm: float, within_mm: float
) -> list[Row]:
    """The slices of the sandwave with speckle of this contrast, 0 for none."""
    scene = with_contrast(_best(scenes, effort, "sandwave"), contrast)
    board = with_contrast(_best(scenes, effort, "board"), contrast)
    seed = effort.seeds[0]
    solved = photograph(board, [seed], _map_name(board, effort)).calibrations[0]
    positions = every_frame(scene, effort.slice_step_mm or scene.rig.plan.step_mm)
    reading = read_scan(scene, positions, [seed], _stripe(scene, effort))[0]
    surface = aligned_surface(scene, reading, solved.plane_map)
    rows = []
    for name, found in slice_figures(scene, surface).items():
        words: dict[str, Any] = {"seed": seed, "name": name, "points": found.points}
        words["contrast"] = contrast
        rows += [
            row("slice", found.rmse_mm, bar=rmse_mm, kind="rmse", **words),
            row("slice", found.within_99_mm, bar=within_mm, kind="99 % within", **words),
        ]
    return rows


def grid_chapter(scenes: Path, effort: AccuracyEffort) -> list[Row]:
    """The intervals of the sandwave's grid cells, a millimetre between frames."""
    scene = with_contrast(_best(scenes, effort, "sandwave"), SPECKLE)
    board = with_contrast(_best(scenes, effort, "board"), SPECKLE)
    calibrations = photograph(board, effort.seeds, _map_name(board, effort)).calibrations
    positions = every_frame(scene, effort.coverage_step_mm)
    readings = read_scan(scene, positions, effort.seeds, _stripe(scene, effort))
    cells = [
        grid_errors(scene, aligned_surface(scene, reading, calibration.plane_map), effort.cell_mm)
        for reading, calibration in zip(readings, calibrations, strict=True)
    ]
    error = np.concatenate([grid.error_mm for grid in cells])
    share = share_inside(error, np.concatenate([grid.sigma_mm for grid in cells]))
    return [_interval_row("sandwave grid cells", share, len(error), effort)]


def stripe_chapter(scenes: Path, effort: AccuracyEffort) -> list[Row]:
    """The best extractor against the bound."""
    return bound_rows(_best(scenes, effort, "groove").rig.stripe.extractor, effort)


def metric_chapter(scenes: Path, effort: AccuracyEffort) -> list[Row]:
    """The metric route in air and in water."""
    return metric_rows(scenes / "metric", effort)


def misaligned_chapter(scenes: Path, effort: AccuracyEffort) -> list[Row]:
    """The coplanar route with a board that is not coplanar."""
    scene = _best(scenes, effort, "board")
    return misaligned_rows(scene, _map_name(scene, effort))


def photograph_chapter(photographs: Path, scenes: Path, effort: AccuracyEffort) -> list[Row]:
    """The real photographs in a folder of that name."""
    extractor = _best(scenes, effort, "groove").rig.stripe.extractor
    return photograph_rows(photographs, extractor, effort.repeats)


# The longest first: chapters run side by side, and no processor shall wait at the end.
CHAPTERS: Mapping[str, Chapter] = {
    "grid": grid_chapter,
    "slices": partial(slices_chapter, contrast=SPECKLE, rmse_mm=0.15, within_mm=0.4),
    "slices without speckle": partial(slices_chapter, contrast=0.0, rmse_mm=0.05, within_mm=0.2),
    "groove": groove_chapter,
    "board": board_chapter,
    "metric": metric_chapter,
    "stripe": stripe_chapter,
    "misaligned": misaligned_chapter,
}


def _best(scenes: Path, effort: AccuracyEffort, name: str) -> Scene:
    return effort.scene(load_scene(scenes / "best" / f"{name}.toml"))


def _map_name(board: Scene, effort: AccuracyEffort) -> str:
    return effort.plane_map or board.rig.calibration.plane_map


def _stripe(scene: Scene, effort: AccuracyEffort) -> StripeSection:
    stripe = scene.rig.stripe
    return (
        stripe
        if effort.extractor is None
        else stripe.model_copy(update={"extractor": effort.extractor})
    )


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _largest(
    what: str, tables: Sequence[Mapping[str, Length]], bar_mm: float, effort: AccuracyEffort
) -> list[Row]:
    """The largest error of any entry: of the first seed's table, and of all seeds' tables."""
    worst = [max(abs(length.error_mm) for length in table.values()) for table in tables]
    words: dict[str, Any] = {"bar": bar_mm, "seed": effort.seeds[0], "what": what}
    return [
        row("table-one-seed", worst[0], one=effort.seeds[0], **words),
        row(
            "table-all-seeds",
            max(worst),
            seeded=effort.seeded,
            median=np.median(worst),
            **words,
        ),
    ]


def _interval(what: str, tables: Sequence[Mapping[str, Length]], effort: AccuracyEffort) -> Row:
    every = [length for table in tables for length in table.values()]
    return _interval_row(what, share_of_lengths(every), len(every), effort)


def _interval_row(what: str, share: float, count: int, effort: AccuracyEffort) -> Row:
    words: dict[str, Any] = {
        "what": what,
        "percent": 100 * share,
        "count": count,
        "seeded": effort.seeded,
    }
    return row("intervals", band_miss_percent(share), seed=effort.seeds[0], **words)
