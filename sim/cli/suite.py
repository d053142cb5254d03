"""``lscan-sim suite make``: a suite of rendered cases from its spec."""

from pathlib import Path
from typing import Annotated

import typer

from lscan.cli.console import Json, command_line, progress_bar
from lscan.errors import InputError
from sim.cli.arguments import print_places
from sim.cli.study import MOST_WORKERS

suite = command_line("Suites of rendered pictures with their truth: make.")


@suite.callback()
def _group() -> None:
    """Suites of rendered pictures with their truth."""


@suite.command("make")
def make(
    spec: Annotated[
        Path, typer.Argument(help="Spec file (TOML), or one of lscan's: chains, full, quick.")
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            help="Archive; if not, the one of the user's cache is replaced.",
        ),
    ] = None,
    seed: Annotated[
        int | None, typer.Option("--seed", min=0, help="In place of the spec's own.")
    ] = None,
    workers: Annotated[int, typer.Option("--workers", help="Processes of this machine.")] = 2,
    json: Json = False,
) -> None:
    """Render a suite, or go on where it was ended; lscan bench --suite judges by it."""
    from sim.datasets.suite import load_suite_spec, make_cached_suite, make_suite

    if not 1 <= workers <= MOST_WORKERS:
        allowed = f"1 to {MOST_WORKERS}"
        raise InputError("out of range", where="--workers", value=workers, allowed=allowed)
    loaded = load_suite_spec(spec, seed)
    own = "" if loaded.seed == loaded.file.seed else f"-seed-{loaded.seed}"
    with progress_bar("cases") as progress:
        if output is None:
            name = f"{loaded.file.name}{own}"
            made = make_cached_suite(loaded, name, workers=workers, progress=progress)
        else:
            made = make_suite(loaded, output, workers=workers, progress=progress)
    print_places({"suite": made}, json)
