"""Tables that take long to make, kept in the user's cache: made once, by one process at a time."""

import fcntl
import hashlib
import io
import logging
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from time import sleep

import numpy as np

from lscan.errors import InputError
from lscan.files.cache import cache_folder, long_work, read_cached
from lscan.files.disk import write_atomically
from lscan.records import Floats

# Of a kept file: 64 for each triangle of a mesh in the tank, whose files hold up to 1.4e7 of them.
LARGEST_BYTES = 2**30
DIGEST_BYTES = 32
MOST_BYTES = 2 * 2**30  # of all tables together: those of a budget in rendered physics take 1.8 GB
ASKED_S = 0.1  # between questions for a lock

_log = logging.getLogger(__name__)


def kept_arrays(name: str, make: Callable[[], dict[str, Floats]]) -> dict[str, Floats]:
    """The arrays that ``make`` returns, or returned before under the same name.

    Processes that ask for the same name at once wait for the first of them.  A file that is
    broken, or another user's, is replaced.  Where all tables together take more than
    ``MOST_BYTES``, those that were used longest ago are removed.  Where the cache cannot be
    written, the log says so and the arrays are returned all the same.

    Parameters
    ----------
    name : str, a file's name that says all that the arrays depend on, by a hash
    make : function without arguments that makes the arrays
    """
    if (cache := cache_folder()) is None:
        _log.warning("a table will have to be made again: there is no cache of this user's own")
        return make()
    file = cache / name
    if (arrays := _read_table(file)) is None:
        with _alone(file):
            arrays = _read_table(file) or _make_and_keep(file, make)
    return arrays


def _make_and_keep(file: Path, make: Callable[[], dict[str, Floats]]) -> dict[str, Floats]:
    """Make the arrays and write them, with a digest before them."""
    arrays = make()
    packed = io.BytesIO()
    np.savez(packed, allow_pickle=False, **arrays)
    data = packed.getvalue()
    try:
        write_atomically(file, hashlib.sha256(data).digest() + data)
    except InputError as error:
        _log.warning("a table will have to be made again: %s", error)
    remove_oldest(file.parent)
    return arrays


def remove_oldest(folder: Path) -> None:
    """Remove the tables that were used longest ago, until the others are within ``MOST_BYTES``.

    What other commands keep there is left alone: a table is what has a lock beside it.

    Parameters
    ----------
    folder : Path, of the tables
    """
    found = []
    for lock in folder.glob("*.lock"):
        with suppress(OSError):  # not made yet, or removed by another process
            status = lock.with_suffix("").stat()
            found.append((status.st_mtime_ns, status.st_size, lock))
    total = sum(size for _, size, _ in found)
    for _, size, lock in sorted(found):
        if total <= MOST_BYTES:
            return
        with suppress(OSError):
            lock.with_suffix("").unlink()
            lock.unlink()
        total -= size


def _read_table(file: Path) -> dict[str, Floats] | None:
    """The arrays of a kept file; None where there is none or it is broken."""
    data = read_cached(file, LARGEST_BYTES) or b""
    digest, packed = data[:DIGEST_BYTES], data[DIGEST_BYTES:]
    if hashlib.sha256(packed).digest() != digest:
        return None
    with suppress(OSError):
        os.utime(file)  # the time of its last use, by which tables are removed
    with np.load(io.BytesIO(packed), allow_pickle=False) as arrays:
        return dict(arrays)


@contextmanager
def _alone(file: Path) -> Iterator[None]:
    """Hold a lock beside the file, which ends with the process; none where it cannot be made."""
    descriptor = None
    with suppress(OSError):
        descriptor = os.open(
            file.with_suffix(".lock"), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600
        )
        _lock(descriptor)
    try:
        yield
    finally:
        if descriptor is not None:
            os.close(descriptor)


def _lock(descriptor: int) -> None:
    """Lock a file; where another process holds the lock, wait and say so."""
    if _is_locked(descriptor):
        return
    with long_work("wait for a table that another process makes"):
        # Asked for again and again: waiting within flock is deaf to Ctrl-C once Mitsuba has
        # rendered, which sets its handler so that system calls go on (SA_RESTART).
        while not _is_locked(descriptor):
            sleep(ASKED_S)


def _is_locked(descriptor: int) -> bool:
    """Try to lock a file."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
