"""The commands ``lscan reconstruct`` and ``lscan measure``: thin faces over lscan.measurement."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lscan.cli.arguments import CalibrationFile, Json, RunFolder, ShaftFile, Trust, require_folders
from lscan.cli.console import note, print_json, print_table, progress_bar

if TYPE_CHECKING:
    from lscan.config.rig import Rig
    from lscan.measurement import Measures, SandwaveMeasures
    from lscan.pipeline import Reconstruction
    from lscan.records import Length

LEAST_SHARE = 0.02
"""Of the columns: a line that spans less of its pictures may be no laser line at all."""
_NO_SURFACE = (
    "there is no surface to build; a run of the board is for `lscan calibrate` and `lscan measure`"
)


def reconstruct(
    run: RunFolder,
    calibration: CalibrationFile,
    output: Annotated[Path, typer.Option("--output", "-o", help="Surface to write (.nc).")],
    points: Annotated[Path | None, typer.Option(help="Point cloud to write (.ply).")] = None,
    shaft: ShaftFile = None,
    trust: Trust = False,
    json: Json = False,
) -> None:
    """Turn a run's pictures into the surface that is measured, aligned if it is a sandwave's."""
    from lscan.cli.inputs import open_calibrated
    from lscan.errors import MeasurementError
    from lscan.pipeline import reconstruct as build
    from lscan.records import has_value
    from lscan.surface import save_points, save_surface

    require_folders(output, points)
    opened, plane_map = open_calibrated(run, calibration, shaft, trust)
    with progress_bar("reconstruct") as progress:
        built = build(opened, plane_map, progress)
    surface, alignment = built.surface, built.alignment
    frames, columns = surface.status.shape
    yaw_deg = alignment.yaw_deg if alignment else None
    found = int(has_value(surface.status).sum())
    if found == 0:
        raise MeasurementError(
            f"{run}: no laser line in any of its {frames} pictures, so {_NO_SURFACE}"
        )
    if found < LEAST_SHARE * surface.status.size:
        note(
            f"a line in {found} of {surface.status.size} columns alone; if the pictures show the "
            f"board, {_NO_SURFACE}"
        )
    _note_doubts(built, opened.rig_file.rig)
    save_surface(output, surface)
    if points:
        save_points(points, surface)
    if json:
        print_json(
            {
                "surface": output,
                "frame": surface.frame,
                "profiles": frames,
                "columns": columns,
                "points": found,
                "yaw_deg": yaw_deg,
                "corrections": surface.corrections,
            }
        )
    else:
        aligned = ", aligned" if surface.frame == "workpiece" else ""
        aligned += "" if yaw_deg is None else f", yaw {yaw_deg:.3f} deg"
        aligned += "".join(f", corrected for {what}" for what in surface.corrections)
        print(f"{found} points in {frames} profiles{aligned}; {output}")


def measure(
    run: RunFolder,
    calibration: CalibrationFile,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="JSON file to write.")
    ] = None,
    shaft: ShaftFile = None,
    trust: Trust = False,
    json: Json = False,
) -> None:
    """Measure the run's board, grooved block or sandwave against its nominal shape."""
    from lscan.cli.inputs import open_calibrated
    from lscan.files.jsontext import write_json
    from lscan.measurement import measure_run

    require_folders(output)
    opened, plane_map = open_calibrated(run, calibration, shaft, trust)
    with progress_bar("measure") as progress:
        measures = measure_run(opened, plane_map, progress)
    if output:
        write_json(output, measures.as_json())
    if json:
        print_json(measures.as_json())
    else:
        _print_measures(measures)


def _note_doubts(built: Reconstruction, rig: Rig) -> None:
    """Say on stderr that a sandwave was not found, and what was assumed of the sheet."""
    if built.unaligned:
        # Too few frames show the block's edges, say: the surface itself is none the worse.
        note(f"not aligned, in the head's frame: {built.unaligned}")
    if built.alignment is None and rig.sheet is not None:
        note(
            "the sheet's thickness is corrected for as if the sheet stood square to the track: "
            "without an alignment its yaw is not known"
        )


def _print_measures(measures: Measures) -> None:
    from lscan.measurement import BoardMeasures, GrooveMeasures

    if isinstance(measures, GrooveMeasures):
        _print_lengths("groove", measures.dimensions)
    elif isinstance(measures, BoardMeasures):
        _print_lengths("distances", measures.distances)
        _print_lengths("diameters", measures.diameters)
        for name, status in measures.unmeasured.items():
            print(f"{name}: not measured, {status.name}")
    else:
        _print_slices(measures)


def _print_lengths(title: str, lengths: Mapping[str, Length]) -> None:
    rows = [
        [name, length.nominal_mm, length.measured_mm, length.error_mm, length.sigma_mm]
        for name, length in lengths.items()
    ]
    print_table(title, ["", "nominal mm", "measured mm", "error mm", "sigma mm"], rows)


def _print_slices(measures: SandwaveMeasures) -> None:
    if measures.alignment.yaw_deg is not None:
        print(f"yaw {measures.alignment.yaw_deg:.3f} deg")
    rows = [
        [name, cut.points, cut.unseen, cut.rmse_mm, cut.min_mm, cut.max_mm]
        for name, cut in measures.errors.items()
    ]
    print_table("slices", ["", "points", "unseen", "rmse mm", "min mm", "max mm"], rows)
