"""The line where the room is not dark: lit texture, frames, early clipping, two lasers.

Each figure counts columns over all seeds.  A column that holds a value is wrong where that lies
farther from the true line than four of its standard uncertainties and half a pixel.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lscan.config.rig import StripeSection
from lscan.files.pictures import read_picture
from lscan.records import Floats, Picture, Status, Stripe, has_value
from lscan.stripe import extract_stripe
from sim.render.tank import Tank
from sim.scene import Scene, load_scene
from sim.truth import stripe_truth
from tests.validation.exposures import pictures
from tests.validation.instrument.photographs import line_faults
from tests.validation.rows import Row, measured_rows, row
from tests.validation.surfaces.drawn import FieldEffort
from tests.validation.surfaces.lit import LitTarget, lit_mean, lit_picture

SIGMAS, SLACK_PX = 4.0, 0.5
EXTRACTORS = ("centroid-relative", "steger", "ml")
HEIGHT, WIDTH = 320, 480
CENTRE = 150 + 40 * np.sin(np.arange(WIDTH) / 80)
APART_PX = 60.0  # of two lines
# The weaker of 70 and 30 % is twice the threshold on black squares.
TWO_LIT = LitTarget(laser_dn=(600.0, 50.0, 30.0))
THRESHOLD_DN = 20.0
COARSE_PX = 30.0  # squares that a line 4 px wide is told from in one colour
CLIPS_DN = 180  # where the range of a camera ends that clips early
SCENES = {
    "lit block of the tank": "targets/lit.toml",
    "lit chessboard of the tank": "field/chessboard.toml",
    "groove by a camera that clips early": "field/clipping.toml",
}
EDGE_COLUMNS = 3  # beside an end of the line, where blur carries it on


@dataclass(frozen=True)
class Count:
    """Percent of the line's columns that were found, and of all columns that hold a wrong value."""

    found: float
    wrong: float


def line_rows(scenes: Path, effort: FieldEffort) -> list[Row]:
    """Rows of the line in the field.

    Parameters
    ----------
    scenes : Path, folder of the scene files
    effort : FieldEffort
    """
    photographs = effort.photographs
    return [
        *measured_rows("lit chessboards", lambda: lit_rows(effort)),
        *measured_rows("tank", lambda: tank_rows(scenes, effort)),
        *measured_rows("frame", lambda: frame_rows(scenes, effort)),
        *measured_rows("early clipping", lambda: clipping_rows(effort)),
        *measured_rows("two lasers", lambda: laser_rows(scenes, effort)),
        *([] if photographs is None else measured_rows("bust", lambda: bust_rows(photographs))),
    ]


def lit_rows(effort: FieldEffort) -> list[Row]:
    """Drawn chessboards under lamps, their squares from 70 px to 14 px, without a background."""
    rows = []
    for square_px in (70.0, 36.0, 14.0):
        drawn = lit_mean(LitTarget(square_px=square_px), CENTRE[None], np.ones(1), HEIGHT)
        shown = _drawn(drawn, effort)
        count = Count(100.0, 0.0)
        for extractor in EXTRACTORS:
            chosen = StripeSection(extractor=extractor, channel="auto", threshold_dn=THRESHOLD_DN)
            count = _worse(count, _count(shown, chosen, CENTRE))
        what = f"lit chessboard of {square_px:g} px"
        rows += count_rows(what, ", ".join(EXTRACTORS), count, effort)
        if square_px >= COARSE_PX:
            count = _count(shown, StripeSection(threshold_dn=THRESHOLD_DN), CENTRE)
            rows += count_rows(
                f"{what}, red alone", "centroid-relative", count, effort, "line-found-red"
            )
    return rows


def tank_rows(scenes: Path, effort: FieldEffort) -> list[Row]:
    """Lit texture and a range that ends early, in the tank."""
    rows = []
    for what, name in SCENES.items():
        scene = _plain(load_scene(scenes / name), effort)
        shown = pictures(scene, Tank(scene).render(0.0), effort.seeds)
        count = _count(shown, scene.rig.stripe, true_line(scene))
        rows += count_rows(what, scene.rig.stripe.extractor, count, effort)
    return rows


def frame_rows(scenes: Path, effort: FieldEffort) -> list[Row]:
    """The groove's pictures with a grey frame one pixel wide around them."""
    scene = _plain(load_scene(scenes / "field" / "frame.toml"), effort)
    shown = pictures(scene, Tank(scene).render(0.0), effort.seeds)
    stripes = [extract_stripe(picture, scene.rig.stripe) for picture in shown]
    border = np.mean([(stripe.status == Status.AT_BORDER).mean() for stripe in stripes])
    count = counted(stripes, true_line(scene))
    return [
        row("line-at-border", 100 * float(border), seeds=effort.seeded),
        *count_rows("groove in a frame", scene.rig.stripe.extractor, count, effort),
    ]


def clipping_rows(effort: FieldEffort) -> list[Row]:
    """A line twice as bright as the range of a camera that clips at 180 DN."""
    target = LitTarget(dark=1.0, lamp_dn=(8.0, 8.0, 8.0), laser_dn=(2.0 * CLIPS_DN, 9.0, 9.0))
    shown = _drawn(lit_mean(target, CENTRE[None], np.ones(1), HEIGHT), effort, CLIPS_DN)
    chosen = StripeSection(threshold_dn=THRESHOLD_DN)
    stripes = [extract_stripe(picture, chosen) for picture in shown]
    told = np.mean([(stripe.status == Status.SATURATED).mean() for stripe in stripes])
    return [
        row("line-clipped-told", 100 * float(told), clips=CLIPS_DN, seeds=effort.seeded),
        *count_rows("line clipped early", chosen.extractor, counted(stripes, CENTRE), effort),
    ]


def laser_rows(scenes: Path, effort: FieldEffort) -> list[Row]:
    """Two lasers, their power shared evenly and 70 to 30: in the tank, and on a lit chessboard."""
    scene = _plain(load_scene(scenes / "lasers" / "two-lines.toml"), effort)
    drawn = np.array([CENTRE - APART_PX / 2, CENTRE + APART_PX / 2])
    rows = []
    for shares in ((0.5, 0.5), (0.7, 0.3)):
        split = f"two lasers, {100 * shares[0]:g}/{100 * shares[1]:g}"
        lines = [
            line.model_copy(update={"share": share})
            for line, share in zip(scene.tank.laser.lines, shares, strict=True)
        ]
        shared = scene.with_tank(laser={"lines": tuple(lines)})
        shown = pictures(shared, Tank(shared).render(0.0), effort.seeds)
        both = np.array([true_line(shared, line) for line in range(2)])
        rows += told_apart_rows(f"{split}, groove", shown, shared.rig.stripe, both, effort)
        lit = _drawn(lit_mean(TWO_LIT, drawn, np.array(shares), HEIGHT), effort)
        chosen = StripeSection(channel="auto", threshold_dn=THRESHOLD_DN)
        rows += told_apart_rows(f"{split}, lit chessboard", lit, chosen, drawn, effort)
    return rows


def bust_rows(folder: Path) -> list[Row]:
    """The photograph of the bust without its background picture, by the excess of its colour."""
    lit = read_picture(folder / "webcam" / "bust_laser_on.png")
    missed, false = line_faults(lit, None, "steger", "auto")
    return [
        row("line-bust-missed", 100 * missed),
        row("line-bust-false", 100 * false / len(lit)),
    ]


def told_apart_rows(
    what: str, shown: Sequence[Picture], chosen: StripeSection, truths: Floats, effort: FieldEffort
) -> list[Row]:
    """Rows of the worse of two lines, each asked for by its place.

    Parameters
    ----------
    what : str, whose lines
    shown : sequence of (H, W, 3) arrays, the pictures
    chosen : StripeSection, how they are read, but for which of the lines
    truths : (2, W) array, px, their true rows, NaN where hidden
    effort : FieldEffort
    """
    with np.errstate(all="ignore"):
        upper = int(np.nanmean(truths[1] - truths[0]) < 0)
    count = Count(100.0, 0.0)
    for returns, line in (("first", upper), ("last", 1 - upper)):
        settings = chosen.model_copy(update={"returns": returns})
        count = _worse(count, _count(shown, settings, truths[line]))
    return count_rows(what, chosen.extractor, count, effort, "line-lasers-found")


def count_rows(
    what: str, extractor: str, count: Count, effort: FieldEffort, key: str = "line-found"
) -> list[Row]:
    """Rows of what was found and of what was wrong.

    Parameters
    ----------
    what : str, whose line
    extractor : str, which read it
    count : Count, percent
    effort : FieldEffort
    key : str, of rows.toml, for what was found
    """
    return [
        row(name, figure, what=what, extractor=extractor, seeds=effort.seeded)
        for name, figure in ((key, count.found), ("line-wrong", count.wrong))
    ]


def _drawn(mean_dn: Floats, effort: FieldEffort, clips_dn: int = 255) -> list[Picture]:
    """One picture for each seed."""
    return [lit_picture(mean_dn, np.random.default_rng(seed), clips_dn) for seed in effort.seeds]


def _plain(scene: Scene, effort: FieldEffort) -> Scene:
    """The scene as this effort renders it."""
    if not effort.plain:
        return scene
    return scene.with_tank(render={"fineness": 1, "samples": 4, "scatter_samples": 0})


def true_line(scene: Scene, line: int = 0) -> Floats:
    """(W,) row of the true line in each column, px; NaN where it is hidden.

    Parameters
    ----------
    scene : Scene, the head at track position 0
    line : int, which of the laser's sheets
    """
    truth = stripe_truth(scene, 0.0, line)
    return np.where(truth.status == Status.OK, truth.centre_px, np.nan)


def _count(shown: Iterable[Picture], chosen: StripeSection, truth: Floats) -> Count:
    return counted([extract_stripe(picture, chosen) for picture in shown], truth)


def counted(stripes: Sequence[Stripe], truth: Floats) -> Count:
    """The line found and the wrong values, over all the stripes.

    Beside a place where the line ends or jumps, blur carries it on: there the true line is what
    it is within EDGE_COLUMNS, and a column without a value is not missed.

    Parameters
    ----------
    stripes : sequence of Stripe, px
    truth : (W,) array, px, row of the true line, NaN where there is none
    """
    near = np.array([_shifted(truth, by) for by in range(-EDGE_COLUMNS, EDGE_COLUMNS + 1)])
    with np.errstate(invalid="ignore"):
        inner = np.isfinite(near).all(axis=0) & (np.abs(np.diff(near, axis=0)) < 3).all(axis=0)
    found, wrong = [], []
    for stripe in stripes:
        valued = has_value(stripe.status)
        error = np.abs(stripe.centre_px - near)
        off = np.nanmin(np.where(np.isnan(error), np.inf, error), axis=0)
        off[inner] = np.abs(stripe.centre_px - truth)[inner]
        found.append(valued[inner].mean())
        wrong.append((valued & (off > SIGMAS * stripe.sigma_px + SLACK_PX)).mean())
    return Count(100 * float(np.mean(found)), 100 * float(np.mean(wrong)))


def _shifted(truth: Floats, by: int) -> Floats:
    """The truth of the column ``by`` to the right of each; NaN beyond the picture."""
    padded = np.pad(truth, EDGE_COLUMNS, constant_values=np.nan)
    return padded[EDGE_COLUMNS + by :][: len(truth)]


def _worse(one: Count, other: Count) -> Count:
    return Count(min(one.found, other.found), max(one.wrong, other.wrong))
