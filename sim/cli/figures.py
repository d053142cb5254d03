"""``lscan-sim bench``, ``verify``, ``accuracy``, ``budgets`` and others: figures and bars."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lscan.cli.console import Json, print_json, print_table, progress_bar
from lscan.config.scenes import scenes_folder
from sim.cli.arguments import OutputFile, OutputFolder, PaperFolder, Quick, ScenesFolder

if TYPE_CHECKING:
    from sim.validation.rows import Row

PhotographsFolder = Annotated[
    Path | None,
    typer.Option(
        "--photographs",
        envvar="LSCAN_PHOTOGRAPHS",
        help="Folder of real pictures, whose rows are skipped without it.",
    ),
]


def bench(
    output: OutputFile = Path("out/bench.json"),
    scenes: PaperFolder = None,
    quick: Quick = False,
    json: Json = False,
) -> None:
    """Speed: against Mitsuba's volpath at equal noise, a frame, a picture, a profile."""
    from sim.validation.speed import run_bench

    _end_with_rows(
        "bench", run_bench(scenes or scenes_folder() / "paper", output, quick), [output], json
    )


def verify(
    output: OutputFolder = Path("out/verify"),
    scenes: ScenesFolder = None,
    json_file: Annotated[
        Path | None, typer.Option("--json-file", help="Write the rows to this file as well.")
    ] = None,
    full: Annotated[
        bool, typer.Option("--full", help="More random rigs and less noise: an hour.")
    ] = False,
    quick: Quick = False,
    json: Json = False,
) -> None:
    """The tank against closed forms, published values and other renderers; a page shows it."""
    from sim.validation.physics.run import run_verify
    from sim.validation.rows import write_rows

    if full and quick:
        raise typer.BadParameter("--full and --quick exclude each other")
    with progress_bar("verify") as progress:
        rows = run_verify(output, scenes or scenes_folder(), quick, progress, full)
    if json_file is not None:
        write_rows(json_file, rows)
    _end_with_rows("verify", rows, [output / "report.html", output / "verify.json"], json)


def accuracy(
    output: OutputFile = Path("out/accuracy.json"),
    scenes: ScenesFolder = None,
    photographs: PhotographsFolder = None,
    quick: Quick = False,
    json: Json = False,
) -> None:
    """How near to the truth the instrument measures, figure by figure, each with its bar."""
    from sim.validation.accuracy.run import run_accuracy

    with progress_bar("accuracy") as progress:
        rows = run_accuracy(scenes or scenes_folder(), photographs, output, quick, progress)
    _end_with_rows("accuracy", rows, [output], json, skipped=photographs is None)


def field(
    output: OutputFile = Path("out/field.json"),
    scenes: ScenesFolder = None,
    photographs: PhotographsFolder = None,
    quick: Quick = False,
    json: Json = False,
) -> None:
    """Pictures as they are in the field, other water, other surfaces: figures with their bars."""
    from sim.validation.field.run import run_field

    with progress_bar("field") as progress:
        rows = run_field(scenes or scenes_folder(), photographs, output, quick, progress)
    _end_with_rows("field", rows, [output], json, skipped=photographs is None)


def hardware(
    output: OutputFile = Path("out/hardware.json"),
    scenes: ScenesFolder = None,
    quick: Quick = False,
    json: Json = False,
) -> None:
    """Drivers, faults, resuming and the live page, on hardware that the tank emulates."""
    from sim.validation.robustness.campaign import kind_cells
    from sim.validation.robustness.run import run_hardware

    with progress_bar("hardware") as progress:
        rows, outcomes = run_hardware(scenes or scenes_folder(), output, quick, progress)
    if not json:
        headings = ["", "injected", "tolerated", "stopped the scan", "not clean"]
        print_table("faults", headings, kind_cells(outcomes))
    _end_with_rows("hardware", rows, [output], json)


def budgets(
    output: OutputFile = Path("out/study.json"),
    scenes: ScenesFolder = None,
    quick: Quick = False,
    json: Json = False,
) -> None:
    """Studies against closed forms, rendered scans and the clock: figures with their bars."""
    from sim.validation.study.run import run_budgets

    with progress_bar("budgets") as progress:
        rows = run_budgets(scenes or scenes_folder(), output, quick, progress)
    _end_with_rows("budgets", rows, [output], json)


def roughness(
    output: OutputFile = Path("out/roughness.json"),
    scenes: ScenesFolder = None,
    quick: Quick = False,
    json: Json = False,
) -> None:
    """Roughness against fields, blocks and sounds that are known: figures with their bars."""
    from sim.validation.roughness.run import run_roughness

    with progress_bar("roughness") as progress:
        rows = run_roughness(scenes or scenes_folder(), output, quick, progress)
    _end_with_rows("roughness", rows, [output], json)


def regression(
    output: OutputFile = Path("out/regression.json"), quick: Quick = False, json: Json = False
) -> None:
    """Suites, the paired test and data sets: figures with their bars."""
    from sim.validation.regression.run import run_regression

    with progress_bar("regression") as progress:
        rows = run_regression(output, quick, progress)
    _end_with_rows("regression", rows, [output], json)


def _end_with_rows(
    title: str, rows: Sequence[Row], files: Sequence[Path], json: bool, skipped: bool = False
) -> None:
    """Print the rows and where they are; exit code 1 where one is beyond its bar.

    skipped: rows of real photographs were left out.
    """
    from sim.validation.rows import HEADINGS, all_passed, table_cells

    if json:
        print_json([row.as_json() for row in rows])
    else:
        print_table(title, HEADINGS, table_cells(rows))
        if skipped:
            print("skipped: the rows of real photographs, which need --photographs FOLDER")
        if any(row.quick for row in rows):
            print("a quick run: figures marked - were measured with too little effort to be judged")
        print(*files, sep="\n")
    if not all_passed(rows):
        raise typer.Exit(1)
