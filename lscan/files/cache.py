"""The cache of the user, and how far the long work is that fills it.

What makes a file of the cache lies deep beneath the function that was called, and drivers open
cameras without knowing who waits.  Such work says how far it is here; a command line draws it as a
bar, and where nobody shows it nothing is.
"""

import os
import stat
import tempfile
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path

from lscan.errors import InputError
from lscan.files.disk import read_bytes
from lscan.records import Progress


def cache_folder() -> Path | None:
    """The folder of the user's cache, made where it is missing; None where there can be none.

    It is ``lscan`` in $XDG_CACHE_HOME, or in ~/.cache; without HOME it lies in the temporary
    folder, which all users share, under the user's number.  In any place it is the user's own, and
    nobody else may look into it or write there: what it keeps is believed.  On Windows, where that
    cannot be asked so, there is none.
    """
    if not hasattr(os, "getuid"):
        return None
    home, shared = os.environ.get("HOME"), Path(tempfile.gettempdir(), f"lscan-{os.getuid()}")
    above = os.environ.get("XDG_CACHE_HOME") or (home and f"{home}/.cache")
    folder = Path(above, "lscan") if above else shared
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = folder.stat(follow_symlinks=folder != shared)
        if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid():
            return None
        if stat.S_IMODE(status.st_mode) & 0o077:
            folder.chmod(0o700)
    except OSError:
        return None
    return folder


def read_cached(file: Path, most: int) -> bytes | None:
    """What a file of the cache holds; None where it is missing, too large or not the user's own.

    Parameters
    ----------
    file : Path, in ``cache_folder()``
    most : int, its largest size, bytes
    """
    with suppress(InputError, OSError):
        if hasattr(os, "getuid") and file.stat().st_uid == os.getuid():
            return read_bytes(file, most)
    return None


# Long work that is done once, when it is first needed: how far it is, for whoever shows it.

Shown = Callable[[str], AbstractContextManager[Progress]]
"""What shows work under a title, and gives what the work calls with (done, all)."""

_shown: list[Shown] = []


@contextmanager
def long_work(title: str) -> Iterator[Progress]:
    """What long work calls with (done, all) of its steps within the block.

    Parameters
    ----------
    title : str, what the work is

    Examples
    --------
    >>> with long_work("squares") as progress:
    ...     for number in range(3):
    ...         progress(number + 1, 3)
    """
    if not _shown:
        yield lambda done, every: None
        return
    with _shown[-1](title) as progress:
        yield progress


@contextmanager
def long_work_shown(show: Shown) -> Iterator[None]:
    """Let a function show all long work that is begun within the block, in any thread.

    Parameters
    ----------
    show : function of a title whose context manager gives a function of (done, all)
    """
    _shown.append(show)
    try:
        yield
    finally:
        _shown.remove(show)
