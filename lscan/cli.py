"""The command line ``lscan``: thin faces over public functions."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any

# Before NumPy: its matrices here are small, and threads cost them more time than they save.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import typer

from lscan.arguments import (
    board_picture,
    open_calibrated,
    read_picture_of_board,
    require_folders,
    stripe_picture,
)
from lscan.bench_cli import bench
from lscan.console import print_json, print_table, progress_bar, run_command_line
from lscan.devices_cli import devices
from lscan.live_cli import live
from lscan.metric_cli import calibrate_metric
from lscan.shaft_cli import calibrate_shaft
from lscan.summaries import calibration_summary, print_calibration, print_check

app = typer.Typer(
    help="Laser line scanner: scan, calibrate, reconstruct, measure, report, live, bench.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

RunFolder = Annotated[Path, typer.Argument(help="Run folder.")]
PictureOrRun = Annotated[Path, typer.Argument(help="Picture file or run folder.")]
CalibrationFile = Annotated[
    Path, typer.Option("--calibration", "-c", help="Calibration file (JSON).")
]
ShaftFile = Annotated[
    Path | None,
    typer.Option("--shaft", help="TOML file with the [shaft] found; a run folder has its own."),
]
BoardFile = Annotated[
    Path | None, typer.Option("--board", help="Board file; a run folder has its own.")
]
Seeds = Annotated[
    str | None,
    typer.Option(
        "--seeds", help="u,v of the upper-left dot, the one beneath and the one to its right."
    ),
]
ChannelName = Annotated[str | None, typer.Option("--channel", help="red, green, blue or grey.")]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
Overlay = Annotated[
    Path | None,
    typer.Option("--overlay", help="Write the picture with what was found drawn on it."),
]


@app.command()
def scan(
    rig: Annotated[Path, typer.Argument(help="Rig file or scene file (TOML).")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Run folder to write.")],
    resume: Annotated[bool, typer.Option("--resume", help="Go on with a stopped run.")] = False,
    json: Json = False,
) -> None:
    """Move the track, take the pictures, write a run folder."""
    from lscan.acquire import scan as acquire
    from lscan.rig import load_rig

    rig_file = load_rig(rig)
    with progress_bar("scan") as report:
        run = acquire(rig_file, output, resume=resume, progress=report)
    if json:
        print_json({"run": str(run.path), "frames": len(run), "state": run.state})
    else:
        print(f"{len(run)} frames in {run.path}")


@app.command()
def calibrate(
    picture: PictureOrRun,
    output: Annotated[Path, typer.Option("--output", "-o", help="Calibration file to write.")],
    board: BoardFile = None,
    optics: Annotated[
        Path | None,
        typer.Option("--optics", help="TOML file with [optics]; a run folder has its own."),
    ] = None,
    plane_map: Annotated[
        str | None, typer.Option("--map", help="Plane map, such as graticule-2; auto: the best.")
    ] = None,
    seeds: Seeds = None,
    channel: ChannelName = None,
    overlay: Overlay = None,
    json: Json = False,
) -> None:
    """Find the board's control points in a picture and solve a plane map from them."""
    from lscan.controlpoints import draw_overlay
    from lscan.pictures import write_picture
    from lscan.planemap.auto import calibrate_best
    from lscan.planemap.calibration import calibrate as solve
    from lscan.planemap.calibration import save_calibration

    require_folders(output, overlay)
    given = board_picture(picture, board, optics)
    name = given.calibration.plane_map if plane_map is None else plane_map
    reading = read_picture_of_board(given, seeds, channel)
    if overlay:
        write_picture(overlay, draw_overlay(given.image, reading))
    with progress_bar("maps") as report:
        if name == "auto":
            calibration = calibrate_best(reading, given.optics, report)
        else:
            calibration = solve(reading, name, given.optics)
    save_calibration(output, calibration)
    summary = calibration_summary(output, calibration)
    if json:
        print_json(summary)
    else:
        print_calibration(summary)


@app.command()
def check(
    calibration: Annotated[Path, typer.Argument(help="Calibration file (JSON).")],
    picture: PictureOrRun,
    board: BoardFile = None,
    placed: Annotated[
        float | None,
        typer.Option("--placed", help="How well the board was put back, mm; else not judged."),
    ] = None,
    level: Annotated[float, typer.Option("--level", help="Chance of a false alarm.")] = 0.01,
    seeds: Seeds = None,
    channel: ChannelName = None,
    json: Json = False,
) -> None:
    """Score an old calibration against a new picture of the board; exit code 1 if it is off."""
    from dataclasses import asdict

    from lscan.planemap.calibration import load_calibration
    from lscan.planemap.check import check_calibration

    loaded = load_calibration(calibration)
    reading = read_picture_of_board(board_picture(picture, board), seeds, channel)
    found = check_calibration(loaded, reading, level, placed)
    if json:
        print_json({"agrees": found.agrees, **asdict(found)})
    else:
        print_check(found)
    if not found.agrees:
        raise typer.Exit(1)


@app.command()
def extract(
    picture: PictureOrRun,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="CSV table to write.")
    ] = None,
    background: Annotated[
        Path | None, typer.Option("--background", help="The same view with the laser off.")
    ] = None,
    frame: Annotated[int, typer.Option("--frame", help="Which frame of a run folder.")] = 0,
    axis: Annotated[
        str | None, typer.Option("--axis", help="columns, or rows for an upright line.")
    ] = None,
    extractor: Annotated[
        str | None, typer.Option("--extractor", help="max, centroid, centroid-relative ...")
    ] = None,
    channel: ChannelName = None,
    threshold: Annotated[
        float | None, typer.Option("--threshold", help="Least height of the line, DN.")
    ] = None,
    span: Annotated[
        int | None, typer.Option("--span", help="Pixels either side of the peak.")
    ] = None,
    overlay: Overlay = None,
    json: Json = False,
) -> None:
    """Find the laser line in one picture."""
    from lscan.documents import check
    from lscan.pictures import read_picture, write_picture
    from lscan.records import Status, has_value
    from lscan.rig import StripeSection
    from lscan.stripe import draw_stripe, extract_stripe, save_stripe

    require_folders(output, overlay)
    shown = stripe_picture(picture, frame)
    given = {
        "axis": axis,
        "extractor": extractor,
        "channel": channel,
        "threshold_dn": threshold,
        "span_px": span,
    }
    changes = {key: value for key, value in given.items() if value is not None}
    settings = check(
        StripeSection, {**shown.settings.model_dump(), **changes}, where="command line"
    )
    dark = read_picture(background) if background else shown.background
    stripe = extract_stripe(shown.image, settings, dark)
    if overlay:
        write_picture(overlay, draw_stripe(shown.image, stripe))
    if output:
        save_stripe(output, stripe)
    counts = {
        status.name: int((stripe.status == status).sum())
        for status in Status
        if (stripe.status == status).any()
    }
    found = int(has_value(stripe.status).sum())
    if json:
        print_json({settings.axis: len(stripe.status), "found": found, "status": counts})
    else:
        listed = ", ".join(f"{name} {count}" for name, count in counts.items())
        print(f"line found in {found} of {len(stripe.status)} {settings.axis} ({listed})")


@app.command()
def reconstruct(
    run: RunFolder,
    calibration: CalibrationFile,
    output: Annotated[Path, typer.Option("--output", "-o", help="Surface to write (.nc).")],
    points: Annotated[
        Path | None, typer.Option("--points", help="Point cloud to write (.ply).")
    ] = None,
    shaft: ShaftFile = None,
    json: Json = False,
) -> None:
    """Turn a run's pictures into a surface, aligned where the rig names a sandwave."""
    from lscan.experiment import reconstruct as build
    from lscan.records import has_value
    from lscan.surface import align_sandwave, apply, save_points, save_surface
    from lscan.targets import Sandwave

    require_folders(output, points)
    opened, plane_map = open_calibrated(run, calibration, shaft)
    with progress_bar("reconstruct") as report:
        surface = build(opened, plane_map, progress=report)
    rig = opened.rig_file.rig
    yaw_deg = None
    if isinstance(rig.workpiece, Sandwave):
        alignment = align_sandwave(surface, rig.workpiece, sheared=rig.shaft is None)
        surface = apply(alignment, surface)
        yaw_deg = float(np.degrees(alignment.yaw_rad)) if alignment.sheared else None
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
    }
    if json:
        print_json(summary)
    else:
        aligned = ", aligned" if surface.frame == "workpiece" else ""
        aligned += "" if yaw_deg is None else f", yaw {yaw_deg:.3f} deg"
        print(f"{found} points in {frames} profiles{aligned}; {output}")


@app.command()
def measure(
    run: RunFolder,
    calibration: CalibrationFile,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="JSON file to write.")
    ] = None,
    shaft: ShaftFile = None,
    json: Json = False,
) -> None:
    """Measure the run's board, grooved block or sandwave against its nominal shape."""
    import json as json_module

    from lscan.disk import write_atomically

    require_folders(output)
    opened, plane_map = open_calibrated(run, calibration, shaft)
    with progress_bar("measure") as report:
        measures = _measure(opened, plane_map, report)
    if output:
        text = json_module.dumps(measures, indent=2, allow_nan=False) + "\n"
        write_atomically(output, text.encode())
    if json:
        print_json(measures)
    else:
        _print_measures(measures)


@app.command()
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
    json: Json = False,
) -> None:
    """Evaluate the paper's experiment from its run folders and write the page."""
    from lscan.results import evaluate, write_experiment
    from lscan.run import open_run

    with progress_bar("evaluate") as progress:
        experiment = evaluate(
            open_run(board),
            open_run(groove) if groove else None,
            open_run(sandwave) if sandwave else None,
            progress=progress,
        )
    results = write_experiment(output, experiment)
    if json:
        print_json(results)
    else:
        print(f"{output / 'report.html'}")


@app.command()
def draw_board(
    board: Annotated[Path, typer.Argument(help="Board file, or a rig file that names one.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="SVG file to write.")],
    json: Json = False,
) -> None:
    """Draw a calibration board at its true size, to be printed or milled."""
    from lscan.arguments import board_of
    from lscan.disk import write_atomically
    from lscan.figures.plate import board_svg

    require_folders(output)
    drawn = board_of(board)
    write_atomically(output, board_svg(drawn).encode())
    left, right, bottom, top = drawn.outline_mm()
    if json:
        print_json({"drawing": str(output), "width_mm": right - left, "height_mm": top - bottom})
    else:
        print(f"{output}: {right - left:g} by {top - bottom:g} mm; print it at 100 %")


app.command()(calibrate_metric)
app.command()(calibrate_shaft)
app.command()(devices)
app.command()(bench)
app.command()(live)


def _measure(run: Any, plane_map: Any, report: Any) -> dict[str, Any]:
    """What a run can be measured for, by what its rig says stands in the tank."""
    from lscan.controlpoints import read_board
    from lscan.experiment import (
        lengths_json,
        mean_picture,
        measure_groove,
        measure_sandwave,
        require_board,
    )
    from lscan.measure import diameters, distances, unmeasured_distances
    from lscan.results import sandwave_json
    from lscan.targets import GroovedBlock, Sandwave

    piece = run.rig_file.rig.workpiece
    if isinstance(piece, GroovedBlock):
        return {"groove": lengths_json(measure_groove(run, plane_map).dimensions)}
    if isinstance(piece, Sandwave):
        return {"sandwave": sandwave_json(measure_sandwave(run, plane_map, report))}
    board = require_board(run)
    reading = read_board(mean_picture(run), board, channel=run.rig_file.rig.calibration.channel)
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


def main() -> None:
    """Entry point of the console script ``lscan``."""
    run_command_line(app, "lscan")


if __name__ == "__main__":
    main()
