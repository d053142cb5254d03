"""Data sets: how fast pictures with all labels are made and read, and that they are the same."""

import os
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from lscan.files.datasets import MANIFEST, PictureDataset
from sim.datasets.dataset import make_dataset
from sim.datasets.datasetspec import DatasetSpec, load_dataset_spec
from tests.validation.rows import Row, row

PICTURES, QUICK_PICTURES = 100, 2
READ_AGAIN = 3


def dataset_rows(quick: bool = False) -> list[Row]:
    """Pictures a second, made on two processors and read on one; bytes that differ.

    Parameters
    ----------
    quick : bool, a few pictures alone
    """
    spec = load_dataset_spec("stripes")
    count = QUICK_PICTURES if quick else PICTURES
    with TemporaryDirectory() as folder:
        one, two = Path(folder) / "one", Path(folder) / "two"
        begin = time.perf_counter()
        make_dataset(spec, two, count, workers=2)
        made_s = time.perf_counter() - begin
        differing = _differing(spec, one, two, count)
        read_s = min(_read_s(two) for _ in range(READ_AGAIN))
    words = {"pictures": count, "workers": min(2, os.cpu_count() or 1)}
    return [
        row("dataset-made", count / made_s, **words),
        row("dataset-read", count / read_s, **words),
        row("dataset-same", differing, **words),
    ]


def _differing(spec: DatasetSpec, one: Path, two: Path, count: int) -> int:
    """Files that differ between two workers' data set and one made in this process."""
    make_dataset(spec, one, count, workers="none")
    names = {file.name for folder in (one, two) for file in folder.iterdir()}
    assert MANIFEST in names
    return sum((one / name).read_bytes() != (two / name).read_bytes() for name in names)


def _read_s(folder: Path) -> float:
    """Seconds to read and decode all pictures and their labels, opened anew."""
    begin = time.perf_counter()
    dataset = PictureDataset(folder)
    for number in range(len(dataset)):
        found = dataset[number]
        assert found.picture.ndim == 3 and found.labels.ndim == 2
    return time.perf_counter() - begin
