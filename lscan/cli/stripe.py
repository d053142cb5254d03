"""The command ``lscan extract``: a thin face over lscan.stripe."""

import os
from pathlib import Path
from typing import Annotated

import typer

from lscan.cli.arguments import ChannelName, Json, Overlay, PictureOrRun, Trust, require_folders
from lscan.cli.console import print_json


def extract(
    picture: PictureOrRun,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="CSV table to write.")
    ] = None,
    background: Annotated[
        Path | None, typer.Option(help="The same view with the laser off.")
    ] = None,
    frame: Annotated[int, typer.Option(help="Which frame of a run folder.")] = 0,
    axis: Annotated[str | None, typer.Option(help="columns, or rows for an upright line.")] = None,
    extractor: Annotated[
        str | None, typer.Option(help="max, centroid, centroid-relative ...")
    ] = None,
    channel: ChannelName = None,
    threshold: Annotated[float | None, typer.Option(help="Least height of the line, DN.")] = None,
    span: Annotated[int | None, typer.Option(help="Pixels either side of the peak.")] = None,
    overlay: Overlay = None,
    trust: Trust = False,
    json: Json = False,
) -> None:
    """Find the laser line in one picture."""
    from lscan.acquisition.run import open_run
    from lscan.config.documents import check
    from lscan.config.rig import StripeSection
    from lscan.errors import InputError
    from lscan.files.pictures import read_picture, write_picture
    from lscan.records import has_value, status_counts
    from lscan.stripe import draw_stripe, extract_stripe, save_stripe

    require_folders(output, overlay)
    if os.path.isdir(picture):  # noqa: PTH112 - takes any text
        run = open_run(picture, trust)
        if not 0 <= frame < len(run):
            allowed = f"0 to {len(run) - 1}"
            raise InputError("no such frame", where="--frame", value=frame, allowed=allowed)
        shown, usual = run.frame(frame), run.rig_file.rig.stripe
        image, dark = shown.image, shown.background
    else:
        image, dark, usual = read_picture(picture), None, StripeSection()
    if background:
        dark = read_picture(background)
    given = {
        "axis": axis,
        "extractor": extractor,
        "channel": channel,
        "threshold_dn": threshold,
        "span_px": span,
    }
    changes = {key: value for key, value in given.items() if value is not None}
    settings = check(StripeSection, {**usual.model_dump(), **changes}, where="command line")
    stripe = extract_stripe(image, settings, dark)
    if overlay:
        write_picture(overlay, draw_stripe(image, stripe))
    if output:
        save_stripe(output, stripe)
    counts = status_counts(stripe.status)
    found = int(has_value(stripe.status).sum())
    if json:
        print_json({settings.axis: len(stripe.status), "found": found, "status": counts})
    else:
        listed = ", ".join(f"{name} {count}" for name, count in counts.items())
        print(f"line found in {found} of {len(stripe.status)} {settings.axis} ({listed})")
