"""``lscan calibrate``, ``check``, ``calibrate-metric``, ``calibrate-shaft`` and ``draw-board``."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.table import Table
from typer import Argument, Option

from lscan.board import draw_overlay
from lscan.board.drawing import board_svg
from lscan.calibration import calibrationfile as files, check as checking
from lscan.calibration.calibrate import Calibration, calibrate as solve
from lscan.calibration.maps.auto import Auto, calibrate_best
from lscan.calibration.metric import solve as metric
from lscan.calibration.metric.views import FittedView, load_views, read_views, write_overlays
from lscan.camera.posedboards import CAMERA, contradiction
from lscan.cli.console import MAPS, Json, Trust, note, progress_bar, require_folders, show, table
from lscan.cli.inputs import note_water, open_calibrated, parse_corrections, read_board_picture
from lscan.config.board import Board
from lscan.config.documents import check as check_section, read_document
from lscan.config.rig import Known, inline_board
from lscan.files.disk import write_atomically
from lscan.files.pictures import write_picture
from lscan.pipeline import find_shaft
from lscan.records import plus_minus
from lscan.surface.shaft import save_shaft, section_of

BoardFile = Annotated[Path | None, Option(help="Board file; a run folder has its own.")]
OpticsFile = Annotated[
    Path | None, Option(help="TOML file with [optics]; a run folder has its own.")
]
Seeds = Annotated[
    str | None,
    Option(help="u,v of the upper-left dot, of the one below and the one to the right, px."),
]
ChannelName = Annotated[str | None, Option(help="Colour channel: red, green, blue or grey.")]


def calibrate(
    picture: Path = Argument(help="Picture file or run folder."),
    output: Path = Option(..., "--output", "-o", help="Calibration file to write."),
    board: BoardFile = None,
    optics: OpticsFile = None,
    plane_map: str | None = Option(None, "--map", help=f"Plane map: {MAPS}; or auto, the best."),
    seeds: Seeds = None,
    channel: ChannelName = None,
    overlay: Path | None = Option(None, help="Picture to write, with what was found drawn on it."),
    trust: Trust = False,
    json: Json = False,
) -> None:
    """Find the board's control points in a picture and solve a plane map from them."""
    require_folders(output, overlay)
    reading, image, section, water = read_board_picture(
        picture, board, optics, seeds, channel, trust
    )
    name = section.plane_map if plane_map is None else plane_map
    if overlay:
        write_picture(overlay, draw_overlay(image, reading))
    with progress_bar("maps") as progress:
        if name == "auto":
            calibration = calibrate_best(reading, water, progress)
        else:
            calibration = solve(reading, name, water)
    files.save_calibration(output, calibration)
    content, words = _as_json(calibration), _calibration_words(calibration, output)
    show({"calibration": output, **content}, *words, json=json)


def check(
    calibration: Path = Argument(help="Calibration file (JSON)."),
    picture: Path = Argument(help="Picture file or run folder."),
    board: BoardFile = None,
    optics: OpticsFile = None,
    placed: float | None = Option(
        None, help="Uncertainty of the board's place, mm; without it no shift is judged."
    ),
    level: float = Option(0.01, help="Probability of a false alarm."),
    update: Path | None = Option(None, "--update", help="Corrected calibration file to write."),
    correct: list[str] | None = Option(
        None, "--correct", help="What --update corrects: scale, index or shift; repeatable."
    ),
    seeds: Seeds = None,
    channel: ChannelName = None,
    trust: Trust = False,
    json: Json = False,
) -> None:
    """Score an old calibration against a new picture of the board; exit code 1 if it is off."""
    require_folders(update)
    asked = parse_corrections(correct)
    if asked and update is None:
        raise typer.BadParameter("--correct needs --update FILE")
    loaded = files.load_any(calibration)
    reading, _, _, water = read_board_picture(picture, board, optics, seeds, channel, trust)
    note_water(loaded.plane_map, water)
    found = checking.check_calibration(loaded, reading, level, placed, water)
    kinds = asked or checking.fitting_corrections(found)
    if update is not None and kinds:
        files.save_calibration(
            update, checking.corrected_calibration(loaded, reading, kinds, placed, water)
        )
    content = {"agrees": found.agrees, "correct": kinds, **asdict(found)}
    show(content, *_check_words(found, kinds, update), json=json)
    if not found.agrees and (update is None or not kinds):
        raise typer.Exit(1)


def _as_json(calibration: Calibration) -> dict[str, Any]:
    grid, plane_map = calibration.reading.grid, calibration.plane_map
    residuals = {name: getattr(calibration, name) for name in ("rms_mm", "max_mm", "rms_px")}
    content: dict[str, Any] = {
        "map": calibration.name,
        "control_points": {"expected": len(grid.found), "found": int(grid.found.sum())},
        "residuals": residuals,
        "outliers_mm": calibration.outliers_mm,
        "misfit": calibration.misfit,
        "found": _known_json(calibration.quantities()),
    }
    if isinstance(plane_map, Auto):
        content |= {"chosen": plane_map.chosen.name, "scores": plane_map.scores}
    return content


def _known_json(known: Mapping[str, Known]) -> dict[str, Any]:
    return {name: {"value": value, "sigma": sigma} for name, (value, sigma) in known.items()}


def _calibration_words(calibration: Calibration, path: Path) -> Iterator[str | Table]:
    found, plane_map, chosen = calibration.reading.grid.found, calibration.plane_map, ""
    if isinstance(plane_map, Auto):
        chosen = f" ({plane_map.chosen.name})"
        rows = [
            [one.name, *(f"{mm:.4f}" for mm in (one.rms_mm, one.max_mm, one.sigma_mm)),
             "yes" if one.tied else "", one.points, one.without_value, f"{one.ms:.0f}"]
            for one in plane_map.scores if one.refused is None
        ]  # fmt: skip
        headings = ["map", "rms mm", "max mm", "sigma mm", "tied", "marks", "without value", "ms"]
        yield table("marks held out of the map", headings, rows)
        for one in plane_map.scores:
            if one.refused is not None:
                yield f"{one.name}: refused, {one.refused}"
    yield (
        f"{calibration.name}{chosen}: {found.sum()} of {len(found)} control points, "
        f"residuals {calibration.rms_mm:.3f} mm rms, {calibration.max_mm:.3f} mm at most; {path}"
    )
    known = calibration.quantities().items()
    rows = [[name, f"{value:.6g}", f"{sigma:.2g}"] for name, (value, sigma) in known]
    yield table("found", ["", "value", "sigma"], rows)
    for x, z in calibration.outliers_mm:
        yield f"left out: the mark at ({x:g}, {z:g}) mm does not lie where the others predict it"
    if calibration.misfit:
        yield f"warning: {calibration.misfit}"


def _check_words(
    check: checking.CalibrationCheck, kinds: Sequence[checking.CorrectionKind], update: Path | None
) -> Iterator[str | Table]:
    (x, z), (x_sigma, z_sigma) = check.shift_mm, check.shift_sigma_mm
    yield f"{check.marks} marks compared, {check.without_value} outside the calibration"
    yield f"as they are: {check.raw_rms_mm:.3f} mm rms, {check.raw_max_mm:.3f} mm at most"
    yield (
        f"board put back with a shift of {plus_minus(x, x_sigma, 'mm')} in x, "
        f"{plus_minus(z, z_sigma, 'mm')} in z and a turn of "
        f"{plus_minus(check.turn_deg, check.turn_sigma_deg, 'deg')}"
    )
    yield f"without those: {check.rms_mm:.3f} mm rms, {check.max_mm:.3f} mm at most"
    yield f"scale error {plus_minus(1e6 * check.scale_error, 1e6 * check.scale_sigma, 'ppm')}"
    yield f"chi-square {check.chi_square:.0f} for {check.degrees_of_freedom} degrees of freedom"
    rows = [[mark.name, *mark.residual_mm, f"{mark.ratio:.1f}"] for mark in check.worst]
    yield table("farthest off", ["mark", "x mm", "z mm", "sigmas"], rows)
    verdict = "agrees" if check.agrees else f"disagrees: {', '.join(check.reasons)}"
    yield f"the calibration {verdict} (chance of a false alarm {100 * check.level:g} %)"
    if (index := check.index) is not None:
        yield (
            f"index of the water that fits best: {plus_minus(index.index, index.sigma)}, "
            f"chi-square {index.chi_square:.0f}"
        )
    if kinds and update is not None:
        yield f"corrected ({', '.join(kinds)}): {update}"
    elif kinds:
        options = " ".join(f"--correct {kind}" for kind in kinds)
        yield f"to correct it: lscan check ... --update FILE {options}"
    if kinds and "shape" in check.reasons and "index" not in kinds:
        yield "what that leaves of the shape enters the uncertainty; a new calibration is better"
    elif not kinds and not check.agrees:
        yield "no change of scale, index or shift explains it: calibrate again"
    elif not kinds and update is not None:
        yield "nothing to correct"


def calibrate_metric(
    views: Path = Argument(help="VIEWS.toml: pictures of a board in many poses."),
    output: Path = Option(..., "--output", "-o", help="Calibration file to write."),
    camera_only: bool = Option(
        False, "--camera-only", help="Solve the camera alone, without a laser line."
    ),
    camera: Path | None = Option(None, help="File of --camera-only; its boards are used too."),
    overlays: Path | None = Option(
        None, help="Folder for the views, with what was found drawn on them."
    ),
    json: Json = False,
) -> None:
    """Solve camera, port and laser sheet from pictures of a board in several poses.

    If they give no calibration, the table of the views is printed all the same, and pictures of
    what was found in them are written next to the output.
    """
    require_folders(output, overlays)
    file = load_views(views)
    known = None if camera is None else files.load_camera(camera)
    with progress_bar("views") as report:
        found, size = read_views(file, report)
    boards, optics, k3, lens = [], file.document.optics, file.document.k3, file.document.lens
    if known and camera:
        files.require_same_camera(known, file, size, camera)
        boards, optics, k3, lens = known.boards_beside(found), known.optics, known.k3, known.lens
    try:
        method = metric.calibrate_camera if camera_only else metric.calibrate_metric
        calibration = method([*boards, *found], optics, size, k3, lens)
    except metric.UnsolvedViews as error:
        folder = overlays or output.with_name(f"{output.stem}-views")
        write_overlays(file, error.views[len(boards) :], folder)
        failed = {"calibration": None, "error": str(error), "views": _views_json(error.views)}
        show(failed, _views_table(error.views), json=json)
        note(f"pictures of what was found in each view: {folder}")
        raise
    if overlays:
        write_overlays(file, calibration.views[len(boards) :], overlays)
    used = f"{sum(view.used for view in calibration.views)} of {len(calibration.views)} views"
    used += f", {calibration.rms_px:.3f} px rms"
    content: dict[str, Any] = {"map": None, "rms_px": calibration.rms_px, "line_rms_mm": None}
    files.save_calibration(output, calibration)
    if isinstance(calibration, metric.CameraCalibration):
        words = f"camera: {used}"
    else:
        content |= {"map": calibration.plane_map.name, "line_rms_mm": calibration.line_rms_mm}
        lines = sum(view.line_used for view in calibration.views)
        off = f"{calibration.line_rms_mm:.3f} mm rms off the sheet"
        sheet = calibration.plane_map.quantities()
        content["found"], away = _known_json(sheet), plus_minus(*sheet["sheet_distance_mm"], "mm")
        words = f"metric: {used}; {lines} lines, {off}; sheet {away} away"
    focal = plus_minus(calibration.theta[0], calibration.sigma[0], "px")
    words += f"; {calibration.lens} lens, focal length {focal}"
    pairs = zip(calibration.theta, calibration.sigma, strict=True)
    content["camera"] = _known_json(dict(zip(CAMERA, pairs, strict=True)))
    content["lens"] = calibration.lens
    stated = contradiction(calibration.theta, optics, size, k3, calibration.lens)
    misfit = "; ".join(filter(None, (calibration.misfit, stated)))
    content |= {"misfit": misfit, "views": _views_json(calibration.views)}
    views_table = _views_table(calibration.views)
    warnings = [f"warning: {misfit}"] if misfit else []
    content = {"calibration": output, **content}
    show(content, views_table, f"{words}; {output}", *warnings, json=json)


def _views_table(views: Sequence[FittedView]) -> Table:
    rows = [
        [view.name, f"{view.marks_used} of {view.marks_found}", view.rms_px,
         f"{view.line_points_used} of {view.points_found}" if view.points_found else "",
         view.line_rms_mm if view.line_points_used else "", view.outcome]
        for view in views
    ]  # fmt: skip
    return table("views", ["", "marks", "rms px", "line points", "rms mm", ""], rows)


def _views_json(views: Sequence[FittedView]) -> list[dict[str, Any]]:
    return [
        {"view": view.name, "used": view.used, "marks": view.marks_used, "rms_px": view.rms_px,
         "line_used": view.line_used, "line_points": view.line_points_used,
         "line_rms_mm": view.line_rms_mm, "fault": view.reason}
        for view in views
    ]  # fmt: skip


SHAFT = {"offset 1 mm": 1.0, "offset 2 mm": 1.0, "tilt 1 deg": 180 / np.pi,
         "tilt 2 deg": 180 / np.pi, "scale": 1.0}  # fmt: skip
"""The parameters of a shaft's fit, and what makes of each that of a file: radians to degrees."""


def calibrate_shaft(
    run: Path = Argument(help="Run folder of a scan of the sandwave about a shaft."),
    calibration: Path = Option(..., "--calibration", "-c", help="Calibration file (JSON)."),
    output: Path = Option(..., "--output", "-o", help="TOML file to write, with [shaft]."),
    trust: Trust = False,
    json: Json = False,
) -> None:
    """Find a rotary axis from the scan of a workpiece of known shape."""
    require_folders(output)
    opened, plane_map = open_calibrated(run, calibration, trusted=trust)
    with progress_bar("profiles") as report:
        fit = find_shaft(opened, plane_map, report)
    save_shaft(output, fit)
    columns = np.column_stack([fit.moved, fit.shaft.sigma, fit.prior.sigma])
    changes = dict(zip(SHAFT, (columns.T * [*SHAFT.values()]).T.tolist(), strict=True))
    keys = ("change", "sigma", "sigma_before")
    content = {
        "file": output,
        "shaft": section_of(fit.shaft),
        "changes": {name: dict(zip(keys, row, strict=True)) for name, row in changes.items()},
        "points": fit.points,
        "outliers": fit.outliers,
        "cells": fit.cells,
        "rms_mm": fit.rms_mm,
    }
    rows = [[name, *numbers] for name, numbers in changes.items()]
    words = (
        f"{fit.points} points, {fit.outliers} left out, {fit.rms_mm:.3f} mm rms off the nominal "
        f"shape; {output}"
    )
    show(content, table("shaft", ["", "change", "sigma", "sigma before"], rows), words, json=json)


def draw_board(
    board: Path = Argument(help="Board file, or a rig file that names one."),
    output: Path = Option(..., "--output", "-o", help="SVG file to write."),
    json: Json = False,
) -> None:
    """Draw a calibration board at its true size, for printing or milling."""
    require_folders(output)
    document = inline_board(read_document(board), source=str(board))
    section = "board" if "board" in document else ""
    drawn = check_section(Board, document.get("board", document), where=board, prefix=section)
    write_atomically(output, board_svg(drawn).encode())
    left, right, bottom, top = drawn.outline_mm()
    content = {"drawing": output, "width_mm": right - left, "height_mm": top - bottom}
    words = f"{output}: {right - left:g} by {top - bottom:g} mm; print it at 100 %"
    show(content, words, json=json)
