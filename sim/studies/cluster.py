"""Batches of rows on Dask's workers: processes of this machine, or those of any scheduler."""

import logging
import multiprocessing
import signal
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from typing import TypeVar

import dask
import numpy as np
from distributed import Client, Future, KilledWorker, LocalCluster, WorkerPlugin, as_completed
from distributed.comm import CommClosedError

from lscan.acquisition.inorder import cores, require_guarded_main
from lscan.errors import InputError, LscanError
from lscan.records import Floats
from sim.render.backend import THREADS
from sim.studies.batches import Batches
from sim.studies.store import Batch, Results
from sim.studies.worker import ProblemSource, evaluate_rows

KILLED = "killed its worker"
ATTEMPTS = 3  # that a worker's death ends, before a batch or a row is given up
AHEAD = 2  # batches a worker: the one it works on, and the next
CONNECT_S = 20.0
CLOSE_S = 10.0
RECOUNT_S = 2.0  # between counts of a cluster's workers, each of which costs a few ms

_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
# Dr.Jit's threads wait for work at full speed: as many workers as cores need them themselves.
_ONE_EACH = _ONE_THREAD | {THREADS: "1"}
_LOCAL = {
    "distributed.scheduler.allowed-failures": ATTEMPTS - 1,
    # A machine that sleeps, or compiled code that keeps Python's lock, is no dead worker.
    "distributed.scheduler.worker-ttl": None,
    # One that is dead so long after another death is started again all the same, not given up.
    "distributed.deploy.lost-worker-timeout": "1000 days",
    "distributed.worker.profile.enabled": False,
    # Dask has glibc give memory back at once: asking for a picture's arrays anew, page by page,
    # takes a third of the time to render it.  A worker's one working thread uses the main heap.
    "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": 2**29,
    "distributed.nanny.pre-spawn-environ.MALLOC_MMAP_THRESHOLD_": 2**25,  # as much as glibc takes
    "distributed.nanny.pre-spawn-environ.MALLOC_ARENA_MAX": 1,
}

_log = logging.getLogger(__name__)

Item = TypeVar("Item")
Found = TypeVar("Found")


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
    scheduler : str or None, address of a scheduler, such as "tcp://cluster:8786", whose workers
        have this version of lscan

    Raises
    ------
    InputError
        No scheduler answers at the address, or it has no workers.
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
    """
    batches = Batches(rows)
    suspects: list[Floats] = []
    for finished in _in_flight(client, source, sha256, batches, suspects):
        for batch in finished:
            batches.learn(len(batch.rows), batch.seconds)
        yield finished
    alone = [row for batch in suspects for row in batch[:, None]]
    if alone:
        _log.warning("workers were killed: %d rows are evaluated one by one", len(alone))
    for row in alone:
        killers: list[Floats] = []
        yield from _in_flight(client, source, sha256, [row], killers)
        if killers:
            yield [Batch(row, Results(np.full((1, 0), np.nan), (KILLED,)), 0.0)]


def _in_flight(
    client: Client,
    source: ProblemSource,
    sha256: str,
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
            future = client.submit(evaluate_rows, source, sha256, rows, pure=False)
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
    killed: Callable[[str], Found],
) -> Iterator[Found]:
    """What a function gives for each of a few things, in their order, as far as they are done.

    Parameters
    ----------
    client : Client
    function : callable, pure
    of : sequence
    killed : callable, what to give, by the reason, for one that killed its workers time and again
    """
    with _errors_told(client):
        futures = [client.submit(function, one, pure=False) for one in of]
        for future in futures:
            try:
                found = future.result()
            except KilledWorker:
                found = killed(KILLED)
            future.release()
            yield found


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
        text = " ".join(f"{type(error).__name__}: {error}".split())
        raise LscanError(f"a worker cannot evaluate any row: {text}") from error
