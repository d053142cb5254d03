"""How many rows a worker is given at a time."""

from collections.abc import Iterator

import numpy as np

from lscan.records import Floats

TARGET_S = 0.7  # of a batch: a hundred times what handing it out costs, and little to lose
GROWTH = 4  # at most, from one batch to the next: the first rows may be unlike the others


class Batches:
    """Rows in batches that take about ``TARGET_S`` each, as those before them tell.

    Parameters
    ----------
    rows : (N, D) array
    """

    def __init__(self, rows: Floats) -> None:
        self._rows, self._next, self._size = rows, 0, 1

    def __iter__(self) -> Iterator[Floats]:
        """Each next batch, of the size that is right when it is asked for."""
        while self._next < len(self._rows):
            begin, self._next = self._next, self._next + self._size
            yield self._rows[begin : self._next]

    def learn(self, count: int, seconds: float) -> None:
        """Take into account what rows took.

        Parameters
        ----------
        count : int, of rows
        seconds : float, s
        """
        right = TARGET_S * count / max(seconds, 1e-9)
        self._size = int(np.clip(right, 1, GROWTH * count))
