"""The rows of a study run: from what, by which workers, in which batches, agreed to by whom."""

import hashlib
import logging
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from lscan.config.documents import by_content, named_files
from lscan.config.rig import parse_rig
from lscan.devices.signals import on_stop_signals
from lscan.errors import InputError
from lscan.files.disk import read_bytes, write_atomically
from lscan.records import Floats, Progress
from lscan.version import __version__
from sim.scene import Scene, scene_of
from sim.studies.executor import KILLED, THIS_PROCESS, Workers, calls_done, open_workers
from sim.studies.results import (
    Batch,
    ProblemSource,
    Results,
    ResultStore,
    distinct_rows,
    evaluate_rows,
    identity_of,
    open_store,
    problem_of,
)
from sim.studies.rig.evaluation import GeometricRig, RenderedRig
from sim.studies.rig.prepared import MOST_PREPARED_BYTES, Prepared, prepare
from sim.studies.studyfile import Study, Tier, study_of

_log = logging.getLogger(__name__)

AT_MOST = 20_000
"""Runs of a study that nobody has to agree to: ten minutes of the geometric tier."""


@dataclass(frozen=True)
class RigSource:
    """What a worker makes a study's problem from.

    Attributes
    ----------
    tier : str, "geometric" or "rendered"
    study, calibrate, scan : dict, documents: the study's own, and those of its two scenes
    prepared : bytes, as ``Prepared.packed`` gives them
    name : str, of the study's file, for errors
    """

    tier: Tier
    study: dict[str, Any]
    calibrate: dict[str, Any]
    scan: dict[str, Any]
    prepared: bytes
    name: str

    @property
    def document(self) -> Mapping[str, Any]:
        """All that the results of a row depend on."""
        return {**self.stated, "prepared": hashlib.sha256(self.prepared).hexdigest()}

    @property
    def stated(self) -> dict[str, Any]:
        """The same without what was prepared."""
        counts = ("cause", "correlation", "places")
        return {
            "tier": self.tier,
            "study": {key: self.study[key] for key in counts if key in self.study},
            "calibrate": self.calibrate,
            "scan": self.scan,
        }

    def make(self) -> GeometricRig:
        """The problem."""
        scenes = self._scene(self.calibrate), self._scene(self.scan)
        study = study_of(self.study, self.name, scenes)
        rig = RenderedRig if self.tier == "rendered" else GeometricRig
        return rig(study, Prepared.unpacked(self.prepared, study))

    def _scene(self, document: dict[str, Any]) -> Scene:
        return scene_of(parse_rig(document, source=self.name, trusted=True))


@dataclass(frozen=True)
class StudyOptions:
    """How a study is run.

    Attributes
    ----------
    workers : int, processes of this machine; "none": everything in this one
    scheduler : str or None, address of the scheduler of another cluster
    at_most : int, runs that are agreed to
    tier : str or None, in place of the file's
    resume : bool, whether a folder that holds runs of this study is gone on with
    """

    workers: int | Literal["none"] = 2
    scheduler: str | None = None
    at_most: int = AT_MOST
    tier: Tier | None = None
    resume: bool = False


@dataclass
class StudyRunning:
    """How and where the rows of a study are run."""

    study: Study
    output: Path
    options: StudyOptions
    packed: bytes
    stack: ExitStack
    progress: Progress | None
    say: Callable[[str], None]

    def source(self, tier: Tier) -> RigSource:
        """What a worker makes the problem of a tier from."""
        return RigSource(
            tier,
            self.study.document,
            self.study.calibrate.document,
            self.study.scan.document,
            self.packed,
            self.study.source,
        )

    def begin(self, tier: Tier, folder: str, rows: Floats) -> tuple[RigSource, ResultStore]:
        """The source and the store of a tier's runs; says how long these rows will take."""
        source = self.source(tier)
        store = self.stack.enter_context(open_store(self.output / folder, identity_of(source)))
        at_once = 1 if self.options.workers == "none" else self.options.workers
        cost = cost_estimate(source, rows, store, at_once)
        if cost.rows:
            left = f"{cost.rows} {tier} runs to go, {cost.row_s:.2g} s each, {at_once} at a time"
            self.say(f"{left}: about {cost.seconds:.0f} s")
        return source, store

    @cached_property
    def workers(self) -> Workers:
        """Who evaluates rows: begun once a study."""
        opened = open_workers(self.options.workers, self.options.scheduler)
        return self.stack.enter_context(opened)

    def run(
        self, source: RigSource, store: ResultStore, rows: Floats, *, agreed: bool = False
    ) -> Results:
        """The results of rows.  agreed: they were counted before."""
        at_most = None if agreed else self.options.at_most
        return run_rows(source, rows, store, self.workers, progress=self.progress, at_most=at_most)


def prepared_of(study: Study, file: Path, say: Callable[[str], None]) -> bytes:
    """What pictures show of the rig as it ought to be, kept in a file, packed.

    Parameters
    ----------
    study : Study
    file : Path, read where it holds this
    say : callable, told what is begun
    """
    scenes = by_content([study.calibrate.document, study.scan.document])
    key = hashlib.sha256(repr((__version__, scenes, study.file.places)).encode()).digest()
    if file.exists() and (kept := read_bytes(file, MOST_PREPARED_BYTES))[: len(key)] == key:
        return kept[len(key) :]
    say("looks at pictures of the rig as it ought to be: a minute or two, once")
    packed = prepare(study).packed()
    write_atomically(file, key + packed)
    return packed


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


# Rows of a study evaluated.


TRIED = 4  # rows that a cost estimate is made from


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
    workers: Workers = THIS_PROCESS,
    progress: Progress | None = None,
    at_most: int | None = None,
) -> Results:
    """The results of rows; those that the store has not are evaluated and kept there.

    Which worker evaluates a row, in which batch and how often it is tried, changes no result.  A
    batch is synced to the store as soon as it arrives, so that what ends the study costs no more
    than the batches that were under way.

    Parameters
    ----------
    source : ProblemSource
    rows : (N, D) array, of a design
    store : ResultStore, of the source's identity
    workers : Workers, optional
    progress : Progress or None, called with (done, all) distinct rows
    at_most : int or None, the most distinct rows that the design may have

    Raises
    ------
    InputError
        The design has more rows, the disk refuses, or a worker has other versions of packages, or
        other files, than this process.
    LscanError
        The scheduler is gone, or a worker cannot make the problem.
    """
    require_at_most(rows, at_most)
    missing, every = store.missing(rows), len(distinct_rows(rows))
    done = every - len(missing)
    logged: set[str] = set()
    batches, evaluate = Batches(missing), partial(evaluate_rows, source, store.identity.sha256)
    files = named_files(dict(source.document))
    # Each row of a batch that kills its worker is tried as a batch of its own.
    stream = calls_done(workers, evaluate, batches, lambda batch: batch[:, None], files=files)
    killed = Results(np.full((1, 0), np.nan), (KILLED,))  # of a row that kills whoever evaluates it
    stops: list[bool] = []

    def stop() -> None:
        stops.append(True)
        raise KeyboardInterrupt

    with closing(stream), on_stop_signals(stop):
        for calls in stream:
            finished = [batch or Batch(row, killed, 0.0) for row, batch in calls]
            for batch in finished:
                batches.learn(len(batch.rows), batch.seconds)
            _log_faults(finished, logged)
            store.append(finished)
            done += sum(len(batch.rows) for batch in finished)
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
    count = len(distinct_rows(rows)) + more
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


def _log_faults(batches: list[Batch], logged: set[str]) -> None:
    """Log each kind of fault of the program once, with its traceback."""
    for batch in batches:
        for status, trace in batch.traces.items():
            kind = " ".join(status.split()[:2])
            if kind not in logged:
                _log.error("a row of the study failed: %s\n%s", status, trace)
                logged.add(kind)
