"""Work on several pictures at once, whose results come in the pictures' order."""

import ast
import inspect
import os
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TypeVar

from lscan.errors import InputError

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


def require_guarded_main() -> None:
    """Refuse to start processes from the body of a script, which each of them would run again.

    Python imports the script in every process that it starts, all but what stands beneath
    ``if __name__ == "__main__":``.

    Raises
    ------
    InputError
        The call is made in a script's body; names the line.
    """
    main = sys.modules["__main__"]
    file, spec = getattr(main, "__file__", None), getattr(main, "__spec__", None)
    if file is None or (spec is not None and spec.name.endswith("__main__")):
        return  # typed in, or of a package's __main__: not imported by others
    lines = [
        (one.lineno, one.frame.f_code.co_name)
        for one in inspect.stack(0)
        if one.frame.f_globals is vars(main)
    ]
    if not lines or lines[-1][1] != "<module>":
        return
    body, line = ast.parse(Path(file).read_bytes()).body, lines[-1][0]
    (statement,) = (one for one in body if one.lineno <= line <= (one.end_lineno or line))
    names = {one.id for one in ast.walk(statement) if isinstance(one, ast.Name)}
    if not (isinstance(statement, ast.If) and "__name__" in names):
        raise InputError(
            "starts processes, each of which would run this script again",
            where=f"{file} line {line}",
            allowed='beneath if __name__ == "__main__":',
        )
