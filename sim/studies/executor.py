"""What long work shares, of studies, data sets and suites: its folder, and who does it.

A folder says what it holds, and is locked while it is written.  Functions are called by workers:
in this process, by processes of this machine, or by those of a Dask cluster.  Which of them calls
one, and how often one is tried whose worker dies, changes no result.
"""

import logging
import multiprocessing
import os
import secrets
import signal
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from functools import cache, lru_cache, partial
from importlib.metadata import PackageNotFoundError, version
from itertools import chain, islice
from multiprocessing.process import BaseProcess
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import cv2
import numpy as np
import scipy

from lscan.acquisition.run import first_difference
from lscan.acquisition.scan import cores, require_guarded_main
from lscan.errors import InputError, LscanError
from lscan.files.disk import (
    content_sha256,
    disk_errors,
    json_text,
    lock_folder,
    make_folder,
    parse_json,
    read_json,
    write_json,
)
from lscan.version import __version__
from sim.render.backend import THREADS

if TYPE_CHECKING:
    from distributed import Client

# A folder that work is gone on with in.


_MOST_IDENTITY_BYTES = 2**24


@contextmanager
def locked_folder(folder: Path, writer: str) -> Iterator[None]:
    """A folder that no other process of the kind writes to within the block.

    Parameters
    ----------
    folder : Path, made where it is missing
    writer : str, what writes it, for the error

    Raises
    ------
    InputError
        Another process writes to it, or the disk refuses.
    """
    make_folder(folder)
    lock = lock_folder(folder, writer)
    try:
        yield
    finally:
        os.close(lock)


def keep_identity(
    file: Path, identity: Mapping[str, Any], what: str, allowed: str, *, begun: bool
) -> None:
    """Write what a folder is to hold; refuse one that holds something else.

    Parameters
    ----------
    file : Path, in the folder, that says so
    identity : mapping, of JSON types; two of the same ``sha256`` are the same
    what : str, what else the folder may hold, for the error
    allowed : str, for the error
    begun : bool, whether the folder holds anything yet

    Raises
    ------
    InputError
        It holds something else, or the disk refuses.
    """
    if not begun:
        write_json(file, identity)
        return
    require_same(read_identity(file), identity, what, file, allowed)


def read_identity(file: Path) -> dict[str, Any]:
    """What a folder says that it holds.

    Parameters
    ----------
    file : Path, in the folder

    Raises
    ------
    InputError
        The file cannot be read, or is no such file.
    """
    kept = read_json(file, _MOST_IDENTITY_BYTES, within=file.parent)
    if not isinstance(kept, dict) or not kept:
        raise InputError("does not say what is here", where=file, allowed="another folder")
    return kept


def require_same(
    kept: Mapping[str, Any], identity: Mapping[str, Any], what: str, file: Path, allowed: str
) -> None:
    """Refuse a folder that holds something else.

    Parameters
    ----------
    kept : mapping, what it holds, or a part of it
    identity : mapping, what it is to hold, or the same part
    what : str, what else it holds, for the error
    file : Path, in the folder, that says what it holds
    allowed : str, for the error

    Raises
    ------
    InputError
        Names where they differ first.
    """
    if "sha256" in identity and kept.get("sha256") == identity["sha256"]:
        return
    if (differing := first_difference(kept, parse_json(json_text(identity), file))) is not None:
        raise InputError(
            f"holds {what}, which differs in its {differing} ({file.name})",
            where=file.parent,
            value=kept.get("sha256"),
            allowed=allowed,
        )


# What workers have in common with whom they work for: another version of a package, another mesh
# of the same path or another disk of the same name would change results in silence.


Item = TypeVar("Item")
Found = TypeVar("Found")
Other = TypeVar("Other")
MARKER = ".seen-by-workers-"


@cache
def package_versions() -> Mapping[str, str]:
    """Version, by name, of each package that the bytes of a row or a picture depend on."""
    found = {"lscan": __version__, "numpy": np.__version__}
    found |= {"scipy": scipy.__version__, "opencv": cv2.__version__}
    for name in ("mitsuba", "drjit"):
        try:
            found[name] = version(name)  # importing Mitsuba takes a second
        except PackageNotFoundError:
            found[name] = "none"
    return found


@dataclass(frozen=True)
class _InCommon:
    """What a worker must have as the process has that sends it work.

    versions: of packages, by name.  files: SHA-256 of those that results depend on, by path.
    marker: a file of a name that no other has, in the folder that is written to, if any.
    """

    versions: tuple[tuple[str, str], ...]
    files: tuple[tuple[str, str], ...]
    marker: Path | None


@contextmanager
def _in_common(files: Mapping[str, str], folder: Path | None) -> Iterator[_InCommon]:
    """What workers must have of these files, and of a folder that no other disk has."""
    common = _InCommon(tuple(package_versions().items()), tuple(files.items()), None)
    if folder is None:
        yield common
        return
    marker = folder / f"{MARKER}{secrets.token_hex(16)}"
    with disk_errors(marker):
        for left in folder.glob(f"{MARKER}*"):  # by a killed process
            left.unlink()
        marker.touch()
    try:
        yield replace(common, marker=marker)
    finally:
        with suppress(OSError):
            marker.unlink()


def _call_in_common(common: _InCommon, function: Callable[..., Found], *arguments: Any) -> Found:
    """What a function gives, called on a worker; refused where that has something else."""
    if (found := _difference(common)) is not None:
        what, value, allowed = found
        raise InputError(what, where=f"the worker at {_address()}", value=value, allowed=allowed)
    return function(*arguments)


@lru_cache(maxsize=4)
def _difference(common: _InCommon) -> tuple[str, str, str] | None:
    """What this process has not in common: what, what it has, what it is to have."""
    here = package_versions()
    for name, wanted in common.versions:
        if here[name] != wanted:
            return f"has another version of {name}", here[name], f"{wanted}, as here"
    if common.marker is not None and not common.marker.exists():
        folder = str(common.marker.parent)
        return "has another folder of the same name", folder, "a folder that both see"
    for file, wanted in common.files:
        if content_sha256(Path(file)) != wanted:
            return "has another file of the same name, or none", file, "the same as here"
    return None


def _address() -> str:
    if "distributed" in sys.modules:
        with suppress(ValueError):  # of no cluster
            return str(sys.modules["distributed"].get_worker().address)
    return f"process {os.getpid()}"


# Who calls functions: this process, processes of this machine, or those of a cluster.
#
# Whoever reaches a Dask scheduler can have any code run by its workers: a cluster is its owner's to
# guard.  Processes of this machine are reached by pipes, which nobody else has.


AHEAD = 2  # calls a worker: the one it works on, and the next
CONNECT_S = 20.0
CLOSE_S = 10.0
RECOUNT_S = 2.0  # between counts of a cluster's workers, each of which costs a few ms
KILLED = "killed its worker"

_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
# Giving memory back at once, and asking for a picture's arrays anew, page by page, takes a third of
# the time to render it.
_ONE_THREAD |= {"MALLOC_TRIM_THRESHOLD_": f"{2**29}", "MALLOC_MMAP_THRESHOLD_": f"{2**25}"}
# Dr.Jit's threads wait for work at full speed: as many workers as cores need them themselves.
_ONE_EACH = _ONE_THREAD | {THREADS: "1"}

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Workers:
    """Those that call functions.

    Attributes
    ----------
    submit : callable, of a function and its arguments; gives the future of what it gives
    most : callable, how many calls are to be under way
    died : type, what a call raises whose worker was killed
    attempts : int, that a worker's death ends before a call is given up, the last of them alone
    failure : callable, of an error that a call raised, what ends the work
    elsewhere : bool, whether they may have other disks than this process
    """

    submit: Callable[..., Future[Any]]
    most: Callable[[], int] = lambda: 1
    died: type[Exception] = BrokenProcessPool
    attempts: int = 2
    failure: Callable[[Exception], Exception] = lambda error: error
    elsewhere: bool = False


def _call_here(function: Callable[..., Found], *arguments: Any) -> Future[Found]:
    future: Future[Found] = Future()
    future.set_result(function(*arguments))
    return future


THIS_PROCESS = Workers(_call_here)


def open_workers(
    workers: int | Literal["none"] = 2, scheduler: str | None = None
) -> AbstractContextManager[Workers]:
    """Workers that end with the block, or those of a cluster, which it leaves.

    Parameters
    ----------
    workers : int, processes of this machine; "none": this one alone
    scheduler : str or None, address of the scheduler of a cluster, such as "tcp://cluster:8786";
        it and its workers can have any code run here and there, and so can whoever else reaches
        them

    Raises
    ------
    InputError
        No scheduler answers at the address, it has no workers, or one has another lscan.
    """
    if workers == "none":
        return nullcontext(THIS_PROCESS)
    return _processes(workers) if scheduler is None else _cluster(scheduler)


@contextmanager
def _processes(count: int) -> Iterator[Workers]:
    """Processes of this machine, begun when they are needed; where one is killed, all anew."""
    require_guarded_main()
    environment = _ONE_EACH if count >= cores() else _ONE_THREAD
    pools: list[ProcessPoolExecutor] = []  # the last is at work, those before are broken
    children: set[BaseProcess] = set()

    def submit(function: Callable[..., Found], *arguments: Any) -> Future[Found]:
        before = set(multiprocessing.active_children())
        try:
            with _environment_of_children(environment):
                return pools[-1].submit(function, *arguments)
        except (IndexError, BrokenProcessPool):
            # None is forked: threads of OpenCV and BLAS may hold locks.
            spawn = multiprocessing.get_context("spawn")
            pools.append(ProcessPoolExecutor(count, spawn, _end_with_parent))
            return submit(function, *arguments)
        finally:
            children.update(set(multiprocessing.active_children()) - before)

    try:
        yield Workers(submit, lambda: AHEAD * count, attempts=3, failure=_unable)
    finally:
        for child in children:  # whatever they do: what is done has been handed over
            child.kill()
        for pool in pools:
            # Before 3.11.5 it waits for what it sends to a process that is gone.
            if sys.version_info < (3, 11, 5):
                pool._call_queue._reader.close()  # type: ignore[attr-defined]
            pool.shutdown(cancel_futures=True)


def _end_with_parent() -> None:
    """End this process where the one is killed that began it: nobody else would."""

    def wait_for_its_end() -> None:
        parent = multiprocessing.parent_process()
        assert parent is not None
        parent.join()
        os._exit(1)

    threading.Thread(target=wait_for_its_end, daemon=True).start()


@contextmanager
def _environment_of_children(variables: Mapping[str, str]) -> Iterator[None]:
    """Have processes that are begun in the block these variables, and be deaf to Ctrl-C.

    A terminal sends Ctrl-C to all processes; it is for the one that ends the others.
    """
    before = {name: os.environ.get(name) for name in variables}
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


@contextmanager
def _cluster(scheduler: str) -> Iterator[Workers]:
    from distributed import Client  # takes a second to import

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
        yield workers_of(client)
    finally:
        with suppress(TimeoutError, OSError):
            client.close(timeout=CLOSE_S)


def workers_of(client: "Client") -> Workers:
    """The workers of a Dask cluster, as many as it has when it is asked.

    Parameters
    ----------
    client : distributed.Client
    """
    from distributed import KilledWorker
    from distributed.comm import CommClosedError

    @lru_cache(1)
    def most_at(moment: int) -> int:
        return AHEAD * max(len(client.nthreads()), 1)

    def failure(error: Exception) -> Exception:
        if isinstance(error, CancelledError | CommClosedError | TimeoutError):
            return LscanError(f"the scheduler at {client.scheduler.address} is gone")
        _require_versions(client)
        return _unable(error)

    return Workers(
        client.get_executor(pure=False).submit,
        lambda: most_at(int(time.monotonic() / RECOUNT_S)),
        died=KilledWorker,
        failure=failure,
        elsewhere=True,
    )


def _require_versions(client: "Client") -> None:
    """Refuse workers of another lscan, which may not know how to see to it themselves."""
    told = client.run(resolve_name, "lscan.version:__version__", on_error="return")
    for address, found in told.items():
        if found != __version__ and not isinstance(found, OSError):  # one that is gone
            where, allowed = f"the worker at {address}", f"{__version__}, as here"
            what = "has another version of lscan"
            raise InputError(what, where=where, value=str(found), allowed=allowed)


def _unable(error: Exception) -> LscanError:
    text = " ".join(f"{type(error).__name__}: {error}".split())
    return LscanError(f"a worker cannot evaluate any row: {text}")


# Many calls of one function, however many workers there are and whatever becomes of them.


def calls_done(
    workers: Workers,
    function: Callable[[Item], Found],
    of: Iterable[Item],
    apart: Callable[[Item], Iterable[Item]] = lambda item: [item],
    *,
    files: Mapping[str, str] | None = None,
    folder: Path | None = None,
) -> Generator[list[tuple[Item, Found | None]]]:
    """What a function gives for each of many things, as they are done: those together that wait.

    What was under way when a worker was killed is tried again; where that happens time and again,
    it is taken apart, and each part is tried alone, with nothing beside it that could be to blame.
    One that kills its worker then gives None.

    Parameters
    ----------
    workers : Workers
    function : callable, pure
    of : iterable, whose next thing is asked for when a worker has time for it
    apart : callable, the parts of a thing
    files : mapping, optional, SHA-256 of each file that the function reads, by its path
    folder : Path, optional, that the function writes to

    Raises
    ------
    InputError
        A worker has other versions of packages, other files, or another folder of that name.
    LscanError
        The scheduler is gone, or a worker cannot call the function.
    """
    waiting, suspects = iter(of), list[Item]()
    try:
        with _in_common(files or {}, folder if workers.elsewhere else None) as common:
            submit = partial(workers.submit, _call_in_common, common, function)
            while True:
                yield from _calls_side_by_side(workers, submit, waiting, suspects)
                if not suspects:
                    return
                _log.warning("a worker was killed: %d calls are tried again", len(suspects))
                for _ in range(workers.attempts - 2):
                    again, suspects = iter(suspects), []
                    yield from _calls_side_by_side(workers, submit, again, suspects)
                    suspects += again
                for item in chain.from_iterable(map(apart, suspects)):
                    found: Found | None = None
                    try:
                        found = submit(item).result()
                    except workers.died:  # where nothing at all can be done, no item is to blame
                        workers.submit(os.getpid).result()
                    yield [(item, found)]
                suspects.clear()
    except LscanError:
        raise
    except Exception as error:  # whatever it is, it was raised by no item
        told = workers.failure(error)  # in one line
        if told is error:
            raise
        raise told from error


def _calls_side_by_side(
    workers: Workers,
    submit: Callable[[Item], Future[Found]],
    waiting: Iterator[Item],
    suspects: list[Item],
) -> Iterator[list[tuple[Item, Found | None]]]:
    """What is done until all is, or a worker is killed: then what was under way is suspect."""
    under_way: dict[Future[Found], Item] = {}
    while True:
        more = 0 if suspects else workers.most() - len(under_way)  # fewer than none where some left
        for item in islice(waiting, max(more, 0)):
            under_way[submit(item)] = item
        if not under_way:
            return
        finished: list[tuple[Item, Found | None]] = []
        for future in wait(under_way, return_when=FIRST_COMPLETED).done:
            item = under_way.pop(future)
            try:
                finished.append((item, future.result()))
            except workers.died:
                suspects.append(item)
        if finished:
            yield finished


def in_order(
    workers: Workers,
    function: Callable[[Item], Found],
    of: Iterable[Item],
    killed: Callable[[str], Other],
    *,
    files: Mapping[str, str] | None = None,
    folder: Path | None = None,
) -> Generator[Found | Other]:
    """What a function gives for each of a few things, in their order, as far as they are done.

    Parameters
    ----------
    workers : Workers
    function : callable, pure; never None
    of : iterable, as of ``calls_done``
    killed : callable, what to give, by the reason, for one that killed its workers time and again
    files, folder : as of ``calls_done``

    Raises
    ------
    InputError, LscanError
        As ``calls_done``.
    """
    done: dict[int, Found | Other] = {}
    given = 0
    numbered = partial(_numbered, function)
    for calls in calls_done(workers, numbered, enumerate(of), files=files, folder=folder):
        done |= {n: killed(KILLED) if found is None else found for (n, _), found in calls}
        while given in done:
            yield done.pop(given)
            given += 1


def _numbered(function: Callable[[Item], Found], numbered: tuple[int, Item]) -> Found:
    return function(numbered[1])
