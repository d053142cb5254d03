"""The report: one self-contained page that a reader of the paper recognises.

Every figure and table of the paper that there are data for has its counterpart on the page,
with the paper's number beside ours.  The page loads nothing from anywhere.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lscan.acquisition import provenance
from lscan.figures.reportfigure import ReportFigure, RowFits, RulerCurve, SliceData
from lscan.files.disk import write_atomically
from lscan.paper import published as paper
from lscan.paper.checks import checks
from lscan.paper.tables import Table, paper_tables
from lscan.records import BoardReading, Bytes, Floats, Mask, Stripe, Surface

if TYPE_CHECKING:
    from jinja2 import Environment

_SLICE_FIGURES = {"S1": "Fig. 29", "S2": "Fig. 30", "S3": "Fig. 31", "SD": "Fig. 32"}


@dataclass(frozen=True)
class ReportInputs:
    """All that a report may show; what is None, or empty, the page leaves out.

    results: what results.json holds.
    board_image: (H, W, 3) uint8.  board_overlay: the same with crosses and search boxes.
    reading: the marks found.  row: one row of control points with its fits.  ruler: the
        conversion curve of one ruler.
    groove_image: (H, W, 3) uint8, and groove_stripe: the line found in it.
    sandwave_images: consecutive frames, each (H, W, 3) uint8, of which up to three are
        shown; sandwave_stripe: the line found in the first.
    raw: the surface as scanned.  levelled: (F, N, 3) mm after reorientation, with corners,
        W_L and W_R, (3,) mm each, in the same frame.  turned: (F, N, 3) mm with W_L W_R
        along x, before yaw calibration.  aligned: the surface after it.
    slices: name to slice of the aligned surface.
    bars: the largest errors accepted.
    """

    results: Mapping[str, Any] = field(default_factory=dict)
    board_image: Bytes | None = None
    board_overlay: Bytes | None = None
    reading: BoardReading | None = None
    row: RowFits | None = None
    ruler: RulerCurve | None = None
    groove_image: Bytes | None = None
    groove_stripe: Stripe | None = None
    sandwave_images: Sequence[Bytes] = ()
    sandwave_stripe: Stripe | None = None
    raw: Surface | None = None
    levelled: Floats | None = None
    corners: tuple[Floats, Floats] | None = None
    turned: Floats | None = None
    aligned: Surface | None = None
    slices: Mapping[str, SliceData] = field(default_factory=dict)
    bars: paper.Bars = field(default_factory=paper.Bars)


@dataclass(frozen=True)
class Section:
    """A part of the page: its heading and its figures."""

    title: str
    figures: tuple[ReportFigure, ...]


def write_report(path: Path, inputs: ReportInputs) -> None:
    """Write the page to ``path``; the same inputs give the same bytes.

    Raises InputError where the disk refuses or a picture is none; the old file then stays.
    """
    write_atomically(path, render_report(inputs).encode("utf-8"))


def render_report(inputs: ReportInputs) -> str:
    """The page as HTML text."""
    sections = _sections(inputs)
    scripts = [figure.script for part in sections for figure in part.figures if figure.script]
    results = inputs.results
    return (
        _environment()
        .get_template("report.html.j2")
        .render(
            title=provenance.title(results),
            lead=provenance.lead(results),
            cameras=provenance.cameras(results),
            chains=provenance.chains_in_words(results),
            names=provenance.chain_names(results),
            versions=results.get("versions", {}),
            seconds=results.get("seconds", {}),
            checks=checks(results, inputs.bars),
            checks_note=provenance.note(results, provenance.PARTS),
            tables=[_noted_table(table, results) for table in paper_tables(results, inputs.bars)],
            sections=sections,
            misprints=paper.MISPRINTS,
            plotly=_plotly() if scripts else "",
            scripts=scripts,
        )
    )


def _sections(inputs: ReportInputs) -> list[Section]:
    groove, sandwave = _stripe_figures(inputs)
    parts = {
        "Calibration": _noted(_board_figures(inputs), inputs, "board"),
        "The laser line": _noted(groove, inputs, "groove") + _noted(sandwave, inputs, "sandwave"),
        "The surface": _noted(_surface_figures(inputs), inputs, "board", "sandwave"),
        "Slices": _noted(_slice_figures(inputs), inputs, "board", "sandwave"),
        "Sensitivity of the fits": _noted(_sensitivity_figures(inputs), inputs, "board"),
    }
    return [Section(title, tuple(figures)) for title, figures in parts.items() if figures]


def _noted(
    figures: Sequence[ReportFigure], inputs: ReportInputs, *parts: str
) -> list[ReportFigure]:
    """The figures, their captions saying where the pictures of these parts come from."""
    note = provenance.note(inputs.results, parts)
    return [replace(e, caption=f"{e.caption} {note}".rstrip()) for e in figures]


def _noted_table(table: Table, results: Mapping[str, Any]) -> Table:
    note = provenance.note(results, table.parts)
    return replace(table, caption=f"{table.caption} {note}".rstrip())


# The drawing modules load matplotlib, which takes a second: only where something is drawn.


def _board_figures(inputs: ReportInputs) -> list[ReportFigure]:
    from lscan.paper.figures import board

    figures = []
    if inputs.board_image is not None:
        figures.append(board.board_picture(inputs.board_image, inputs.reading))
    marked = inputs.board_overlay is not None
    picture = inputs.board_overlay if marked else inputs.board_image
    if picture is not None and (marked or inputs.reading is not None):
        figures.append(board.control_points(picture, inputs.reading, marked))
    if inputs.row is not None:
        figures.append(board.line_fits(inputs.row))
    if inputs.ruler is not None:
        figures.append(board.ruler(inputs.ruler))
    return figures


def _sensitivity_figures(inputs: ReportInputs) -> list[ReportFigure]:
    from lscan.paper.figures import board

    row = inputs.row
    if row is None or row.shifted_curves is None:
        return []
    figures = {"graticule-bspline": "Fig. 33", "graticule-2": "Fig. 34"}
    there = row.curves.keys() & row.shifted_curves.keys()
    return [board.sensitivity(row, name, fig) for name, fig in figures.items() if name in there]


def _stripe_figures(inputs: ReportInputs) -> tuple[list[ReportFigure], list[ReportFigure]]:
    """Those of the grooved block, and those of the sandwave."""
    from lscan.paper.figures import stripes

    groove, sandwave = [], []
    if inputs.groove_image is not None:
        groove.append(stripes.groove_snapshot(inputs.groove_image, inputs.groove_stripe))
    frames = list(inputs.sandwave_images)[:3]
    if frames:
        stripe = inputs.sandwave_stripe
        column = stripes.lit_column(stripe, frames[0].shape[1])
        sandwave.append(stripes.sandwave_snapshot(frames[0], stripe, column))
        sandwave.append(stripes.column_intensities(frames, column))
    return groove, sandwave


def _surface_figures(inputs: ReportInputs) -> list[ReportFigure]:
    from lscan.paper.figures import contours, interactive, relief

    raw = _drawable(inputs.raw.xyz_mm if inputs.raw else None)
    levelled, turned = _drawable(inputs.levelled), _drawable(inputs.turned)
    aligned = _drawable(inputs.aligned.xyz_mm if inputs.aligned else None)
    yaw_deg = ((inputs.results.get("sandwave") or {}).get("yaw_deg") or {}).get("estimated")
    waves = _on_the_waves(inputs)
    figures = []
    if raw is not None:
        figures.append(relief.raw_relief(raw))
    if levelled is not None:
        figures.append(relief.levelled_relief(levelled, inputs.corners))
    if turned is not None:
        figures.append(contours.contours_before(turned, yaw_deg, waves))
    if aligned is not None:
        figures.append(contours.contours_after(aligned, yaw_deg, inputs.slices, waves))
    last = aligned if aligned is not None else raw
    if last is not None:
        figures.append(interactive.surface_to_turn(last, waves))
    return figures


def _on_the_waves(inputs: ReportInputs) -> Mask | None:
    """(F, N) the aligned points within the slices, one of which is the diagonal of the waves.

    None where there are no such points.  The surface before alignment has the same points.
    """
    ends = [data.ends_mm for data in inputs.slices.values() if data.ends_mm is not None]
    if inputs.aligned is None or not ends:
        return None
    low, high = (extreme(np.concatenate(ends), axis=0) for extreme in (np.min, np.max))
    xyz = inputs.aligned.xyz_mm
    inside = np.isfinite(xyz).all(axis=2)
    inside &= ((xyz[..., :2] >= low) & (xyz[..., :2] <= high)).all(axis=2)
    return inside if np.count_nonzero(inside.any(axis=1)) >= 2 else None


def _drawable(xyz_mm: Floats | None) -> Floats | None:
    """The (F, N, 3) points where two profiles or more hold some, else None."""
    if xyz_mm is None:
        return None
    held = np.isfinite(xyz_mm).all(axis=2).sum(axis=1)
    return xyz_mm if np.count_nonzero(held) >= 2 else None


def _slice_figures(inputs: ReportInputs) -> list[ReportFigure]:
    from lscan.paper.figures import slices

    return [
        slices.slice_plot(name, data, _SLICE_FIGURES.get(name, ""), inputs.bars.sandwave_mm)
        for name, data in inputs.slices.items()
    ]


def _environment() -> Environment:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("lscan.paper", ""),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["unbroken"] = _unbroken
    return environment


def _unbroken(text: str) -> str:
    """The text with each number tied to its unit, so that no line breaks between them."""
    return re.sub(r"(?<=\d) (?=(?:mm|px|DN|s|%)(?!\w))", "\u00a0", text)


def _plotly() -> str:
    from plotly.offline import get_plotlyjs

    return str(get_plotlyjs())
