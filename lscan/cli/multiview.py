"""The command ``lscan calibrate-metric``: a thin face over lscan.calibration.multiview."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lscan.cli.arguments import Json, require_folders
from lscan.cli.console import print_json, print_table, progress_bar

if TYPE_CHECKING:
    from lscan.calibration.multiview.solve import MetricCalibration


def calibrate_metric(
    views: Annotated[Path, typer.Argument(help="VIEWS.toml: pictures of a board in many poses.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Calibration file to write.")],
    json: Json = False,
) -> None:
    """Solve camera, port and laser sheet from pictures of a board in several poses."""
    from lscan.calibration.multiview.file import save_metric
    from lscan.calibration.multiview.solve import calibrate_metric as solve
    from lscan.calibration.multiview.viewsfile import load_views, read_views

    require_folders(output)
    file = load_views(views)
    with progress_bar("views") as report:
        found, size = read_views(file, report)
    calibration = solve(found, file.document.optics, size, file.document.k3)
    save_metric(output, calibration)
    if json:
        print_json({"calibration": output, **summary(calibration)})
        return
    rows = [
        [
            view.name,
            f"{view.marks_used} of {view.marks_found}",
            view.rms_px,
            f"{view.line_points_used} of {view.points_found}",
            view.line_rms_mm,
            view.reason or "used",
        ]
        for view in calibration.views
    ]
    print_table("views", ["", "marks", "rms px", "line points", "rms mm", ""], rows)
    used = sum(view.used for view in calibration.views)
    lines = sum(view.line_used for view in calibration.views)
    print(
        f"metric: {used} of {len(rows)} views, {calibration.rms_px:.3f} px rms; {lines} lines, "
        f"{calibration.line_rms_mm:.3f} mm rms off the sheet; {output}"
    )


def summary(calibration: MetricCalibration) -> dict[str, Any]:
    """What a metric calibration found, as ``print_json`` takes it."""
    from lscan.camera.parameters import CAMERA

    theta = calibration.plane_map.view.theta
    known = zip(CAMERA, theta, calibration.sigma, strict=True)
    return {
        "map": "metric",
        "rms_px": calibration.rms_px,
        "line_rms_mm": calibration.line_rms_mm,
        "camera": {name: {"value": value, "sigma": sigma} for name, value, sigma in known},
        "views": [
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
            for view in calibration.views
        ],
    }
