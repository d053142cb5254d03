"""Rows of a study evaluated: in this process, on a cluster of its own, or on any other.

Which worker evaluates a row, in which batch and how often it is tried, changes no result.  A
batch is synced to the store as soon as it arrives, so that what ends the study costs no more than
the batches that were under way.
"""

import logging
import multiprocessing
import secrets
import signal
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from pkgutil import resolve_name
from typing import Literal, TypeVar

import dask
import numpy as np
from distributed import Client, Future, KilledWorker, LocalCluster, WorkerPlugin, as_completed
from distributed.comm import CommClosedError

from lscan.acquisition.scan import cores, require_guarded_main
from lscan.config.documents import named_files
from lscan.devices.signals import on_stop_signals
from lscan.errors import InputError, LscanError
from lscan.files.disk import disk_errors
from lscan.records import Floats, Progress
from lscan.version import __version__
from sim.render.backend import THREADS
from sim.studies.run.store import (
    Batch,
    InCommon,
    ProblemSource,
    Results,
    ResultStore,
    call_in_common,
    distinct,
    evaluate_rows,
    package_versions,
    problem_of,
)

# How many rows a worker is given at a time.


TARGET_S = 0.7  # of a batch: a hundred times what handing it out costs, and little to lose
GROWTH = 4  # at most, from one batch to the next: the first rows may be unlike the others


class Batches:
    """Rows in batches that take about ``TARGET_S`` each, as those before them tell.

    Parameters
    ----------
    rows : (N, D) array
    """

    def __init__(self, rows: Floats) -> None:
        self._rows, self._next, self._size = rows, 0, 1

    def __iter__(self) -> Iterator[Floats]:
        """Each next batch, of the size that is right when it is asked for."""
        while self._next < len(self._rows):
            begin, self._next = self._next, self._next + self._size
            yield self._rows[begin : self._next]

    def learn(self, count: int, seconds: float) -> None:
        """Take into account what rows took.

        Parameters
        ----------
        count : int, of rows
        seconds : float, s
        """
        right = TARGET_S * count / max(seconds, 1e-9)
        self._size = int(np.clip(right, 1, GROWTH * count))


# Rows of a study evaluated: in this process, on a cluster of its own, or on any other.


TRIED = 4  # rows that a cost estimate is made from

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class CostEstimate:
    """What is left to do of a study.

    Attributes
    ----------
    rows : int, that have no result yet
    row_s : float, s, that one takes: the median of those tried; NaN where none was left to try
    seconds : float, s, of the whole: each worker makes the problem first
    """

    rows: int
    row_s: float
    seconds: float


def run_rows(
    source: ProblemSource,
    rows: Floats,
    store: ResultStore,
    workers: "int | Literal['none'] | Client" = 2,
    scheduler: str | None = None,
    progress: Progress | None = None,
    at_most: int | None = None,
) -> Results:
    """The results of rows; those that the store has not are evaluated and kept there.

    Parameters
    ----------
    source : ProblemSource
    rows : (N, D) array, of a design
    store : ResultStore, of the source's identity
    workers : int, processes of this machine; "none": rows are evaluated in this process; or a
        client as ``open_client`` gives it, of a cluster that is already there
    scheduler : str or None, address of the scheduler of another cluster
    progress : Progress or None, called with (done, all) distinct rows
    at_most : int or None, the most distinct rows that the design may have

    Raises
    ------
    InputError
        The design has more rows, the disk refuses, or no scheduler answers.
    LscanError
        The scheduler is gone, or a worker cannot make the problem.
    """
    require_at_most(rows, at_most)
    missing, every = store.missing(rows), len(distinct(rows))
    done = every - len(missing)
    logged: set[str] = set()
    stream = _evaluated(source, missing, store, workers, scheduler)
    stops: list[bool] = []

    def stop() -> None:
        stops.append(True)
        raise KeyboardInterrupt

    with closing(stream), on_stop_signals(stop):
        for batches in stream:
            _log_faults(batches, logged)
            store.append(batches)
            done += sum(len(batch.rows) for batch in batches)
            if progress is not None:
                progress(done, every)
            if stops:  # raised in a destructor, of which Python tells nobody
                raise KeyboardInterrupt
    return store.results(rows)


def require_at_most(rows: Floats, at_most: int | None, more: int = 0) -> None:
    """Refuse a design that is larger than was agreed to.

    Parameters
    ----------
    rows : (N, D) array
    at_most : int or None, distinct rows
    more : int, rows that others will be, at most

    Raises
    ------
    InputError
        It has more.
    """
    count = len(distinct(rows)) + more
    if at_most is not None and count > at_most:
        raise InputError("too many runs", where="--at-most", value=count, allowed=f"{at_most}")


def cost_estimate(
    source: ProblemSource, rows: Floats, store: ResultStore, workers: int = 1
) -> CostEstimate:
    """How long rows will take, from a few that are evaluated in this process, and kept.

    Parameters
    ----------
    source : ProblemSource
    rows : (N, D) array, of a design
    store : ResultStore, of the source's identity
    workers : int, how many will work at once
    """
    missing, sha256 = store.missing(rows), store.identity.sha256
    if len(missing) == 0:
        return CostEstimate(0, np.nan, 0.0)
    began_s = time.perf_counter()
    problem_of(source, sha256)
    make_s = time.perf_counter() - began_s
    # Spread over the design, whose first row may be the one without any cause; and one more
    # beforehand, which may compile.
    places = np.unique(np.linspace(0, len(missing) - 1, TRIED + 1).astype(int))
    tried = [evaluate_rows(source, sha256, missing[[n]]) for n in places]
    store.append(tried)
    row_s = float(np.median([batch.seconds for batch in tried[1:] or tried]))
    left = len(missing) - len(tried)
    return CostEstimate(left, row_s, make_s + left * row_s / workers)


def _evaluated(
    source: ProblemSource,
    rows: Floats,
    store: ResultStore,
    workers: "int | Literal['none'] | Client",
    scheduler: str | None,
) -> Generator[list[Batch], None, None]:
    """Batches as they are finished, wherever they are."""
    sha256 = store.identity.sha256
    if len(rows) == 0:
        return
    if workers == "none":
        batches = Batches(rows)
        for batch in batches:
            finished = evaluate_rows(source, sha256, batch)
            batches.learn(len(batch), finished.seconds)
            yield [finished]
        return

    if isinstance(workers, int):
        with open_client(workers, scheduler) as client:
            yield from on_client(client, source, sha256, rows)
    else:
        yield from on_client(workers, source, sha256, rows)


def _log_faults(batches: list[Batch], logged: set[str]) -> None:
    """Log each kind of fault of the program once, with its traceback."""
    for batch in batches:
        for status, trace in batch.traces.items():
            kind = " ".join(status.split()[:2])
            if kind not in logged:
                _log.error("a row of the study failed: %s\n%s", status, trace)
                logged.add(kind)


# Batches of rows on Dask's workers: processes of this machine, or those of any scheduler.
#
# Whoever reaches a scheduler can have any code run by its workers.  Those of this machine that a
# study starts talk by TLS alone, with keys made for it that no other process has; another cluster
# is its owner's to guard.


KILLED = "killed its worker"
ATTEMPTS = 3  # that a worker's death ends, before a batch or a row is given up
AHEAD = 2  # batches a worker: the one it works on, and the next
CONNECT_S = 20.0
CLOSE_S = 10.0
MARKER = ".seen-by-workers-"
RECOUNT_S = 2.0  # between counts of a cluster's workers, each of which costs a few ms

_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
# Dr.Jit's threads wait for work at full speed: as many workers as cores need them themselves.
_ONE_EACH = _ONE_THREAD | {THREADS: "1"}
_LOCAL: dict[str, object] = {
    "distributed.scheduler.allowed-failures": ATTEMPTS - 1,
    # A machine that sleeps, or compiled code that keeps Python's lock, is no dead worker.
    "distributed.scheduler.worker-ttl": None,
    # One that is dead so long after another death is started again all the same, not given up.
    "distributed.deploy.lost-worker-timeout": "1000 days",
    "distributed.worker.profile.enabled": False,
    # Pages that tell anybody on this machine what is being computed.
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
    # Dask has glibc give memory back at once: asking for a picture's arrays anew, page by page,
    # takes a third of the time to render it.  A worker's one working thread uses the main heap.
    "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": 2**29,
    "distributed.nanny.pre-spawn-environ.MALLOC_MMAP_THRESHOLD_": 2**25,  # as much as glibc takes
    "distributed.nanny.pre-spawn-environ.MALLOC_ARENA_MAX": 1,
}


Item = TypeVar("Item")
Found = TypeVar("Found")
Other = TypeVar("Other")


class DeafToCtrlC(WorkerPlugin):
    """Leaves Ctrl-C, which a terminal sends to all processes, to the one that ends the others."""

    def setup(self, worker: object) -> None:
        """Called in the main thread of each worker, also of one that is started again."""
        signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextmanager
def open_client(workers: int = 2, scheduler: str | None = None) -> Iterator[Client]:
    """A client of a cluster of this machine, which ends with the block, or of another cluster.

    Parameters
    ----------
    workers : int, processes of this machine, each with one thread
    scheduler : str or None, address of a scheduler, such as "tcp://cluster:8786"; it and its
        workers can have any code run here and there, and so can whoever else reaches them

    Raises
    ------
    InputError
        No scheduler answers at the address, it has no workers, or one has another lscan.
    """
    if scheduler is None:
        with _local_client(workers) as client:
            yield client
        return
    try:
        client = Client(scheduler, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError("no scheduler answers", where="--scheduler", value=scheduler) from error
    try:
        try:
            client.wait_for_workers(1, timeout=CONNECT_S)
        except TimeoutError as error:
            raise InputError("has no workers", where=f"--scheduler {scheduler}") from error
        _require_versions(client)
        yield client
    finally:
        with suppress(TimeoutError, OSError):
            client.close(timeout=CLOSE_S)


@contextmanager
def _local_client(workers: int) -> Iterator[Client]:
    """A client of processes of this machine, none of which is left behind."""
    require_guarded_main()
    before = set(multiprocessing.active_children())
    try:
        with dask.config.set(_LOCAL):
            cluster = LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                processes=True,
                host="127.0.0.1",
                security=True,
                # None would be port 8787, which another study may have.
                dashboard_address="127.0.0.1:0",
                memory_limit=0,  # nothing for Dask to watch: workers keep no results
                silence_logs=logging.CRITICAL,  # the rows' statuses tell what became of them
                env=_ONE_EACH if workers >= cores() else _ONE_THREAD,
            )
            client = Client(cluster, set_as_default=False)
            try:
                client.register_plugin(DeafToCtrlC())
                yield client
            finally:
                for closed in (client, cluster):
                    with suppress(TimeoutError, OSError):
                        closed.close(timeout=CLOSE_S)
    finally:
        # Where a worker died while it was to end, closing may have waited for it in vain.
        for child in set(multiprocessing.active_children()) - before:
            child.kill()
            child.join()


def on_client(
    client: Client, source: ProblemSource, sha256: str, rows: Floats
) -> Iterator[list[Batch]]:
    """The batches of rows as workers finish them, those together that wait.

    A batch whose workers died time and again is taken apart once all others are done: each of its
    rows is tried alone, with nothing beside it that could be to blame.

    Parameters
    ----------
    client : Client
    source : ProblemSource
    sha256 : str, of its identity
    rows : (N, D) array, canonical and distinct

    Raises
    ------
    LscanError
        The scheduler is gone, or a worker cannot make the problem.
    InputError
        A worker has other versions of packages, or other files, than this process.
    """
    batches = Batches(rows)
    suspects: list[Floats] = []
    common = _in_common(named_files(dict(source.document)))
    submit = partial(client.submit, call_in_common, common, evaluate_rows, source, sha256)
    for finished in _in_flight(client, submit, batches, suspects):
        for batch in finished:
            batches.learn(len(batch.rows), batch.seconds)
        yield finished
    alone = [row for batch in suspects for row in batch[:, None]]
    if alone:
        _log.warning("workers were killed: %d rows are evaluated one by one", len(alone))
    for row in alone:
        killers: list[Floats] = []
        yield from _in_flight(client, submit, [row], killers)
        if killers:
            yield [Batch(row, Results(np.full((1, 0), np.nan), (KILLED,)), 0.0)]


def _in_flight(
    client: Client,
    submit_rows: Callable[..., Future],
    batches: Iterable[Floats],
    killers: list[Floats],
) -> Iterator[list[Batch]]:
    """Batches as they are finished, a few a worker under way; those that kill it are put aside."""
    waiting = iter(batches)
    under_way: dict[Future, Floats] = {}
    done = as_completed([], loop=client.loop)

    most, asked_s = 0, -np.inf

    def submit() -> None:
        nonlocal most, asked_s
        if time.monotonic() - asked_s > RECOUNT_S:
            most, asked_s = AHEAD * max(len(client.nthreads()), 1), time.monotonic()
        while len(under_way) < most and (rows := next(waiting, None)) is not None:
            future = submit_rows(rows, pure=False)
            under_way[future] = rows
            done.add(future)

    with _errors_told(client):
        submit()
    for futures in done.batches():
        finished = []
        with _errors_told(client):
            for future in futures:
                rows = under_way.pop(future)
                try:
                    finished.append(future.result())
                except KilledWorker:
                    killers.append(rows)
                future.release()  # left to its end, it could swallow a Ctrl-C
            submit()
        if finished:
            yield finished


def in_order(
    client: Client,
    function: Callable[[Item], Found],
    of: Sequence[Item],
    killed: Callable[[str], Other],
    *,
    files: Mapping[str, str] | None = None,
    folder: Path | None = None,
) -> Iterator[Found | Other]:
    """What a function gives for each of a few things, in their order, as far as they are done.

    Parameters
    ----------
    client : Client
    function : callable, pure
    of : sequence
    killed : callable, what to give, by the reason, for one that killed its workers time and again
    files : mapping, optional, SHA-256 of each file that the function reads, by its path
    folder : Path, optional, that the function writes to

    Raises
    ------
    InputError
        A worker has other versions of packages, other files, or another folder of that name.
    LscanError
        The scheduler is gone, or a worker cannot call the function.
    """
    with _marked(folder) as marker, _errors_told(client):
        submit = partial(client.submit, call_in_common, _in_common(files or {}, marker), function)
        futures = [submit(one, pure=False) for one in of]
        for future in futures:
            found: Found | Other
            try:
                found = future.result()
            except KilledWorker:
                found = killed(KILLED)
            future.release()
            yield found


def _in_common(files: Mapping[str, str], marker: Path | None = None) -> InCommon:
    return InCommon(tuple(package_versions().items()), tuple(files.items()), marker)


@contextmanager
def _marked(folder: Path | None) -> Iterator[Path | None]:
    """A file in a folder, of a name that no other has, so that no other disk has it."""
    if folder is None:
        yield None
        return
    marker = folder / f"{MARKER}{secrets.token_hex(16)}"
    with disk_errors(marker):
        for left in folder.glob(f"{MARKER}*"):  # by a killed process
            left.unlink()
        marker.touch()
    try:
        yield marker
    finally:
        with suppress(OSError):
            marker.unlink()


def _require_versions(client: Client) -> None:
    """Refuse workers of another lscan, which may not know how to see to it themselves."""
    told = client.run(resolve_name, "lscan.version:__version__", on_error="return")
    for address, version in told.items():
        if version != __version__ and not isinstance(version, OSError):  # one that is gone
            where, allowed = f"the worker at {address}", f"{__version__}, as here"
            what = "has another version of lscan"
            raise InputError(what, where=where, value=str(version), allowed=allowed)


@contextmanager
def _errors_told(client: Client) -> Iterator[None]:
    """Tell in one line what ends a study."""
    try:
        yield
    except LscanError:
        raise
    except (CancelledError, CommClosedError, TimeoutError) as error:
        raise LscanError(f"the scheduler at {client.scheduler.address} is gone") from error
    except Exception as error:  # whatever it is, it was raised by no row
        _require_versions(client)
        text = " ".join(f"{type(error).__name__}: {error}".split())
        raise LscanError(f"a worker cannot evaluate any row: {text}") from error
