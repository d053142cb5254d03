"""The commands from a run to numbers: ``lscan reconstruct``, ``measure`` and ``report``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lscan.cli.arguments import (
    CalibrationFile,
    Json,
    RunFolder,
    ShaftFile,
    Trust,
    open_calibrated,
    require_folders,
)
from lscan.cli.console import print_json, print_table, progress_bar

if TYPE_CHECKING:
    from lscan.config.rig import Rig
    from lscan.pipeline import Reconstruction


def reconstruct(
    run: RunFolder,
    calibration: CalibrationFile,
    output: Annotated[Path, typer.Option("--output", "-o", help="Surface to write (.nc).")],
    points: Annotated[
        Path | None, typer.Option("--points", help="Point cloud to write (.ply).")
    ] = None,
    shaft: ShaftFile = None,
    trust: Trust = False,
    json: Json = False,
) -> None:
    """Turn a run's pictures into the surface that is measured, aligned if it is a sandwave's."""
    import numpy as np

    from lscan.pipeline import reconstruct as build
    from lscan.records import has_value
    from lscan.surface import save_points, save_surface

    require_folders(output, points)
    opened, plane_map = open_calibrated(run, calibration, shaft, trust)
    with progress_bar("reconstruct") as report:
        built = build(opened, plane_map, report)
    _note_doubts(built, opened.rig_file.rig)
    surface, alignment = built.surface, built.alignment
    yaw_deg = float(np.degrees(alignment.yaw_rad)) if alignment and alignment.sheared else None
    save_surface(output, surface)
    if points:
        save_points(points, surface)
    frames, columns = surface.status.shape
    found = int(has_value(surface.status).sum())
    summary = {
        "surface": str(output),
        "frame": surface.frame,
        "profiles": frames,
        "columns": columns,
        "points": found,
        "yaw_deg": yaw_deg,
        "corrections": list(surface.corrections),
    }
    if json:
        print_json(summary)
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
    import json as json_module

    from lscan.files.disk import write_atomically

    require_folders(output)
    opened, plane_map = open_calibrated(run, calibration, shaft, trust)
    with progress_bar("measure") as report:
        measures = _measure(opened, plane_map, report)
    if output:
        text = json_module.dumps(measures, indent=2, allow_nan=False) + "\n"
        write_atomically(output, text.encode())
    if json:
        print_json(measures)
    else:
        _print_measures(measures)


def report(
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for report.html and results.json.")
    ],
    board: Annotated[Path, typer.Option("--board", help="Run folder of the board picture.")],
    groove: Annotated[
        Path | None, typer.Option("--groove", help="Run folder of the grooved block.")
    ] = None,
    sandwave: Annotated[
        Path | None, typer.Option("--sandwave", help="Run folder of the sandwave.")
    ] = None,
    trust: Trust = False,
    json: Json = False,
) -> None:
    """Evaluate the paper's experiment from its run folders and write the page."""
    from lscan.acquisition.run import open_run
    from lscan.cli.summaries import print_chains
    from lscan.paper.evaluation import evaluate
    from lscan.paper.results import write_experiment

    with progress_bar("evaluate") as progress:
        experiment = evaluate(
            open_run(board, trust),
            open_run(groove, trust) if groove else None,
            open_run(sandwave, trust) if sandwave else None,
            progress=progress,
        )
    results = write_experiment(output, experiment)
    if json:
        print_json(results)
    else:
        print_chains(results)
        print(f"{output / 'report.html'}")


def _note_doubts(built: Reconstruction, rig: Rig) -> None:
    """Say on stderr that a sandwave was not found, and what of the sheet was taken for granted."""
    notes = []
    if built.unaligned:
        # Too few frames show the block's edges, say: the surface itself is none the worse.
        notes.append(f"not aligned, in the head's frame: {built.unaligned}")
    if built.alignment is None and rig.sheet is not None:
        notes.append(
            "the sheet's thickness is corrected for as if the sheet stood square to the track: "
            "without an alignment its yaw is not known"
        )
    for note in notes:
        print(f"lscan: note: {note}", file=sys.stderr)


def _measure(run: Any, plane_map: Any, report: Any) -> dict[str, Any]:
    """What a run can be measured for, by what its rig says stands in the tank."""
    from lscan.config.targets import GroovedBlock, Sandwave
    from lscan.errors import MeasurementError
    from lscan.measure import diameters, distances, unmeasured_distances
    from lscan.paper.experiment import (
        lengths_json,
        measure_groove,
        measure_sandwave,
        read_shown_board,
    )
    from lscan.paper.results import sandwave_json

    piece = run.rig_file.rig.workpiece
    try:
        if isinstance(piece, GroovedBlock):
            return {"groove": lengths_json(measure_groove(run, plane_map).dimensions)}
        if isinstance(piece, Sandwave):
            return {"sandwave": sandwave_json(measure_sandwave(run, plane_map, report))}
    except MeasurementError as error:
        error.add_note(
            f"[workpiece] of the run's rig file is a {piece.kind}; where something else was "
            "scanned, `lscan reconstruct` gives its surface"
        )
        raise
    board, reading = read_shown_board(run)
    missing = unmeasured_distances(reading, board, plane_map)
    return {
        "distances": lengths_json(distances(reading, board, plane_map)),
        "diameters": lengths_json(diameters(reading, board, plane_map)),
        "unmeasured": {name: status.name for name, status in missing.items()},
    }


def _print_measures(measures: dict[str, Any]) -> None:
    for title, entries in measures.items():
        if title == "sandwave":
            _print_slices(entries)
            continue
        if title == "unmeasured":
            for name, reason in entries.items():
                print(f"{name}: not measured, {reason}")
            continue
        rows = [[name, *entry.values()] for name, entry in entries.items()]
        print_table(title, ["", "nominal mm", "measured mm", "error mm", "sigma mm"], rows)


def _print_slices(entries: dict[str, Any]) -> None:
    if entries["yaw_deg"]["estimated"] is not None:
        print(f"yaw {entries['yaw_deg']['estimated']:.3f} deg")
    rows = [[name, *cut.values()] for name, cut in entries["slices"].items()]
    print_table("slices", ["", "points", "unseen", "rmse mm", "min mm", "max mm"], rows)
