"""Calls that another process can make."""

import os
import time


class Squares:
    """Squares, and which process made each, after a while."""

    def __init__(self, seconds: float, deadly: int | None = None) -> None:
        self._seconds, self._deadly, self._home = seconds, deadly, os.environ.get("HELPER_IS")

    def __call__(self, number: int) -> tuple[int, int]:
        """The square; where a helper is asked for the deadly number, it fails."""
        if number == self._deadly and self._home is not None:
            raise ValueError(number)
        time.sleep(self._seconds)
        return number**2, os.getpid()
