"""The command ``lscan extract``: a thin face over lscan.stripe."""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lscan.cli.console import (
    EXTRACTORS,
    Json,
    Overlay,
    PictureOrRun,
    Trust,
    note,
    print_json,
    require_folders,
)

if TYPE_CHECKING:
    from lscan.config.rig import Rig, StripeSection
    from lscan.records import Bytes, Ints, Mask, PlanePoints, Stripe


BOTH = "both"
RETURNS = ("brightest", "first", "last", BOTH)
BY_SPAN = ("max", "centroid", "centroid-relative")  # extractors that see span_px of a line alone


def extract(
    picture: PictureOrRun,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="CSV table to write.")
    ] = None,
    calibration: Annotated[
        list[Path] | None,
        typer.Option("--calibration", "-c", help="Calibration file (JSON): points in mm as well."),
    ] = None,
    background: Annotated[
        Path | None, typer.Option(help="The same view with the laser off.")
    ] = None,
    frame: Annotated[int, typer.Option(help="Which frame of a run folder.")] = 0,
    axis: Annotated[str | None, typer.Option(help="columns, or rows for an upright line.")] = None,
    extractor: Annotated[str | None, typer.Option(help=EXTRACTORS)] = None,
    channel: Annotated[
        str | None,
        typer.Option(
            help="red, green, blue, grey; red-, green-, blue-, cyan-, magenta-excess; auto, as of "
            "a single picture."
        ),
    ] = None,
    threshold: Annotated[
        float | None,
        typer.Option("--threshold-dn", "--threshold", help="Least height of the line, DN."),
    ] = None,
    span: Annotated[
        int | None, typer.Option("--span-px", "--span", help="Pixels either side of the peak.")
    ] = None,
    returns: Annotated[
        str | None,
        typer.Option(help="Of several lines: brightest, first, last; both, of two lasers."),
    ] = None,
    roi: Annotated[
        str | None, typer.Option(help="u0,v0,u1,v1: corners of the part to look in, px.")
    ] = None,
    mask: Annotated[
        Path | None, typer.Option(help="Picture, white where the line may lie, black elsewhere.")
    ] = None,
    overlay: Overlay = None,
    trust: Trust = False,
    json: Json = False,
) -> None:
    """Find the laser line in one picture."""
    from lscan.cli.inputs import picture_part, plane_maps
    from lscan.config.documents import check
    from lscan.config.rig import StripeSection
    from lscan.errors import InputError
    from lscan.files.pictures import write_picture
    from lscan.records import Status, has_value
    from lscan.stripe import draw_stripe, save_stripe
    from lscan.surface.surface import to_profile

    require_folders(output, overlay)
    image, dark, rig = _pictures(picture, frame, background, trust)
    usual = StripeSection(channel="auto") if rig is None else rig.stripe
    given = {
        "axis": axis,
        "extractor": extractor,
        "channel": channel,
        "threshold_dn": threshold,
        "span_px": span,
        "returns": None if returns == BOTH else returns,
    }
    if returns not in (None, *RETURNS):
        allowed = ", ".join(RETURNS)
        raise InputError("names no line", where="--returns", value=returns, allowed=allowed)
    changes = {key: value for key, value in given.items() if value is not None}
    settings = check(StripeSection, {**usual.model_dump(), **changes}, where="command line")
    maps = plane_maps(calibration or [], 2 if returns == BOTH else 1, image, picture, rig)
    stripes = _stripes(image, settings, picture_part(roi, mask, image), dark, returns == BOTH)
    points = [to_profile(s, m, 0.0).points for s, m in zip(stripes, maps, strict=False)]
    if overlay:
        drawn = image
        for stripe in stripes:
            drawn = draw_stripe(drawn, stripe)
        write_picture(overlay, drawn)
    if output:
        for path, number in zip(_names(output, len(stripes)), range(len(stripes)), strict=True):
            save_stripe(path, stripes[number], points[number] if points else None)
    if any((s.status == Status.AMBIGUOUS).mean() > 0.25 for s in stripes):
        note(
            "many columns hold several lines as bright: try --returns first, last or both, or --roi"
        )
    if not any(has_value(s.status).any() for s in stripes):
        note(
            f"none of the {settings.axis} has a peak above its ground: try another --channel or "
            "--axis, a lower --threshold-dn; where a wide line leaves no ground, a smaller picture"
        )
    seen_px = 2 * settings.span_px + 1
    wide_px = _width_px(image, settings, stripes[0]) if settings.extractor in BY_SPAN else 0.0
    if wide_px > seen_px:
        note(
            f"the line is at least {wide_px:.0f} px wide at half its height, of which "
            f"{settings.extractor} sees {seen_px}: try --extractor ml, or a larger --span-px"
        )
    if rig is roi is mask is None:
        shows_more = partial(_shows_more, image, dark, settings, stripes[0])
        across = "rows" if settings.axis == "columns" else "columns"
        if axis is None and shows_more(axis=across):
            note("far more rows hold a line than columns: of an upright line say --axis rows")
        elif channel is None and shows_more(channel="grey"):
            note(f"far more {settings.axis} hold a line in grey than in colour: try --channel grey")
    lines = [_counted(s, points[k] if points else None) for k, s in enumerate(stripes)]
    if json:
        print_json(lines[0] if len(lines) == 1 else {"lines": lines})
    else:
        for number, line in enumerate(lines):
            _print_line(line, settings.axis, f"{number}: " if len(lines) > 1 else "")


def _pictures(
    picture: Path, frame: int, background: Path | None, trust: bool
) -> tuple[Bytes, Bytes | None, Rig | None]:
    """The picture, its background if there is one, and the rig of a run folder."""
    from lscan.acquisition.run import open_run
    from lscan.cli.inputs import read_as_stored
    from lscan.errors import InputError
    from lscan.files.pictures import read_picture

    dark = read_picture(background) if background else None
    if not os.path.isdir(picture):  # noqa: PTH112 - takes any text
        return read_as_stored(picture), dark, None
    run = open_run(picture, trust)
    if not 0 <= frame < len(run):
        allowed = f"0 to {len(run) - 1}"
        raise InputError("no such frame", where="--frame", value=frame, allowed=allowed)
    shown = run.frame(frame)
    return shown.image, shown.background if dark is None else dark, run.rig_file.rig


def _stripes(
    image: Bytes, settings: StripeSection, keep: Mask | None, dark: Bytes | None, both: bool
) -> tuple[Stripe, ...]:
    """The line in the part of the picture, or the two lines of a scanner with two lasers."""
    from lscan.errors import InputError
    from lscan.records import has_value
    from lscan.stripe import extract_stripe
    from lscan.stripe.extract import extract_within, told_apart

    find = extract_stripe if keep is None else partial(extract_within, keep=keep)
    if not both:
        return (find(image, settings, background=dark),)
    first, last = (settings.model_copy(update={"returns": which}) for which in ("first", "last"))
    upper, lower = find(image, first, background=dark), find(image, last, background=dark)
    two = told_apart(upper, lower)
    if (count := has_value(upper.status).sum()) and not any(has_value(s.status).any() for s in two):
        what = f"both: {count} {settings.axis} hold one line, and none holds two"
        allowed = "of one laser, brightest, first or last"
        raise InputError(what, where="--returns", allowed=allowed)
    return two


def _shows_more(
    image: Bytes, dark: Bytes | None, settings: StripeSection, stripe: Stripe, **change: str
) -> bool:
    """Whether a line that few entries hold shows in twice as many with one setting changed."""
    from lscan.records import has_value
    from lscan.stripe import extract_stripe

    found = has_value(stripe.status)
    if found.mean() >= 0.5:
        return False
    changed = extract_stripe(image, settings.model_copy(update=change), background=dark)
    return bool(has_value(changed.status).sum() > 2 * found.sum())


def _width_px(image: Bytes, settings: StripeSection, stripe: Stripe) -> float:
    """Full width of the line at half its height, px; 0 where there is no line."""
    import numpy as np

    from lscan.records import has_value
    from lscan.stripe.peaks import FWHM, line_width
    from lscan.stripe.picture import lines_of

    at = np.flatnonzero(has_value(stripe.status))
    if len(at) == 0:
        return 0.0
    columns = lines_of(image, settings.channel, settings.axis, where="image").grey
    return FWHM * line_width(columns, at, np.rint(stripe.centre_px[at]).astype(np.int64))


def _names(output: Path, count: int) -> list[Path]:
    """A file for each line: ``NAME-0.csv`` and ``NAME-1.csv`` of two."""
    if count == 1:
        return [output]
    return [output.parent / f"{output.stem}-{number}{output.suffix}" for number in range(count)]


def _counted(stripe: Stripe, points: PlanePoints | None) -> dict[str, Any]:
    """How many entries of a line there are, by status, as ``print_json`` takes it."""
    from lscan.records import has_value, status_counts

    def counts(status: Ints) -> dict[str, Any]:
        return {"found": int(has_value(status).sum()), "status": status_counts(status)}

    found = {stripe.axis: len(stripe.status), **counts(stripe.status)}
    return found if points is None else found | {"points_mm": counts(points.status)}


def _print_line(line: dict[str, Any], axis: str, which: str) -> None:
    def listed(counts: dict[str, int]) -> str:
        return ", ".join(f"{name} {count}" for name, count in counts.items())

    print(f"{which}line found in {line['found']} of {line[axis]} {axis} ({listed(line['status'])})")
    if in_mm := line.get("points_mm"):
        print(f"{which}points in mm: {in_mm['found']} ({listed(in_mm['status'])})")
