"""Axes of the tables of scattered light, and interpolation between their nodes."""

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from lscan.records import Floats


@dataclass(frozen=True)
class LogAxis:
    """``count`` nodes from ``low`` to ``high``, evenly spaced in log(offset + x)."""

    low: float
    high: float
    count: int
    offset: float = 0.0

    @property
    def start(self) -> float:
        """The logarithm at the first node."""
        return float(np.log(self.low + self.offset))

    @property
    def scale(self) -> float:
        """Nodes per unit of the logarithm."""
        return float((self.count - 1) / (np.log(self.high + self.offset) - self.start))

    def nodes(self) -> Floats:
        """(count,) x at the nodes."""
        nodes = np.exp(self.start + np.arange(self.count) / self.scale) - self.offset
        nodes[[0, -1]] = self.low, self.high
        return nodes

    def place(self, x: Floats) -> Floats:
        """Where x lies, in nodes from the first; same shape.

        Parameters
        ----------
        x : array, between ``low`` and ``high`` or beyond
        """
        return (np.log(x + self.offset) - self.start) * self.scale


Complex = NDArray[np.complex128]
Values = TypeVar("Values", Floats, Complex)

NEAREST_RAD = 1e-6  # below, light scattered once falls as 1 / angle, and little else is left
ANGLE_AXIS = LogAxis(NEAREST_RAD, np.pi, 512)


def between_nodes(table: Values, *places: Floats) -> Values:
    """Values of a table, linear between its nodes and held at its edges; shape of the places.

    Parameters
    ----------
    table : array of as many dimensions as there are places, real or complex
    *places : arrays, each in nodes of its dimension from the first; shapes broadcast
    """
    shape = np.broadcast_shapes(*(np.shape(place) for place in places))
    flat = [np.ravel(np.broadcast_to(place, shape)) for place in places]
    return np.reshape(map_coordinates(table, flat, order=1, mode="nearest"), shape)
