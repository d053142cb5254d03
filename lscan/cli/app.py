"""The command line ``lscan``: thin faces over public functions."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated

# Before NumPy: its matrices here are small, and threads cost them more time than they save.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import typer

from lscan.cli.arguments import (
    Json,
    Trust,
    board_picture,
    read_picture_of_board,
    require_folders,
    stripe_picture,
)
from lscan.cli.benchmark import bench
from lscan.cli.console import print_json, progress_bar, run_command_line, tell_notes_when_stopped
from lscan.cli.devices import devices
from lscan.cli.live import live
from lscan.cli.measure import measure, reconstruct, report
from lscan.cli.multiview import calibrate_metric
from lscan.cli.scenes import scenes
from lscan.cli.shaft import calibrate_shaft
from lscan.cli.summaries import calibration_summary, print_calibration, print_check

app = typer.Typer(
    help="Laser line scanner: scan, calibrate, reconstruct, measure, report, live, bench.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

PictureOrRun = Annotated[Path, typer.Argument(help="Picture file or run folder.")]
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
Overlay = Annotated[
    Path | None,
    typer.Option("--overlay", help="Write the picture with what was found drawn on it."),
]


@app.command()
def scan(
    rig: Annotated[Path, typer.Argument(help="Rig file or scene file (TOML), or a scene's name.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Run folder to write.")],
    resume: Annotated[bool, typer.Option("--resume", help="Go on with a stopped run.")] = False,
    position_restored: Annotated[
        bool,
        typer.Option(
            "--position-restored",
            help="With --resume, after the track lost its zero: the head was put back by hand.",
        ),
    ] = False,
    json: Json = False,
) -> None:
    """Move the track, take the pictures, write a run folder."""
    from lscan.acquisition.scan import scan as acquire
    from lscan.acquisition.writer import holds_no_run
    from lscan.config.rig import load_rig
    from lscan.errors import InputError

    if position_restored and not resume:
        raise InputError("goes with --resume only", where="--position-restored")
    rig_file = load_rig(rig)
    if resume and holds_no_run(output):
        what = f"there is nothing to resume in {output}; a new run is begun"
        print(f"lscan: note: {what}", file=sys.stderr)
    with tell_notes_when_stopped(), progress_bar("scan") as report:
        run = acquire(
            rig_file, output, resume=resume, position_restored=position_restored, progress=report
        )
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
    trust: Trust = False,
    json: Json = False,
) -> None:
    """Find the board's control points in a picture and solve a plane map from them."""
    from lscan.board import draw_overlay
    from lscan.calibration.maps.auto import calibrate_best
    from lscan.calibration.solve import calibrate as solve
    from lscan.calibration.solve import save_calibration
    from lscan.files.pictures import write_picture

    require_folders(output, overlay)
    given = board_picture(picture, board, optics, trust)
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
    trust: Trust = False,
    json: Json = False,
) -> None:
    """Score an old calibration against a new picture of the board; exit code 1 if it is off."""
    from dataclasses import asdict

    from lscan.calibration.check import check_calibration
    from lscan.calibration.solve import load_calibration

    loaded = load_calibration(calibration)
    given = board_picture(picture, board, trusted=trust)
    reading = read_picture_of_board(given, seeds, channel)
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
    trust: Trust = False,
    json: Json = False,
) -> None:
    """Find the laser line in one picture."""
    from lscan.config.documents import check
    from lscan.config.rig import StripeSection
    from lscan.files.pictures import read_picture, write_picture
    from lscan.records import Status, has_value
    from lscan.stripe import draw_stripe, extract_stripe, save_stripe

    require_folders(output, overlay)
    shown = stripe_picture(picture, frame, trust)
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
def draw_board(
    board: Annotated[Path, typer.Argument(help="Board file, or a rig file that names one.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="SVG file to write.")],
    json: Json = False,
) -> None:
    """Draw a calibration board at its true size, to be printed or milled."""
    from lscan.board.plate import board_svg
    from lscan.cli.arguments import board_of
    from lscan.files.disk import write_atomically

    require_folders(output)
    drawn = board_of(board)
    write_atomically(output, board_svg(drawn).encode())
    left, right, bottom, top = drawn.outline_mm()
    if json:
        print_json({"drawing": str(output), "width_mm": right - left, "height_mm": top - bottom})
    else:
        print(f"{output}: {right - left:g} by {top - bottom:g} mm; print it at 100 %")


app.command()(reconstruct)
app.command()(measure)
app.command()(report)
app.command()(calibrate_metric)
app.command()(calibrate_shaft)
app.command()(scenes)
app.command()(devices)
app.command()(bench)
app.command()(live)


def main() -> None:
    """Entry point of the console script ``lscan``."""
    run_command_line(app, "lscan")


if __name__ == "__main__":
    main()
