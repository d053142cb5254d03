"""``lscan-sim dataset``: labelled pictures for those who train or test with many."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from lscan.cli.console import Json, keep_notes_when_stopped, note, print_json, progress_bar
from lscan.errors import InputError
from sim.cli.arguments import OutputFolder
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
            help="Another Dask cluster that sees the same folder; it trusts all who reach it.",
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
