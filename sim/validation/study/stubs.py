"""A problem that stands in for a rig, to judge what evaluates the rows of a study."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

import sim
from lscan.errors import LscanError, MeasurementError
from lscan.records import Floats
from sim.studies.problem import Output
from sim.studies.run.executor import run_rows
from sim.studies.run.store import Results, identity_of, open_store

CAUSES = ("first", "second", "third")


@dataclass(frozen=True)
class StubSource:
    """What a stub is made from.

    Attributes
    ----------
    row_s : float, s, that a row takes, asleep
    failing : float, share of the rows, those with the smallest first numbers, that fail: every
        other one as a rig does, the rest as a program does
    killing : float, a row whose first number is this or larger kills its process
    log : str, a file to which each process that makes it, and each row evaluated, adds a line; ""
        for none
    name : str, another one is another study
    """

    row_s: float = 0.0
    failing: float = 0.0
    killing: float = 1.0
    log: str = ""
    name: str = "stub"

    @property
    def document(self) -> Mapping[str, Any]:
        """What the results depend on."""
        return {"name": self.name, "failing": self.failing}

    def make(self) -> "StubProblem":
        """The problem."""
        _add_line(self.log, f"made {os.getpid()}")
        return StubProblem(self)


@dataclass(frozen=True)
class StubProblem:
    """Errors that are some function of three numbers: one of a scalar, four of a field."""

    source: StubSource
    causes: tuple[str, ...] = CAUSES
    outputs: tuple[Output, ...] = (Output("height", "mm"), Output("places", "mm", 4))

    def evaluate(self, row: Floats) -> Floats:
        """(5,) errors of a (3,) row."""
        numbers = np.nan_to_num(row, nan=0.5)
        _add_line(self.source.log, row.tobytes().hex())
        if self.source.row_s > 0:
            time.sleep(self.source.row_s)
        if numbers[0] < self.source.failing / 2:
            raise MeasurementError(f"no line at {numbers[0]:.6f}")
        if numbers[0] < self.source.failing:
            raise ZeroDivisionError(f"at {numbers[0]:.6f}")
        if numbers[0] >= self.source.killing:
            os.kill(os.getpid(), signal.SIGKILL)
        return np.sin(np.arange(1.0, 6.0) * numbers.sum()) + numbers[0] * numbers[1]


def _add_line(file: str, line: str) -> None:
    """Add a line in a single write, which no other process can come between."""
    if file:
        descriptor = os.open(Path(file), os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)
        try:
            os.write(descriptor, f"{line}\n".encode())
        finally:
            os.close(descriptor)


def stub_rows(count: int) -> Floats:
    """(count, 3) rows; one of them is that of no cause at all, and one stands twice."""
    rows = np.random.default_rng(70).random((count, 3))
    rows[1] = np.nan
    rows[3] = rows[2]
    return rows


def stub_study(source: StubSource, folder: Path, count: int, workers: str) -> Results:
    """The results of ``stub_rows``, begun or gone on with.

    workers: a number, "none", or the address of a scheduler.
    """
    scheduler = workers if ":" in workers else None
    number = int(workers) if workers.isdigit() else 2
    with open_store(folder, identity_of(source)) as store:
        rows = stub_rows(count)
        return run_rows(source, rows, store, "none" if workers == "none" else number, scheduler)


def started_study(
    source: StubSource, folder: Path, count: int, workers: str
) -> subprocess.Popen[str]:
    """``stub_study`` in a process of its own; an LscanError, or Ctrl-C, is its output, its code 3.

    It leads a process group of its own, so that Ctrl-C can be sent to all of it.
    """
    program = f"from {__name__} import main; main()"
    arguments = [json.dumps(asdict(source)), str(folder), str(count), workers]
    return subprocess.Popen(
        [sys.executable, "-c", program, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env={**os.environ, "PYTHONPATH": str(Path(sim.__file__).parents[1])},
    )


def main() -> None:
    """What ``started_study`` starts."""
    source, folder, count, workers = sys.argv[1:]
    try:
        stub_study(StubSource(**json.loads(source)), Path(folder), int(count), workers)
    except (LscanError, KeyboardInterrupt) as error:
        print("; ".join([str(error), *getattr(error, "__notes__", ())]))
        sys.exit(3)
