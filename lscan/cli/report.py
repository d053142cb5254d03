"""The command ``lscan report``: a thin face over lscan.paper."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lscan.cli.arguments import Json, Trust
from lscan.cli.console import print_json, print_table, progress_bar

if TYPE_CHECKING:
    from lscan.paper.experiment import Experiment
    from lscan.paper.tables import TableBlock

_LEFT_OUT = ("\nmm", "\n%")  # columns of the page that a terminal has no room for


def report(
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for report.html and results.json.")
    ],
    board: Annotated[Path, typer.Option(help="Run folder of the board picture.")],
    groove: Annotated[Path | None, typer.Option(help="Run folder of the grooved block.")] = None,
    sandwave: Annotated[Path | None, typer.Option(help="Run folder of the sandwave.")] = None,
    trust: Trust = False,
    json: Json = False,
) -> None:
    """Evaluate the paper's experiment from its run folders and write the page."""
    from lscan.acquisition.run import open_run
    from lscan.paper.experiment import evaluate
    from lscan.paper.report import results_json, write_experiment

    with progress_bar("evaluate") as progress:
        experiment = evaluate(
            open_run(board, trust),
            open_run(groove, trust) if groove else None,
            open_run(sandwave, trust) if sandwave else None,
            progress=progress,
        )
    write_experiment(output, experiment)
    if json:
        print_json(results_json(experiment))
    else:
        print_chains(experiment)
        print(f"{output / 'report.html'}")


def print_chains(experiment: Experiment) -> None:
    """Print where a report's pictures come from, and the errors of both chains side by side.

    Parameters
    ----------
    experiment : Experiment, as the report shows it
    """
    from lscan.paper.experiment import chain_names, describe_chains, note
    from lscan.paper.published import Bars
    from lscan.paper.tables import paper_tables

    for line in filter(None, (note(experiment.sources), describe_chains(experiment))):
        print(line)
    names = [name.removeprefix("Ours, ") for name in chain_names(experiment.chain)]
    for table in paper_tables(experiment, Bars()):
        if table.chains is not None:
            _print_block(f"{table.title}, mm", table.chains, names)


def _print_block(title: str, block: TableBlock, names: Sequence[str]) -> None:
    """The columns of errors and their sigmas: all of them are too many for a terminal."""
    groups = [("paper", block.paper_heads)]
    groups += [(name, block.our_heads) for name in (names if block.has_best else names[:1])]
    columns = [f"{name}\n{head}" for name, heads in groups for head in heads]
    kept = [k for k, column in enumerate(columns) if not column.endswith(_LEFT_OUT)]
    rows = []
    for row in block.rows:
        cells = [cell.text for cell in row.paper + row.ours + row.best]
        rows.append([row.label, *(cells[k] for k in kept)])
    print_table(title, [block.names, *(columns[k] for k in kept)], rows)
