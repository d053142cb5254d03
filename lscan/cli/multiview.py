"""The command ``lscan calibrate-metric``: a thin face over lscan.calibration.metric."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lscan.cli.arguments import Json, require_folders
from lscan.cli.console import note, print_json, print_table, progress_bar

if TYPE_CHECKING:
    from lscan.calibration.metric.solve import CameraCalibration, MetricCalibration
    from lscan.calibration.metric.views import FittedView


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
        save_camera,
        save_metric,
    )
    from lscan.calibration.metric.solve import (
        CameraCalibration,
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
    if isinstance(calibration, CameraCalibration):
        save_camera(output, calibration)
    else:
        save_metric(output, calibration)
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
