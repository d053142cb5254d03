"""Studies on stubs: the same bytes however they are run and killed, and what a task costs."""

import json
import logging
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import wait
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from math import ceil
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import psutil

import sim
from lscan.errors import LscanError, MeasurementError
from lscan.files.disk import read_text
from lscan.records import Floats
from sim.studies.executor import open_workers
from sim.studies.problem import Output
from sim.studies.results import Results, identity_of, open_store
from sim.studies.running import run_rows
from tests.validation.rows import Row, row

# A problem that stands in for a rig, to judge what evaluates the rows of a study.


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
    how: int | Literal["none"] = "none" if workers == "none" else 2
    if workers.isdigit():
        how = int(workers)
    with (
        open_store(folder, identity_of(source)) as store,
        open_workers(how, scheduler) as able,
    ):
        return run_rows(source, stub_rows(count), store, able)


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


# Studies on stubs: the same bytes however they are run and killed, and what a task costs.


SEED: Final = 5150
FAILING: Final = 0.05
ROWS: Final = 200
ROW_S: Final = 0.02
"""A study of stubs lasts about as long as its cluster takes to start, or a little longer."""

TASK_S: Final = 0.5  # of a task whose overhead is looked at; a batch of one row
PATIENCE_S: Final = 180.0  # longer than any study here takes on a busy machine


@dataclass(frozen=True)
class KilledStudy:
    """A study that something of was killed.

    what: "worker", "scheduler" or "study".  killed: whether it was before the study's end.
    kept: rows that the store had when the study ended for the first time.  repeated: how many of
    them were evaluated again afterwards.  same: whether its results have the right bytes.
    """

    what: str
    killed: bool
    kept: int
    repeated: int
    same: bool


@dataclass(frozen=True)
class Overhead:
    """What scheduling costs.

    task_ms: wall time beyond that of the tasks themselves, shared evenly, per task.  cpu_ms: of
    the study's own process, per task.  start_s: until all workers wait.  worker_mib: memory of a
    waiting worker that it shares with no other.
    """

    task_ms: float
    cpu_ms: float
    start_s: float
    worker_mib: float


@contextmanager
def _without_tracebacks() -> Iterator[None]:
    """Those of stubs, which fail on purpose."""
    logging.disable()
    try:
        yield
    finally:
        logging.disable(logging.NOTSET)


def running_rows(kills: int, tasks: int) -> list[Row]:
    """The rows.  kills: how many.  tasks: over which the overhead is taken."""
    return [*same_rows(), *overhead_rows(tasks), *kill_rows(kills)]


@_without_tracebacks()
def same_rows() -> list[Row]:
    """How many studies differ from the one in a single process, 5 % of whose rows fail."""
    source = StubSource(failing=FAILING)
    differing = 0
    with tempfile.TemporaryDirectory(prefix="lscan-study-") as name:
        expected = result_bytes(stub_study(source, Path(name) / "none", ROWS, "none"))
        for workers in ("1", "2"):
            got = stub_study(source, Path(name) / workers, ROWS, workers)
            differing += result_bytes(got) != expected
    return [row("study-workers-differing", differing, seed=SEED)]


def overhead_rows(tasks: int, workers: int = 16) -> list[Row]:
    """What scheduling costs a task with that many workers."""
    found = overhead(workers, tasks)
    words: dict[str, Any] = {"workers": workers, "tasks": tasks, "task_s": TASK_S}
    return [
        row("study-overhead", found.task_ms, **words, cpu_ms=found.cpu_ms),
        row("study-start", found.start_s, **words, worker_mib=found.worker_mib),
    ]


def overhead(workers: int, tasks: int, task_s: float = TASK_S) -> Overhead:
    """What scheduling costs with workers that sleep ``task_s`` for each task."""
    source = StubSource(row_s=task_s)
    rows = np.random.default_rng(SEED).random((tasks + 2 * workers, 3))
    began_s = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="lscan-study-") as name, open_workers(workers) as able:
        wait([able.submit(time.sleep, 1.0) for _ in range(workers)])
        start_s = time.perf_counter() - began_s - 1.0
        with open_store(Path(name), identity_of(source)) as store:
            run_rows(source, rows[tasks:], store, able)  # each worker has made the problem
            children = psutil.Process().children(recursive=True)
            memory = [child.memory_full_info().uss / 2**20 for child in children]
            began_s, began_cpu_s = time.perf_counter(), time.process_time()
            run_rows(source, rows[:tasks], store, able)
            cpu_s = time.process_time() - began_cpu_s
            wall_s = time.perf_counter() - began_s
    beyond_s = wall_s - task_s * ceil(tasks / workers)
    largest = sorted(memory)[-workers:]  # the others are helpers of multiprocessing
    return Overhead(1000 * beyond_s / tasks, 1000 * cpu_s / tasks, start_s, float(np.mean(largest)))


@_without_tracebacks()
def kill_rows(count: int, seed: int = SEED) -> list[Row]:
    """Kills of worker, scheduler and study in turn: what differs, and what was done again."""
    studies = killed_studies(count, seed)
    kills = sum(study.killed for study in studies)
    differing = sum(not study.same for study in studies)
    repeated = sum(study.repeated for study in studies)
    return [
        row("study-kills", kills, bar=count, seed=seed),
        row("study-kills-differing", differing, seed=seed),
        row("study-kills-repeated", repeated, seed=seed),
    ]


def killed_studies(count: int, seed: int = SEED) -> list[KilledStudy]:
    """Studies with 5 % of rows that fail, in ``count`` of which something was killed.

    The moments are uniform over the duration of a study, start-up included; one that had ended
    by then is done again with another moment.
    """
    generator = np.random.default_rng(seed)
    source = StubSource(row_s=ROW_S, failing=FAILING)
    studies: list[KilledStudy] = []
    with tempfile.TemporaryDirectory(prefix="lscan-study-") as name:
        expected = result_bytes(stub_study(source, Path(name) / "whole", ROWS, "none"))
        began_s = time.perf_counter()
        _ended(started_study(source, Path(name) / "timed", ROWS, "2"))
        whole_s = time.perf_counter() - began_s
        while sum(study.killed for study in studies) < count:
            what = ("study", "worker", "scheduler")[len(studies) % 3]
            folder = Path(name) / f"{len(studies):03d}"
            after_s = float(generator.uniform(0, whole_s))
            studies.append(killed_study(source, folder, what, after_s, expected))
    return studies


def killed_study(
    source: StubSource, folder: Path, what: str, after_s: float, expected: bytes
) -> KilledStudy:
    """A study that ``what`` is killed of after some time, gone on with until its end.

    expected: what ``result_bytes`` gives for its results.
    """
    folder.mkdir(parents=True)
    source = replace(source, log=str(folder / "log"))
    if what == "scheduler":
        with served_scheduler() as (address, scheduler):
            killed = _disturbed(source, folder, address, what, after_s, scheduler.pid)
    else:
        killed = _disturbed(source, folder, "2", what, after_s)
    rows = stub_rows(ROWS)
    with open_store(folder / "store", identity_of(source)) as store:
        missing = {one.tobytes() for one in store.missing(rows)}
        kept = len(store)
    before = len(evaluated(source))
    results = stub_study(source, folder / "store", ROWS, "none")
    repeated = [one for one in evaluated(source)[before:] if one not in missing]
    return KilledStudy(what, killed, kept, len(repeated), result_bytes(results) == expected)


def evaluated(source: StubSource) -> list[bytes]:
    """The rows that a stub has evaluated so far, as bytes, as often as it did."""
    file = Path(source.log)
    lines = file.read_text().splitlines() if file.exists() else []
    return [bytes.fromhex(line) for line in lines if not line.startswith("made")]


def result_bytes(results: Results) -> bytes:
    """All that results hold, as bytes."""
    values: Floats = results.values
    return values.tobytes() + "\n".join(results.status).encode()


@contextmanager
def served_scheduler() -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """Address and process of a scheduler with one worker, each a process of its own."""
    with tempfile.TemporaryDirectory(prefix="lscan-scheduler-") as name:
        file = Path(name) / "scheduler.json"
        common = ["--scheduler-file", str(file), "--no-dashboard", "--host", "127.0.0.1"]
        home = ["--local-directory", name, "--nthreads", "1", "--no-nanny", "--death-timeout", "60"]
        with (
            _dask("scheduler", *common, "--port", "0") as scheduler,
            _dask("worker", *common, *home),
        ):
            deadline_s = time.monotonic() + PATIENCE_S
            while not file.exists() and time.monotonic() < deadline_s:
                time.sleep(0.05)
            yield _address(file), scheduler


def _address(file: Path) -> str:
    """Where the scheduler of a scheduler file is."""
    return str(json.loads(read_text(file))["address"])


@contextmanager
def _dask(kind: str, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    """A process of Dask's command line, killed at the end."""
    command = [sys.executable, "-m", f"distributed.cli.dask_{kind}", *arguments]
    quiet = subprocess.DEVNULL
    with subprocess.Popen(command, stdout=quiet, stderr=quiet, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def _disturbed(
    source: StubSource,
    folder: Path,
    workers: str,
    what: str,
    after_s: float,
    scheduler: int | None = None,
) -> bool:
    """Run a study until something of it is killed, and on to its own end; whether it was."""
    study = started_study(source, folder / "store", ROWS, workers)
    with suppress(subprocess.TimeoutExpired):
        _ended(study, after_s)
        return False
    victim = {"study": study.pid, "scheduler": scheduler, "worker": None}[what]
    while victim is None and study.poll() is None:
        victim = next(iter(_makers(source) - {study.pid}), None)
        time.sleep(0.01)
    killed = study.poll() is None and victim is not None
    if victim is not None:
        with suppress(ProcessLookupError):
            os.kill(victim, signal.SIGKILL)
    _ended(study)
    return killed


def _makers(source: StubSource) -> set[int]:
    """Ids of the processes that have made the stub."""
    file = Path(source.log)
    lines = file.read_text().splitlines() if file.exists() else []
    return {int(line.split()[1]) for line in lines if line.startswith("made")}


def _ended(study: subprocess.Popen[str], within_s: float = PATIENCE_S) -> None:
    """Wait for the end of a study that came to it, was killed, or said in one line why not."""
    said, wrong = study.communicate(timeout=within_s)
    if study.returncode not in (0, 3, -signal.SIGKILL):
        raise RuntimeError(f"a study ended with code {study.returncode}: {said}{wrong}")
