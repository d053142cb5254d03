"""The command ``lscan extract``: a thin face over lscan.stripe."""

import os
from functools import partial, reduce
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
from typer import Argument, Option

from lscan.acquisition.run import open_run
from lscan.cli.console import EXTRACTORS, Json, Trust, note, one_of, require_folders, show
from lscan.cli.inputs import picture_part, plane_maps, read_as_stored
from lscan.config.documents import check
from lscan.config.rig import Rig, StripeSection
from lscan.errors import InputError
from lscan.files.pictures import read_picture, write_picture
from lscan.records import Ints, Mask, Picture, PlanePoints, Status, Stripe, has_value, status_counts
from lscan.stripe import draw_stripe, extract_stripe, save_stripe
from lscan.stripe.extract import extract_within, told_apart
from lscan.stripe.peaks import FWHM, line_width
from lscan.stripe.picture import lines_of
from lscan.surface.surface import to_profile

BOTH = "both"
RETURNS = ("brightest", "first", "last", BOTH)
BY_SPAN = ("max", "centroid", "centroid-relative")  # extractors that see span_px of a line alone


def extract(
    picture: Path = Argument(help="Picture file or run folder."),
    output: Path | None = Option(None, "--output", "-o", help="CSV table to write."),
    calibration: list[Path] | None = Option(
        None, "--calibration", "-c", help="Calibration file (JSON): points in mm as well."
    ),
    background: Path | None = Option(None, help="Picture of the same view with the laser off."),
    frame: int = Option(0, help="Number of the frame in a run folder."),
    axis: str | None = Option(None, help="columns, or rows if the line is upright."),
    extractor: str | None = Option(None, help=f"Extractor: {EXTRACTORS}"),
    channel: str | None = Option(
        None,
        help="red, green, blue, grey; red-, green-, blue-, cyan-, magenta-excess; auto, as for "
        "a single picture.",
    ),
    threshold: float | None = Option(
        None, "--threshold-dn", "--threshold", help="Least height of the line above the ground, DN."
    ),
    span: int | None = Option(
        None, "--span-px", "--span", help="Pixels on either side of the peak."
    ),
    returns: str | None = Option(
        None, help="Which of several lines: brightest, first or last; both, for two lasers."
    ),
    roi: str | None = Option(None, help="Part to search, by its corners: u0,v0,u1,v1 in px."),
    mask: Path | None = Option(
        None, help="Picture, white where the line may lie, black elsewhere."
    ),
    overlay: Path | None = Option(None, help="Picture to write, with what was found drawn on it."),
    trust: Trust = False,
    json: Json = False,
) -> None:
    """Find the laser line in one picture."""
    require_folders(output, overlay)
    image, dark, rig = _read_pictures(picture, frame, background, trust)
    usual = StripeSection(channel="auto") if rig is None else rig.stripe
    given = {
        "axis": axis, "extractor": extractor, "channel": channel, "threshold_dn": threshold,
        "span_px": span, "returns": None if returns == BOTH else returns,
    }  # fmt: skip
    if returns is not None:
        one_of(returns, RETURNS, "--returns", "names no line")
    changes = {key: value for key, value in given.items() if value is not None}
    settings = check(StripeSection, {**usual.model_dump(), **changes}, where="command line")
    maps = plane_maps(calibration or [], 2 if returns == BOTH else 1, image, picture, rig)
    stripes = _stripes(image, settings, picture_part(roi, mask, image), dark, returns == BOTH)
    in_mm = [to_profile(s, m, 0.0).points for s, m in zip(stripes, maps, strict=False)]
    found = [*zip_longest(stripes, in_mm)]  # each line, and its points in mm or None
    if overlay:
        write_picture(overlay, reduce(draw_stripe, stripes, image))
    for number, (stripe, points) in enumerate(found):
        if output:
            one_of_two = output.parent / f"{output.stem}-{number}{output.suffix}"
            save_stripe(output if len(found) == 1 else one_of_two, stripe, points)
    if any((s.status == Status.AMBIGUOUS).mean() > 0.25 for s in stripes):
        note(
            "many columns hold several lines that are equally bright: try --returns first, last or "
            "both, or --roi; or one that is narrower than the rows that a colour camera sees lie "
            "apart: widen it to 2.5 px, full width at half its height"
        )
    if not any(has_value(s.status).any() for s in stripes):
        note(
            f"none of the {settings.axis} has a peak above its ground: try another --channel or "
            "--axis, or a lower --threshold-dn; if a wide line leaves no ground, a smaller picture"
        )
    seen_px = 2 * settings.span_px + 1
    wide_px = _width_px(image, settings, stripes[0]) if settings.extractor in BY_SPAN else 0.0
    if wide_px > seen_px:
        note(
            f"the line is at least {wide_px:.0f} px wide at half its height, of which "
            f"{settings.extractor} sees {seen_px}: try --extractor ml, a larger --span-px, or "
            "state line_width_px under [stripe]"
        )
    if rig is roi is mask is None:
        shows_more = partial(_shows_more, image, dark, settings, stripes[0])
        across = "rows" if settings.axis == "columns" else "columns"
        if axis is None and shows_more(axis=across):
            note("far more rows than columns hold a line: use --axis rows for an upright line")
        elif channel is None and shows_more(channel="grey"):
            note(f"far more {settings.axis} hold a line in grey than in colour: try --channel grey")
    lines, words = [_counts(*one) for one in found], []
    for number, line in enumerate(lines):
        which = f"{number}: " if len(lines) > 1 else ""
        of = f"of {line[settings.axis]} {settings.axis}"
        words.append(f"{which}line found in {line['found']} {of} ({_in_words(line)})")
        if counts := line.get("points_mm"):
            words.append(f"{which}points in mm: {counts['found']} ({_in_words(counts)})")
    show(lines[0] if len(lines) == 1 else {"lines": lines}, *words, json=json)


def _read_pictures(
    picture: Path, frame: int, background: Path | None, trust: bool
) -> tuple[Picture, Picture | None, Rig | None]:
    """The picture, its background if there is one, and the rig of a run folder."""
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
    image: Picture, settings: StripeSection, keep: Mask | None, dark: Picture | None, both: bool
) -> tuple[Stripe, ...]:
    """The line in the part of the picture, or the two lines of a scanner with two lasers."""
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
    image: Picture, dark: Picture | None, settings: StripeSection, stripe: Stripe, **change: str
) -> bool:
    """Whether a line that few entries hold shows in twice as many with one setting changed."""
    found = has_value(stripe.status)
    if found.mean() >= 0.5:
        return False
    changed = extract_stripe(image, settings.model_copy(update=change), background=dark)
    return bool(has_value(changed.status).sum() > 2 * found.sum())


def _width_px(image: Picture, settings: StripeSection, stripe: Stripe) -> float:
    """Full width of the line at half its height, px; 0 where there is no line."""
    at = np.flatnonzero(has_value(stripe.status))
    if len(at) == 0:
        return 0.0
    columns = lines_of(image, settings.channel, settings.axis, where="image").grey
    return FWHM * line_width(columns, at, np.rint(stripe.centre_px[at]).astype(np.int64))


def _counts(stripe: Stripe, points: PlanePoints | None) -> dict[str, Any]:
    """How many entries of a line there are, by status."""

    def counts(status: Ints) -> dict[str, Any]:
        return {"found": int(has_value(status).sum()), "status": status_counts(status)}

    found = {stripe.axis: len(stripe.status), **counts(stripe.status)}
    return found if points is None else found | {"points_mm": counts(points.status)}


def _in_words(counts: dict[str, Any]) -> str:
    return ", ".join(f"{name} {count}" for name, count in counts["status"].items())
