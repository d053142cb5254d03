"""``lscan-sim dataset``: labelled pictures for those who train or test with many."""

from pathlib import Path

from typer import Argument, Option

from lscan.cli.console import Json, keep_notes_when_stopped, note, one_of, progress_bar, show
from sim.cli.app import MOST_WORKERS, OutputFolder, show_places, worker_processes
from sim.datasets.dataset import ENDINGS, make_dataset
from sim.datasets.datasetspec import load_dataset_spec


def dataset(
    spec: Path = Argument(help="Spec (TOML), or lscan's own: stripes."),
    output: OutputFolder = Path("out/dataset"),
    count: int = Option(100, min=1, max=10**9, help="Number of pictures."),
    workers: int = Option(2, help="Number of processes on this machine.", min=1, max=MOST_WORKERS),
    scheduler: str | None = Option(
        None,
        help="Address of a Dask cluster that sees the same folder; it trusts all who reach it.",
    ),
    processes: str | None = Option(None, help='"none" runs all in this process, to debug.'),
    form: str = Option("webdataset", "--format", help="Format: webdataset, hdf5 or folders."),
    resume: bool = Option(False, "--resume", help="Resume with the shards that the folder holds."),
    json: Json = False,
) -> None:
    """Render labelled pictures of scenes drawn from distributions over any key."""
    how, shards = worker_processes(workers, processes), one_of(form, ENDINGS, "--format")
    with keep_notes_when_stopped(), progress_bar("pictures") as progress:
        manifest = make_dataset(
            load_dataset_spec(spec), output, count, form=shards, workers=how,
            scheduler=scheduler, resume=resume, progress=progress, say=note,
        )  # fmt: skip
    words = f"{manifest['pictures']} pictures, {len(manifest['failed'])} failed"
    show(manifest, words, str(output / "README.md"), json=json)


def make_suite(
    spec: Path = Argument(help="Spec file (TOML), or one of lscan's: chains, full, quick."),
    output: Path | None = Option(
        None,
        "--output",
        "-o",
        help="Archive to write; by default that of the user's cache is replaced.",
    ),
    seed: int | None = Option(None, min=0, help="Seed to use in place of the spec's own."),
    workers: int = Option(2, help="Number of processes on this machine."),
    json: Json = False,
) -> None:
    """Render a suite, or resume one that was interrupted; lscan bench --suite judges by it."""
    from sim.datasets import suite  # loads Mitsuba

    worker_processes(workers)
    loaded = suite.load_suite_spec(spec, seed)
    own = "" if loaded.seed == loaded.file.seed else f"-seed-{loaded.seed}"
    with progress_bar("cases") as progress:
        if output is None:
            name = f"{loaded.file.name}{own}"
            made = suite.make_cached_suite(loaded, name, workers=workers, progress=progress)
        else:
            made = suite.make_suite(loaded, output, workers=workers, progress=progress)
    show_places({"suite": made}, json)
