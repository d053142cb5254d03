"""The report: one self-contained page that a reader of the paper recognises.

Every figure and table of the paper that there are data for has its counterpart on the page,
with the paper's number beside ours.  The page loads nothing from anywhere.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from lscan.acquisition.run import software_versions
from lscan.figures.reportfigure import ReportFigure
from lscan.files.disk import write_atomically
from lscan.paper import provenance
from lscan.paper.checks import checks
from lscan.paper.experiment import Experiment, LinePictures
from lscan.paper.published import MISPRINTS, Bars
from lscan.paper.tables import ReportTable, paper_tables

if TYPE_CHECKING:
    from lscan.measurement import SandwaveMeasures

_SLICE_FIGURES = {"S1": "Fig. 29", "S2": "Fig. 30", "S3": "Fig. 31", "SD": "Fig. 32"}


@dataclass(frozen=True)
class ReportSection:
    """A part of the page.

    Attributes
    ----------
    title : str, its heading
    figures : sequence of ReportFigure, in their order
    """

    title: str
    figures: Sequence[ReportFigure]


def write_report(path: Path, experiment: Experiment, bars: Bars | None = None) -> None:
    """Write the page to a file; the same experiment gives the same bytes.

    Parameters
    ----------
    path : Path, of the HTML file
    experiment : Experiment, pieces that were not scanned have no part of the page
    bars : Bars, optional, the largest errors accepted; those that the paper claims by default

    Raises
    ------
    InputError
        Where the disk refuses or a picture is none; the old file then stays.
    """
    write_atomically(path, render_report(experiment, bars).encode("utf-8"))


def render_report(experiment: Experiment, bars: Bars | None = None) -> str:
    """The page as HTML text.

    Parameters
    ----------
    experiment : Experiment
        Pieces that were not scanned have no part of the page.
    bars : Bars, optional
        The largest errors accepted; those that the paper claims by default.
    """
    from lscan.figures.template import page_template

    bars = bars or Bars()
    sources = experiment.sources
    sections = _sections(experiment, bars)
    scripts = [figure.script for part in sections for figure in part.figures if figure.script]
    return page_template("lscan.paper", "report.html.j2", unbroken=_unbroken).render(
        title=provenance.title(experiment),
        lead=provenance.lead(sources),
        cameras=provenance.cameras(sources),
        chains=provenance.describe_chains(experiment),
        names=provenance.chain_names(experiment.chain),
        versions=software_versions(),
        seconds=experiment.seconds,
        checks=checks(experiment, bars),
        checks_note=provenance.note(sources),
        tables=[_noted_table(table, sources) for table in paper_tables(experiment, bars)],
        sections=sections,
        misprints=MISPRINTS,
        plotly=_plotly() if scripts else "",
        scripts=scripts,
    )


def _sections(experiment: Experiment, bars: Bars) -> list[ReportSection]:
    # The drawing modules load matplotlib, which takes a second: only where something is drawn.
    from lscan.paper.figures import board, stripes

    sources, shown, sandwave = experiment.sources, experiment.shown, experiment.sandwave
    calibration, sensitivity = board.board_figures(experiment.board)
    lines = []
    if "groove" in shown:
        lines += _noted([stripes.groove_snapshot(shown["groove"])], sources, "groove")
    if "sandwave" in shown:
        lines += _noted(_sandwave_lines(shown["sandwave"]), sources, "sandwave")
    surface = [] if sandwave is None else _surface_figures(sandwave)
    slices = [] if sandwave is None else _slice_figures(sandwave, bars)
    parts = {
        "Calibration": _noted(calibration, sources, "board"),
        "The laser line": lines,
        "The surface": _noted(surface, sources, "board", "sandwave"),
        "Slices": _noted(slices, sources, "board", "sandwave"),
        "Sensitivity of the fits": _noted(sensitivity, sources, "board"),
    }
    return [ReportSection(title, figures) for title, figures in parts.items() if figures]


def _noted(
    figures: Sequence[ReportFigure], sources: provenance.Sources, *parts: str
) -> list[ReportFigure]:
    """The figures, their captions saying where the pictures of these parts come from."""
    note = provenance.note(sources, parts)
    return [replace(figure, caption=f"{figure.caption} {note}".rstrip()) for figure in figures]


def _noted_table(table: ReportTable, sources: provenance.Sources) -> ReportTable:
    note = provenance.note(sources, table.parts)
    return replace(table, caption=f"{table.caption} {note}".rstrip())


def _sandwave_lines(pictures: LinePictures) -> list[ReportFigure]:
    from lscan.paper.figures import stripes

    column = stripes.lit_column(pictures)
    return [
        stripes.sandwave_snapshot(pictures, column),
        stripes.column_intensities(pictures.images, column),
    ]


def _surface_figures(sandwave: SandwaveMeasures) -> list[ReportFigure]:
    from lscan.paper.figures import contours, interactive, relief

    waves = contours.on_the_waves(sandwave)
    return [
        relief.raw_relief(sandwave.raw.xyz_mm),
        relief.levelled_relief(sandwave.raw.xyz_mm, sandwave.alignment),
        contours.contours_before(sandwave, waves),
        contours.contours_after(sandwave, waves),
        interactive.surface_to_turn(sandwave.aligned.xyz_mm, waves),
    ]


def _slice_figures(sandwave: SandwaveMeasures, bars: Bars) -> list[ReportFigure]:
    from lscan.paper.figures.slices import slice_plot

    return [
        slice_plot(name, cut, sandwave.errors[name], _SLICE_FIGURES.get(name, ""), bars.sandwave_mm)
        for name, cut in sandwave.slices.items()
    ]


def _unbroken(text: str) -> str:
    """The text with each number tied to its unit, so that no line breaks between them."""
    return re.sub(r"(?<=\d) (?=(?:mm|px|DN|s|%)(?!\w))", "\u00a0", text)


def _plotly() -> str:
    from plotly.offline import get_plotlyjs

    return str(get_plotlyjs())
