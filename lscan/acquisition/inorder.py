"""Work on several pictures at once, whose results come in the pictures' order."""

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
_AHEAD = 2  # calls begun or waiting for each thread, so that none waits for the next item


def in_order(work: Callable[[_Item], _Result], items: Iterable[_Item]) -> Iterator[_Result]:
    """The results of a call for each item, in the items' order, made on a thread for each core.

    Threads run at once where OpenCV and NumPy compute: meanwhile these do not hold Python's lock.
    An exception is raised in the place of its result, after all results before it.  Whoever ends
    the iteration early, as Ctrl-C does, waits for the calls that have begun, and no others begin.

    Parameters
    ----------
    work : callable, of one item; it is called from several threads at once
    items : iterable, taken a few ahead of the results

    Examples
    --------
    >>> list(in_order(abs, range(-3, 2)))
    [3, 2, 1, 0, 1]
    """
    threads = cores()
    with ThreadPoolExecutor(threads) as pool:
        begun: deque[Future[_Result]] = deque()
        try:
            for item in items:
                begun.append(pool.submit(work, item))
                if len(begun) >= _AHEAD * threads:
                    yield begun.popleft().result()
            while begun:
                yield begun.popleft().result()
        finally:
            for waiting in begun:
                waiting.cancel()


def cores() -> int:
    """How many cores this process may use."""
    allowed = getattr(os, "sched_getaffinity", None)  # not on macOS and Windows
    return len(allowed(0)) if allowed else os.cpu_count() or 1
