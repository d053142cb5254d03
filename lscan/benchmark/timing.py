"""How long a call takes, by the clock that only runs forwards."""

import time
from collections.abc import Callable
from typing import TypeVar

import numpy as np

Result = TypeVar("Result")


def timed(call: Callable[[], Result]) -> tuple[float, Result]:
    """Seconds of a call, and what it returns."""
    started = time.perf_counter()
    result = call()
    return time.perf_counter() - started, result


def median_seconds(call: Callable[[], object], repeats: int) -> float:
    """Median seconds of so many calls after a first one, which is not counted."""
    call()
    return float(np.median([timed(call)[0] for _ in range(repeats)]))
