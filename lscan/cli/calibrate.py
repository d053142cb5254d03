"""The commands ``lscan calibrate`` and ``lscan check``: thin faces over lscan.calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from lscan.cli.console import (
    MAPS,
    CalibrationFile,
    ChannelName,
    Json,
    Overlay,
    PictureOrRun,
    Trust,
    note,
    print_json,
    print_table,
    progress_bar,
    require_folders,
)

if TYPE_CHECKING:
    from lscan.calibration.calibrate import Calibration, Score
    from lscan.calibration.check import CalibrationCheck, CorrectionKind
    from lscan.calibration.metric.solve import CameraCalibration, MetricCalibration
    from lscan.calibration.metric.views import FittedView


BoardFile = Annotated[
    Path | None, typer.Option("--board", help="Board file; a run folder has its own.")
]
OpticsFile = Annotated[
    Path | None,
    typer.Option("--optics", help="TOML file with [optics]; a run folder has its own."),
]
Seeds = Annotated[
    str | None,
    typer.Option(
        "--seeds", help="u,v of the upper-left dot, the one beneath and the one to its right."
    ),
]


def calibrate(
    picture: PictureOrRun,
    output: Annotated[Path, typer.Option("--output", "-o", help="Calibration file to write.")],
    board: BoardFile = None,
    optics: OpticsFile = None,
    plane_map: Annotated[
        str | None, typer.Option("--map", help=f"Plane map: {MAPS}; auto: the best.")
    ] = None,
    seeds: Seeds = None,
    channel: ChannelName = None,
    overlay: Overlay = None,
    trust: Trust = False,
    json: Json = False,
) -> None:
    """Find the board's control points in a picture and solve a plane map from them."""
    from lscan.board import draw_overlay
    from lscan.calibration.calibrate import calibrate as solve
    from lscan.calibration.calibrationfile import save_calibration
    from lscan.calibration.maps.auto import calibrate_best
    from lscan.cli.inputs import board_picture, parse_seeds
    from lscan.files.pictures import write_picture

    require_folders(output, overlay)
    given = board_picture(picture, board, optics, trust)
    name = given.calibration.plane_map if plane_map is None else plane_map
    reading = given.read(parse_seeds(seeds), channel)
    if overlay:
        write_picture(overlay, draw_overlay(given.image, reading))
    with progress_bar("maps") as progress:
        if name == "auto":
            calibration = calibrate_best(reading, given.optics, progress)
        else:
            calibration = solve(reading, name, given.optics)
    save_calibration(output, calibration)
    if json:
        print_json(_calibration_json(output, calibration))
    else:
        _print_calibration(output, calibration)


def check(
    calibration: Annotated[Path, typer.Argument(help="Calibration file (JSON).")],
    picture: PictureOrRun,
    board: BoardFile = None,
    optics: OpticsFile = None,
    placed: Annotated[
        float | None, typer.Option(help="How well the board was put back, mm; else not judged.")
    ] = None,
    level: Annotated[float, typer.Option(help="Chance of a false alarm.")] = 0.01,
    update: Annotated[
        Path | None,
        typer.Option("--update", help="Calibration file to write, with what is off corrected."),
    ] = None,
    correct: Annotated[
        list[str] | None,
        typer.Option("--correct", help="What --update corrects: scale, index, shift."),
    ] = None,
    seeds: Seeds = None,
    channel: ChannelName = None,
    trust: Trust = False,
    json: Json = False,
) -> None:
    """Score an old calibration against a new picture of the board; exit code 1 if it is off."""
    from lscan.calibration.calibrationfile import load_any, save_calibration
    from lscan.calibration.check import (
        check_calibration,
        corrected_calibration,
        fitting_corrections,
    )
    from lscan.cli.inputs import board_picture, parse_corrections, parse_seeds

    require_folders(update)
    asked = parse_corrections(correct)
    if asked and update is None:
        raise typer.BadParameter("--correct needs --update FILE")
    loaded = load_any(calibration)
    given = board_picture(picture, board, optics, trust)
    reading, water = given.read(parse_seeds(seeds), channel), given.optics
    found = check_calibration(loaded, reading, level, placed, water)
    kinds = asked or fitting_corrections(found)
    if update is not None and kinds:
        save_calibration(update, corrected_calibration(loaded, reading, kinds, placed, water))
    if json:
        print_json({"agrees": found.agrees, "correct": kinds, **asdict(found)})
    else:
        _print_check(found, kinds, update)
    if not found.agrees and (update is None or not kinds):
        raise typer.Exit(1)


def _calibration_json(path: Path, calibration: Calibration) -> dict[str, Any]:
    from lscan.calibration.maps.auto import Auto

    grid, plane_map = calibration.reading.grid, calibration.plane_map
    content: dict[str, Any] = {
        "calibration": path,
        "map": calibration.name,
        "control_points": {"expected": len(grid.found), "found": int(grid.found.sum())},
        "residuals": {
            "rms_mm": calibration.rms_mm,
            "max_mm": calibration.max_mm,
            "rms_px": calibration.rms_px,
        },
        "outliers_mm": calibration.outliers_mm,
        "misfit": calibration.misfit,
    }
    if isinstance(plane_map, Auto):
        content["chosen"] = plane_map.chosen.name
        content["scores"] = plane_map.scores
    return content


def _print_calibration(path: Path, calibration: Calibration) -> None:
    from lscan.calibration.maps.auto import Auto

    found, plane_map, chosen = calibration.reading.grid.found, calibration.plane_map, ""
    if isinstance(plane_map, Auto):
        _print_scores(plane_map.scores)
        chosen = f" ({plane_map.chosen.name})"
    print(
        f"{calibration.name}{chosen}: {found.sum()} of {len(found)} control points, "
        f"residuals {calibration.rms_mm:.3f} mm rms, {calibration.max_mm:.3f} mm at most; {path}"
    )
    for x, z in calibration.outliers_mm:
        print(f"left out: the mark at ({x:g}, {z:g}) mm does not lie where the others predict it")
    if calibration.misfit:
        print(f"warning: {calibration.misfit}")


def _print_scores(scores: tuple[Score, ...]) -> None:
    rows = [
        [
            score.name,
            *(f"{mm:.4f}" for mm in (score.rms_mm, score.max_mm, score.sigma_mm)),
            "yes" if score.tied else "",
            score.points,
            score.without_value,
            f"{score.ms:.0f}",
        ]
        for score in scores
        if score.refused is None
    ]
    headings = ["map", "rms mm", "max mm", "sigma mm", "tied", "marks", "without value", "ms"]
    print_table("marks held out of the map", headings, rows)
    for score in scores:
        if score.refused is not None:
            print(f"{score.name}: refused, {score.refused}")


def _print_check(
    check: CalibrationCheck, kinds: Sequence[CorrectionKind], update: Path | None
) -> None:
    (x, z), (x_sigma, z_sigma) = check.shift_mm, check.shift_sigma_mm
    print(f"{check.marks} marks compared, {check.without_value} outside the calibration")
    print(f"as they are: {check.raw_rms_mm:.3f} mm rms, {check.raw_max_mm:.3f} mm at most")
    print(
        f"board put back with a shift of {x:.3f} ± {x_sigma:.3f} mm in x, {z:.3f} ± "
        f"{z_sigma:.3f} mm in z and a turn of {check.turn_deg:.4f} ± {check.turn_sigma_deg:.4f} deg"
    )
    print(f"without those: {check.rms_mm:.3f} mm rms, {check.max_mm:.3f} mm at most")
    print(f"scale error {1e6 * check.scale_error:.0f} ± {1e6 * check.scale_sigma:.0f} ppm")
    print(f"chi-square {check.chi_square:.0f} for {check.degrees_of_freedom} degrees of freedom")
    rows = [[mark.name, *mark.residual_mm, f"{mark.ratio:.1f}"] for mark in check.worst]
    print_table("farthest off", ["mark", "x mm", "z mm", "sigmas"], rows)
    verdict = "agrees" if check.agrees else f"disagrees: {', '.join(check.reasons)}"
    print(f"the calibration {verdict} (chance of a false alarm {100 * check.level:g} %)")
    if check.index is not None:
        index = check.index
        print(
            f"index of the water that fits best: {index.index:.5f} ± {index.sigma:.5f}, "
            f"chi-square {index.chi_square:.0f}"
        )
    if kinds and update is not None:
        print(f"corrected ({', '.join(kinds)}): {update}")
    elif kinds:
        options = " ".join(f"--correct {kind}" for kind in kinds)
        print(f"to correct it: lscan check ... --update FILE {options}")
    if kinds and "shape" in check.reasons and "index" not in kinds:
        print("what that leaves of the shape enters the uncertainty; a new calibration is better")
    elif not kinds and not check.agrees:
        print("no change of scale, index or shift explains it: calibrate again")
    elif not kinds and update is not None:
        print("nothing to correct")


# The command ``lscan calibrate-metric``: a thin face over lscan.calibration.metric.


def calibrate_metric(
    views: Annotated[Path, typer.Argument(help="VIEWS.toml: pictures of a board in many poses.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Calibration file to write.")],
    camera_only: Annotated[
        bool, typer.Option("--camera-only", help="The camera alone; no laser line is needed.")
    ] = False,
    camera: Annotated[
        Path | None, typer.Option(help="File of --camera-only, whose boards count as well.")
    ] = None,
    overlays: Annotated[
        Path | None,
        typer.Option(help="Folder for a picture of each view with what was found drawn on it."),
    ] = None,
    json: Json = False,
) -> None:
    """Solve camera, port and laser sheet from pictures of a board in several poses.

    Where they give no calibration, the table of the views is printed all the same, and the
    pictures are written beside the output.
    """
    from lscan.calibration.calibrationfile import (
        load_camera,
        require_same_camera,
        save_calibration,
    )
    from lscan.calibration.metric.solve import (
        UnsolvedViews,
        calibrate_camera,
        calibrate_metric as solve,
    )
    from lscan.calibration.metric.views import load_views, read_views, write_overlays

    require_folders(output, overlays)
    file = load_views(views)
    known = None if camera is None else load_camera(camera)
    with progress_bar("views") as report:
        found, size = read_views(file, report)
    boards, optics, k3 = [], file.document.optics, file.document.k3
    if known is not None and camera is not None:
        require_same_camera(known, file, size, camera)
        boards, optics, k3 = known.boards_beside(found), known.optics, known.k3
    try:
        method = calibrate_camera if camera_only else solve
        calibration = method([*boards, *found], optics, size, k3)
    except UnsolvedViews as error:
        folder = overlays or output.with_name(f"{output.stem}-views")
        write_overlays(file, error.views[len(boards) :], folder)
        if json:
            print_json({"calibration": None, "error": str(error), "views": _listed(error.views)})
        else:
            _print_views(error.views)
        note(f"pictures of what was found in each view: {folder}")
        raise
    if overlays:
        write_overlays(file, calibration.views[len(boards) :], overlays)
    save_calibration(output, calibration)
    if json:
        print_json({"calibration": output, **summary(calibration)})
        return
    _print_views(calibration.views)
    print(f"{_in_words(calibration)}; {output}")


def _print_views(views: Sequence[FittedView]) -> None:
    rows = [
        [
            view.name,
            f"{view.marks_used} of {view.marks_found}",
            view.rms_px,
            f"{view.line_points_used} of {view.points_found}" if view.points_found else "",
            view.line_rms_mm if view.line_points_used else "",
            view.outcome,
        ]
        for view in views
    ]
    print_table("views", ["", "marks", "rms px", "line points", "rms mm", ""], rows)


def _in_words(calibration: MetricCalibration | CameraCalibration) -> str:
    from lscan.calibration.metric.solve import CameraCalibration

    views = calibration.views
    used = f"{sum(view.used for view in views)} of {len(views)} views, {calibration.rms_px:.3f} px"
    if isinstance(calibration, CameraCalibration):
        focal, sigma = calibration.theta[0], calibration.sigma[0]
        return f"camera: {used} rms; focal length {focal:.1f} ± {sigma:.1f} px"
    lines = sum(view.line_used for view in views)
    off = f"{calibration.line_rms_mm:.3f} mm rms off the sheet"
    return f"metric: {used} rms; {lines} lines, {off}"


def summary(calibration: MetricCalibration | CameraCalibration) -> dict[str, Any]:
    """What a metric calibration, or a camera's, found, as ``print_json`` takes it."""
    from lscan.calibration.metric.solve import MetricCalibration
    from lscan.camera.posedboards import CAMERA

    metric = calibration if isinstance(calibration, MetricCalibration) else None
    known = zip(CAMERA, calibration.theta, calibration.sigma, strict=True)
    return {
        "map": metric and metric.plane_map.name,
        "rms_px": calibration.rms_px,
        "line_rms_mm": metric and metric.line_rms_mm,
        "camera": {name: {"value": value, "sigma": sigma} for name, value, sigma in known},
        "views": _listed(calibration.views),
    }


def _listed(views: Sequence[FittedView]) -> list[dict[str, Any]]:
    return [
        {
            "view": view.name,
            "used": view.used,
            "marks": view.marks_used,
            "rms_px": view.rms_px,
            "line_used": view.line_used,
            "line_points": view.line_points_used,
            "line_rms_mm": view.line_rms_mm,
            "fault": view.reason,
        }
        for view in views
    ]


# The command ``lscan calibrate-shaft``: a thin face over lscan.surface.shaft.


IN_FILE = np.array([1.0, 1.0, 180 / np.pi, 180 / np.pi, 1.0])
"""From the fit's parameters to those of a file: radians to degrees."""

NAMES = ("offset 1 mm", "offset 2 mm", "tilt 1 deg", "tilt 2 deg", "scale")


def calibrate_shaft(
    run: Annotated[Path, typer.Argument(help="Run folder of the sandwave, made about a shaft.")],
    calibration: CalibrationFile,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="File with [shaft] to write (TOML).")
    ],
    trust: Trust = False,
    json: Json = False,
) -> None:
    """Find a rotary axis from the scan of a workpiece whose shape is known."""
    from lscan.cli.inputs import open_calibrated
    from lscan.pipeline import find_shaft
    from lscan.surface.shaft import save_shaft, section_of

    require_folders(output)
    opened, plane_map = open_calibrated(run, calibration, trusted=trust)
    with progress_bar("profiles") as report:
        fit = find_shaft(opened, plane_map, report)
    save_shaft(output, fit)
    columns = np.column_stack([fit.moved, fit.shaft.sigma, fit.prior.sigma]) * IN_FILE[:, None]
    changes = dict(zip(NAMES, columns.tolist(), strict=True))
    if not json:
        rows = [[name, *numbers] for name, numbers in changes.items()]
        print_table("shaft", ["", "change", "sigma", "sigma before"], rows)
        print(
            f"{fit.points} points, {fit.outliers} left out, {fit.rms_mm:.3f} mm rms off the "
            f"nominal shape; {output}"
        )
        return
    keys = ("change", "sigma", "sigma_before")
    print_json(
        {
            "file": output,
            "shaft": section_of(fit.shaft),
            "changes": {name: dict(zip(keys, row, strict=True)) for name, row in changes.items()},
            "points": fit.points,
            "outliers": fit.outliers,
            "cells": fit.cells,
            "rms_mm": fit.rms_mm,
        }
    )


# The command ``lscan draw-board``: a thin face over lscan.board.drawing.


def draw_board(
    board: Annotated[Path, typer.Argument(help="Board file, or a rig file that names one.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="SVG file to write.")],
    json: Json = False,
) -> None:
    """Draw a calibration board at its true size, to be printed or milled."""
    from lscan.board.drawing import board_svg
    from lscan.config.board import Board
    from lscan.config.documents import check, read_document
    from lscan.config.rig import inline_board
    from lscan.files.disk import write_atomically

    require_folders(output)
    document = inline_board(read_document(board), source=str(board))
    section = "board" if "board" in document else ""
    drawn = check(Board, document.get("board", document), where=board, prefix=section)
    write_atomically(output, board_svg(drawn).encode())
    left, right, bottom, top = drawn.outline_mm()
    if json:
        print_json({"drawing": output, "width_mm": right - left, "height_mm": top - bottom})
    else:
        print(f"{output}: {right - left:g} by {top - bottom:g} mm; print it at 100 %")
