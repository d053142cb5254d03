"""What the accuracy table has a figure for, a chapter each."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from lscan.config.rig import load_rig
from lscan.records import Floats, Length, Surface
from sim.scene import Scene
from tests.validation.exposures import band_miss_percent, read_scan, share_inside, with_contrast
from tests.validation.instrument.board import calibrations, lengths, map_errors_mm, misaligned_rows
from tests.validation.instrument.effort import FULL, QUICK, AccuracyEffort
from tests.validation.instrument.metric import metric_rows
from tests.validation.instrument.photographs import photograph_rows
from tests.validation.instrument.stripes import bound_rows
from tests.validation.instrument.workpieces import (
    aligned_surface,
    dimensions,
    every_frame,
    grid_errors,
    slice_errors,
)
from tests.validation.rows import Chapters, Request, Row, row

Chapter = Callable[[Path, AccuracyEffort], list[Row]]

SPECKLE = 0.25


def board_chapter(scenes: Path, effort: AccuracyEffort) -> list[Row]:
    """The map on the sheet, Tables I and II, and the intervals of their lengths."""
    scene = effort.best(scenes, "board")
    map_name = scene.rig.calibration.plane_map
    solved = calibrations(scene, effort.seeds, map_name)
    errors = [map_errors_mm(scene, calibration)[0] for calibration in solved]
    distance = np.concatenate([np.hypot(*error.T) for error in errors])
    tables = [lengths(scene.board(), calibration) for calibration in solved]
    words: dict[str, Any] = {"seed": effort.seeds[0], "seeded": effort.seeded, "name": map_name}
    return [
        row("map-rms", float(np.sqrt(np.mean(distance**2))), **words),
        row("map-largest", float(distance.max()), **words),
        *_length_rows("Tables I and II", "board distances and diameters", tables, 0.06, effort),
    ]


def groove_chapter(scenes: Path, effort: AccuracyEffort) -> list[Row]:
    """Table III, and the intervals of its lengths."""
    board, groove = effort.best(scenes, "board"), effort.best(scenes, "groove")
    solved = calibrations(board, effort.seeds, effort.map_name(board))
    maps = [calibration.plane_map for calibration in solved]
    tables = dimensions(groove, effort.seeds, maps)
    return _length_rows("Table III", "groove", tables, 0.15, effort)


def slices_chapter(
    scenes: Path, effort: AccuracyEffort, contrast: float, rmse_mm: float, within_mm: float
) -> list[Row]:
    """The slices of the sandwave with speckle of this contrast, 0 for none."""
    seed = effort.seeds[0]
    scene, (surface,) = _sandwaves(scenes, effort, contrast, effort.slice_step_mm, (seed,))
    rows = []
    for name, found in slice_errors(scene, surface).items():
        words: dict[str, Any] = {"seed": seed, "name": name, "points": found.points}
        words["contrast"] = contrast
        error = np.abs(found.error_mm[np.isfinite(found.error_mm)])
        within = float(np.quantile(error, 0.99, method="higher"))
        rows += [
            row("slice", found.rmse_mm, bar=rmse_mm, kind="rmse", **words),
            row("slice", within, bar=within_mm, kind="99 % within", **words),
        ]
    return rows


def speckled_chapter(scenes: Path, effort: AccuracyEffort) -> list[Row]:
    """The grid and the slices of the sandwave with speckle; a quick run's are of one scan."""
    slices = slices_chapter(scenes, effort, SPECKLE, rmse_mm=0.15, within_mm=0.4)
    return [*grid_rows(scenes, effort), *slices]


def grid_rows(scenes: Path, effort: AccuracyEffort) -> list[Row]:
    """The intervals of the sandwave's grid cells, a millimetre between frames."""
    step_mm = effort.coverage_step_mm
    scene, surfaces = _sandwaves(scenes, effort, SPECKLE, step_mm, effort.seeds)
    cells = [grid_errors(scene, surface, effort.cell_mm) for surface in surfaces]
    error, sigma = (np.concatenate(column) for column in zip(*cells, strict=True))
    return [_intervals("sandwave grid cells", error, sigma, effort)]


QUIET = {"dark_noise_e": 7.0, "full_well_e": 32_500.0, "prnu": 0.005}
"""Of an industrial sensor, Sony's IMX174 to two digits, as its cameras' makers measure it after
EMVA 1288: in the dark its noise is a fifth of rounding to 8 bits."""
DIM, DIM_THRESHOLD_DN = 0.15, 3.0  # of the scene's exposure: the line is 8 DN high then
MOST_SEEDS = 6


def bits_chapter(scenes: Path, effort: AccuracyEffort) -> list[Row]:
    """What twelve bits are worth where the light is little: the noise of the slices' heights.

    Most of a slice's error is no noise, and the same for both: of heights measured again and again
    it is the scatter that bits can change.
    """
    seeds = (*effort.seeds, effort.seeds[-1] + 1)[:MOST_SEEDS]
    scene = with_contrast(effort.best(scenes, "sandwave"), 0.0).with_tank(sensor=QUIET)
    board = effort.best(scenes, "board")
    plane_map = calibrations(board, seeds[:1], effort.map_name(board))[0].plane_map
    stripe = scene.rig.stripe.model_copy(
        update={"noise": None, "threshold_dn": DIM_THRESHOLD_DN}
    )  # the noise is found: nobody states that of rounding
    positions_mm = every_frame(scene, effort.coverage_step_mm)
    noise_mm = {}
    for bits in (8, 12):
        update = {"bits": bits, "exposure_ms": DIM * scene.rig.camera.exposure_ms}
        camera = scene.rig.camera.model_copy(update=update)
        taken = replace(scene, rig=scene.rig.model_copy(update={"camera": camera}))
        errors = [
            slice_errors(taken, aligned_surface(taken, reading, plane_map))
            for reading in read_scan(taken, positions_mm, seeds, stripe)
        ]
        points = np.array([np.concatenate([one.error_mm for one in e.values()]) for e in errors])
        noise_mm[bits] = points[:, np.isfinite(points).all(axis=0)].std(axis=0, ddof=1)
    rms = {bits: float(np.sqrt(np.mean(each**2))) for bits, each in noise_mm.items()}
    words: dict[str, Any] = {"seed": seeds[0], "shallow": rms[8], "points": len(noise_mm[12])}
    return [row("twelve-bits", rms[12] / rms[8], **words)]


@lru_cache(maxsize=1)
def _sandwaves(
    scenes: Path,
    effort: AccuracyEffort,
    contrast: float,
    step_mm: float | None,
    seeds: tuple[int, ...],
) -> tuple[Scene, list[Surface]]:
    """The sandwave's scene with speckle of this contrast, and its surface once for each seed.

    step_mm: between frames, the scene's own if None.
    """
    scene = with_contrast(effort.best(scenes, "sandwave"), contrast)
    board = with_contrast(effort.best(scenes, "board"), contrast)
    solved = calibrations(board, seeds, effort.map_name(board))
    stripe = scene.rig.stripe
    if effort.extractor is not None:
        stripe = stripe.model_copy(update={"extractor": effort.extractor})
    readings = read_scan(scene, every_frame(scene, step_mm), seeds, stripe)
    return scene, [
        aligned_surface(scene, reading, calibration.plane_map)
        for reading, calibration in zip(readings, solved, strict=True)
    ]


# The longest first: chapters run side by side, and no processor shall wait at the end.
CHAPTERS: Mapping[str, Chapter] = {
    "grid and slices": speckled_chapter,
    "slices without speckle": partial(slices_chapter, contrast=0.0, rmse_mm=0.05, within_mm=0.2),
    "groove": groove_chapter,
    "bits": bits_chapter,
    "board": board_chapter,
    "metric": metric_rows,
    "stripe": bound_rows,
    "misaligned": misaligned_rows,
}


def _length_rows(
    what: str,
    kind: str,
    tables: Sequence[Mapping[str, Length]],
    bar_mm: float,
    effort: AccuracyEffort,
) -> list[Row]:
    """The largest error of any entry, and the intervals of all.

    The largest of the first seed's table, and of all seeds' tables.  what: the tables' name in
    the paper.  kind: of the lengths in them.
    """
    worst = [max(abs(length.error_mm) for length in table.values()) for table in tables]
    every = [length for table in tables for length in table.values()]
    errors, sigmas = np.array([(length.error_mm, length.sigma_mm) for length in every]).T
    words: dict[str, Any] = {"bar": bar_mm, "seed": effort.seeds[0], "what": what}
    return [
        row("table-one-seed", worst[0], one=effort.seeds[0], **words),
        row("table-all-seeds", max(worst), seeded=effort.seeded, median=np.median(worst), **words),
        _intervals(kind, errors, sigmas, effort),
    ]


def _intervals(what: str, error: Floats, sigma: Floats, effort: AccuracyEffort) -> Row:
    """How far the share of the errors within their 95 % intervals is from 95 %."""
    share = share_inside(error, sigma)
    return row(
        "intervals",
        band_miss_percent(share),
        seed=effort.seeds[0],
        what=what,
        percent=100 * share,
        count=len(error),
        seeded=effort.seeded,
    )


def chapters(request: Request) -> Chapters:
    """The chapters; a bad scene file is refused before minutes of work.

    Parameters
    ----------
    request : Request

    Raises
    ------
    InputError
        A scene file is wrong.
    """
    for name in ("board", "groove", "sandwave"):
        load_rig(request.scenes / "best" / f"{name}.toml")
    asked: dict[str, Chapter] = dict(CHAPTERS)
    if request.photographs is not None:
        asked["photographs"] = partial(photograph_rows, request.photographs)
    effort = QUICK if request.quick else FULL
    return {name: partial(chapter, request.scenes, effort) for name, chapter in asked.items()}
