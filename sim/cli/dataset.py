"""``lscan-sim dataset``: labelled pictures for those who train or test with many."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from lscan.cli.console import (
    Json,
    command_line,
    keep_notes_when_stopped,
    note,
    print_json,
    progress_bar,
)
from lscan.errors import InputError
from sim.cli.arguments import OutputFolder, print_places
from sim.cli.study import MOST_WORKERS


def dataset(
    spec: Annotated[Path, typer.Argument(help="Spec (TOML), or lscan's own: stripes.")],
    output: OutputFolder = Path("out/dataset"),
    count: Annotated[int, typer.Option("--count", min=1, max=10**9, help="Pictures.")] = 100,
    workers: Annotated[
        int, typer.Option("--workers", help="Processes of this machine.", min=1, max=MOST_WORKERS)
    ] = 2,
    scheduler: Annotated[
        str | None,
        typer.Option(
            "--scheduler",
            help="A Dask cluster that sees the same folder; it trusts all who reach it.",
        ),
    ] = None,
    processes: Annotated[
        str | None, typer.Option("--processes", help='"none": all in this process, to debug.')
    ] = None,
    form: Annotated[
        str, typer.Option("--format", help="webdataset, hdf5 or folders.")
    ] = "webdataset",
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with the shards that the folder holds.")
    ] = False,
    json: Json = False,
) -> None:
    """Pictures with all labels, of scenes drawn from distributions over any key."""
    from sim.datasets.dataset import make_dataset
    from sim.datasets.datasetshards import ENDINGS
    from sim.datasets.datasetspec import load_dataset_spec

    if processes not in (None, "none"):
        raise InputError("not known", where="--processes", value=processes, allowed="none")
    forms = {known: known for known in ENDINGS}
    if form not in forms:
        raise InputError("not known", where="--format", value=form, allowed=", ".join(forms))
    how: int | Literal["none"] = "none" if processes == "none" else workers
    with keep_notes_when_stopped(), progress_bar("pictures") as progress:
        manifest = make_dataset(
            load_dataset_spec(spec), output, count, form=forms[form], workers=how,
            scheduler=scheduler, resume=resume, progress=progress, say=note,
        )  # fmt: skip
    if json:
        print_json(manifest)
        return
    print(f"{manifest['pictures']} pictures, {len(manifest['failed'])} failed")
    print(output / "README.md")


# ``lscan-sim suite make``: a suite of rendered cases from its spec.


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
