"""The command ``lscan calibrate-shaft``: a thin face over lscan.surface.shaft."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from lscan.cli.arguments import CalibrationFile, Json, Trust, require_folders
from lscan.cli.console import print_json, print_table, progress_bar

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
    from lscan.measurement import find_shaft
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
