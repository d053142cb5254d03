"""A place for the newest of a kind: whoever is slow misses the ones between, and holds up none."""

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")

RATE_OVER_S = 2.0


class Newest(Generic[T]):
    """The newest value put here, numbered from 1."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._value: T | None = None
        self._number = 0
        self._times_s: deque[float] = deque()
        self._listener: Callable[[], None] = lambda: None

    def put(self, value: T) -> None:
        """Replace the value, wake those who wait and call the listener."""
        with self._changed:
            self._value, self._number = value, self._number + 1
            self._times_s.append(time.monotonic())
            self._changed.notify_all()
        self._listener()

    def listen(self, listener: Callable[[], None]) -> None:
        """Call ``listener``, which must not block, after each value put from now on."""
        self._listener = listener

    def after(self, number: int, timeout_s: float = 0.0) -> tuple[int, T] | None:
        """The newest value and its number where that is above ``number``; None if not in time."""
        with self._changed:
            self._changed.wait_for(lambda: self._number > number, timeout_s)
            if self._number <= number or self._value is None:
                return None
            return self._number, self._value

    def rate_hz(self) -> float:
        """Values per second over the last RATE_OVER_S."""
        with self._changed:
            while self._times_s and self._times_s[0] < time.monotonic() - RATE_OVER_S:
                self._times_s.popleft()
            return len(self._times_s) / RATE_OVER_S
