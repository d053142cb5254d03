"""Long work that is done once, when it is first needed: how far it is, for whoever shows it.

What makes a file of the user's cache lies deep beneath the function that was called, and drivers
open cameras without knowing who waits.  Such work says how far it is here; a command line draws
it as a bar, and where nobody shows it nothing is.
"""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

from lscan.records import Progress

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
