"""Rows of a study evaluated: in this process, on a cluster of its own, or on any other.

Which worker evaluates a row, in which batch and how often it is tried, changes no result.  A
batch is synced to the store as soon as it arrives, so that what ends the study costs no more than
the batches that were under way.
"""

import logging
import time
from collections.abc import Generator
from contextlib import closing
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from lscan.devices.signals import on_stop_signals
from lscan.errors import InputError
from lscan.records import Floats, Progress
from sim.studies.batches import Batches
from sim.studies.store import Batch, Results, ResultStore, distinct
from sim.studies.worker import ProblemSource, evaluate_rows, problem_of

if TYPE_CHECKING:
    from distributed import Client

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
    from sim.studies.cluster import on_client, open_client  # takes a second to import

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
