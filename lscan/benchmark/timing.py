"""How long a call takes, by the clock that only runs forwards."""

import time
from collections.abc import Callable
from typing import TypeVar

import numpy as np

Result = TypeVar("Result")


def timed(call: Callable[[], Result]) -> tuple[float, Result]:
    """Seconds of a call, and what it returns.

    Parameters
    ----------
    call : callable, called once

    Examples
    --------
    >>> seconds, total = timed(lambda: sum(range(10)))
    >>> total, seconds < 1
    (45, True)
    """
    started = time.perf_counter()
    result = call()
    return time.perf_counter() - started, result


def median_seconds(call: Callable[[], object], repeats: int) -> float:
    """Median seconds of a call.

    Parameters
    ----------
    call : callable
        Takes nothing; what it returns is not used.
    repeats : int
        Calls that are timed, after a first one that is not.

    Returns
    -------
    float
    """
    call()
    return float(np.median([timed(call)[0] for _ in range(repeats)]))
