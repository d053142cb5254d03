"""The report: one self-contained page that a reader of the paper recognises.

Every figure and table of the paper that there are data for has its counterpart on the page,
with the paper's number beside ours.  The page loads nothing from anywhere.
"""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from lscan.figures.style import ReportFigure
from lscan.files.disk import write_atomically
from lscan.paper import provenance
from lscan.paper.checks import checks
from lscan.paper.experiment import Experiment
from lscan.paper.published import MISPRINTS, Bars
from lscan.paper.tables import paper_tables


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
    experiment : Experiment, pieces that were not scanned have no part of the page
    bars : Bars, optional, the largest errors accepted; those that the paper claims by default
    """
    from plotly.offline import get_plotlyjs

    from lscan.figures.style import page_template

    bars = bars or Bars()
    sources = experiment.sources
    simulated = provenance.simulated_parts(sources)
    sections = _sections(experiment, bars)
    scripts = [figure.script for part in sections.values() for figure in part if figure.script]
    tables = [
        replace(table, caption=_noted(table.caption, sources, table.parts))
        for table in paper_tables(experiment, bars)
    ]
    return page_template("lscan.paper", "report.html.j2", unbroken=_unbroken).render(
        scene=experiment.scene,
        sources=sources,
        simulated=simulated,
        noise=provenance.noise_words(simulated.values()),
        chains=provenance.describe_chains(experiment),
        names=provenance.chain_names(experiment.chain),
        versions=provenance.chain_versions(experiment),
        seconds=experiment.seconds,
        checks=checks(experiment, bars),
        checks_note=provenance.note(sources),
        tables=tables,
        sections=sections,
        misprints=MISPRINTS,
        plotly=get_plotlyjs() if scripts else "",
        scripts=scripts,
    )


def _sections(experiment: Experiment, bars: Bars) -> dict[str, list[ReportFigure]]:
    """The figures by their heading, each caption saying where the pictures come from."""
    # The drawing modules load matplotlib, which takes a second: only where something is drawn.
    from lscan.paper.figures.page import page_figures

    return {
        heading: [
            replace(figure, caption=_noted(figure.caption, experiment.sources, parts))
            for figures, parts in groups
            for figure in figures
        ]
        for heading, groups in page_figures(experiment, bars).items()
    }


def _noted(caption: str, sources: provenance.Sources, parts: Sequence[str]) -> str:
    """The caption, saying where the pictures of these parts come from."""
    return f"{caption} {provenance.note(sources, parts)}".rstrip()


def _unbroken(text: str) -> str:
    """The text with each number tied to its unit, so that no line breaks between them."""
    return re.sub(r"(?<=\d) (?=(?:mm|px|DN|s|%)(?!\w))", "\u00a0", text)
