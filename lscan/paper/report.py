"""The report: one self-contained page that a reader of the paper recognises.

Every figure and table of the paper that there are data for has its counterpart on the page,
with the paper's number beside ours.  The page loads nothing from anywhere.
"""

import re
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from lscan.calibration.calibrationfile import save_calibration
from lscan.figures.page import ReportFigure
from lscan.files.disk import make_folder, write_atomically, write_json
from lscan.paper.experiment import (
    Experiment,
    Sources,
    chain_names,
    chain_versions,
    describe_chains,
    noise_words,
    note,
    simulated_parts,
)
from lscan.paper.published import MISPRINTS, Bars
from lscan.paper.tables import checks, paper_tables
from lscan.pipeline import lengths_json
from lscan.surface import save_points, save_surface


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

    from lscan.figures.page import page_template

    bars = bars or Bars()
    sources = experiment.sources
    simulated = simulated_parts(sources)
    sections = _sections(experiment, bars)
    scripts = [figure.script for part in sections.values() for figure in part if figure.script]
    tables = [
        replace(table, caption=_caption(table.caption, sources, table.parts))
        for table in paper_tables(experiment, bars)
    ]
    return page_template("lscan.paper", "report.html.j2", unbroken=_unbroken).render(
        scene=experiment.scene,
        sources=sources,
        simulated=simulated,
        noise=noise_words(simulated.values()),
        chains=describe_chains(experiment),
        names=chain_names(experiment.chain),
        versions=chain_versions(experiment),
        seconds=experiment.seconds,
        checks=checks(experiment, bars),
        checks_note=note(sources),
        tables=tables,
        sections=sections,
        misprints=MISPRINTS,
        plotly=get_plotlyjs() if scripts else "",
        scripts=scripts,
    )


def _sections(experiment: Experiment, bars: Bars) -> dict[str, list[ReportFigure]]:
    """The figures by their heading, each caption saying where the pictures come from."""
    # The drawing modules load matplotlib, which takes a second: only where something is drawn.
    from lscan.paper.page import page_figures

    return {
        heading: [
            replace(figure, caption=_caption(figure.caption, experiment.sources, parts))
            for figures, parts in groups
            for figure in figures
        ]
        for heading, groups in page_figures(experiment, bars).items()
    }


def _caption(caption: str, sources: Sources, parts: Sequence[str]) -> str:
    """The caption, saying where the pictures of these parts come from."""
    return f"{caption} {note(sources, parts)}".rstrip()


def _unbroken(text: str) -> str:
    """The text with each number tied to its unit, so that no line breaks between them."""
    return re.sub(r"(?<=\d) (?=(?:mm|px|DN|s|%)(?!\w))", "\u00a0", text)


# What an experiment leaves on disk: results.json, the report, the calibrations, the surface.


def results_json(experiment: Experiment) -> dict[str, Any]:
    """What results.json holds.

    ``pictures``: each run's camera driver, and of the tank's the noise seed.  ``chain``: what
    turned them into the lengths that follow.  ``best``: the same of the best chain, with its own
    ``chain``, ``distances``, ``diameters``, ``groove`` and ``sandwave``, or, where it could not
    be followed, the reason as ``refused``.  ``render_check`` and the true yaw: where a tank
    knows the truth.

    Parameters
    ----------
    experiment : Experiment, lengths in mm
    """
    best, truth = experiment.best, experiment.truth
    points = asdict(experiment.control_points)
    true_yaw_deg = truth.yaw_deg if truth else None
    return {
        **({} if experiment.quick is None else {"quick": experiment.quick}),
        "scene": experiment.scene,
        "versions": chain_versions(experiment),
        "seconds": {name: round(value, 2) for name, value in experiment.seconds.items()},
        "pictures": {part: source.as_json() for part, source in experiment.sources.items()},
        "control_points": {name: value for name, value in points.items() if value is not None},
        **_chain_json(experiment, true_yaw_deg),
        "best": _chain_json(best, true_yaw_deg) if best else {"refused": experiment.best_refused},
        **({"render_check": asdict(truth.render_check)} if truth else {}),
    }


def _chain_json(experiment: Experiment, true_yaw_deg: float | None) -> dict[str, Any]:
    """What one chain measured."""
    boards = experiment.board.measures
    content: dict[str, Any] = {
        "chain": asdict(experiment.chain),
        "distances": {name: lengths_json(board.distances) for name, board in boards.items()},
        "diameters": {name: lengths_json(board.diameters) for name, board in boards.items()},
    }
    if experiment.groove:
        content |= experiment.groove.as_json()
    if experiment.sandwave:
        content |= experiment.sandwave.as_json()
        if true_yaw_deg is not None:
            content["sandwave"]["yaw_deg"]["true"] = true_yaw_deg
    return content


def write_experiment(folder: Path, experiment: Experiment) -> None:
    """Write results.json, report.html, the calibrations and the surface.

    Parameters
    ----------
    folder : Path, made where it is missing; files of an earlier report in it are replaced
    experiment : Experiment, lengths in mm

    Raises
    ------
    InputError
        Where the disk refuses.
    """
    make_folder(folder)
    best = experiment.best.board.calibrations if experiment.best else {}
    for name, calibration in {**experiment.board.calibrations, **best}.items():
        save_calibration(folder / f"calibration-{name}.json", calibration)
    if experiment.sandwave:
        save_surface(folder / "sandwave.nc", experiment.sandwave.aligned)
        save_points(folder / "sandwave.ply", experiment.sandwave.aligned)
    write_json(folder / "results.json", results_json(experiment))
    write_report(folder / "report.html", experiment)
