"""What a budget of twelve causes in rendered physics costs, and how well its indices are known."""

import time
from pathlib import Path
from typing import Final

from lscan.config.documents import Document, write_toml
from lscan.errors import MeasurementError
from sim.studies.run.running import StudyOptions
from sim.studies.study import run_study
from sim.validation.rows import Row, row
from sim.validation.study.twelve import CAUSES

RENDERED = 256
LARGEST = 3
STUDY: Final[Document] = {
    "name": "twelve causes in rendered physics",
    "calibrate": "best/board",
    "scan": "best/sandwave",
    "tier": "both",
    "places": {"pictures": 8, "columns": 24},  # the sandwave, reduced: a line in eight pictures
    "precision": {
        "base": 1024, "most": 1024, "rendered": RENDERED, "half_width": 0.05, "alone": 16,
    },
    "cause": CAUSES,
}  # fmt: skip


def rendered_rows(folder: Path, options: StudyOptions | None = None) -> list[Row]:
    """Minutes of the study, and half the 95 % intervals of the three largest indices.

    Parameters
    ----------
    folder : Path, of the study's runs
    options : StudyOptions, optional

    Raises
    ------
    MeasurementError
        The study has no indices of rendered rigs.
    """
    file = folder.with_suffix(".toml")
    write_toml(file, STUDY)
    began_s = time.perf_counter()
    results = run_study(file, folder, options)
    minutes = (time.perf_counter() - began_s) / 60
    (height,) = (output for output in results.outputs if output.name == "height")
    found = [row("study-rendered", minutes, seed=results.seed, most=RENDERED, causes=len(CAUSES))]
    for kind in ("total", "first-order"):
        indices = {c.cause: c.total if kind == "total" else c.first for c in height.causes}
        known = {cause: index for cause, index in indices.items() if index is not None}
        if len(known) < LARGEST:
            raise MeasurementError("the study has no indices of rendered rigs")
        for cause in sorted(known, key=lambda cause: -known[cause].value)[:LARGEST]:
            index = known[cause]
            words = {"low": index.low, "high": index.high, "value": index.value}
            name = "study-rendered-index"
            found.append(
                row(name, index.half_width, seed=results.seed, cause=cause, kind=kind, **words)
            )
    return found
