"""Shifting and scaling of coordinates, so that least squares stays well conditioned."""

from dataclasses import dataclass

import numpy as np

from lscan.calibration.stored import STRICT, Place
from lscan.records import Floats


@dataclass(frozen=True)
class Scaling:
    """scaled = (point - centre) / scale.

    Attributes
    ----------
    centre, scale : (2,) array, in the points' unit; no scale is 0 or less
    """

    __pydantic_config__ = STRICT
    centre: Place
    scale: Place

    def __post_init__(self) -> None:
        """Raise ValueError where a scale is 0 or less."""
        if self.scale.min() <= 0:
            raise ValueError("a scaling has two scales above 0")

    def apply(self, points: Floats) -> Floats:
        """(N, 2) scaled.

        Parameters
        ----------
        points : (N, 2) array, of any unit
        """
        return (points - self.centre) / self.scale

    def undo(self, scaled: Floats) -> Floats:
        """(N, 2) in the points' unit again.

        Parameters
        ----------
        scaled : (N, 2) array
        """
        return scaled * self.scale + self.centre


def hartley(points: Floats) -> Scaling:
    """The scaling that brings the centroid to the origin, the mean distance from it to sqrt(2).

    Parameters
    ----------
    points : (N, 2) array, of any unit

    References
    ----------
    Hartley, "In defense of the eight-point algorithm", IEEE PAMI 19 (1997), Sec. 4.
    """
    centre = points.mean(axis=0)
    scale = np.linalg.norm(points - centre, axis=1).mean() / np.sqrt(2)
    return Scaling(centre, np.array([scale, scale]))


def box(points: Floats) -> Scaling:
    """The scaling by which the points' bounding box becomes the square from -1 to 1.

    Parameters
    ----------
    points : (N, 2) array, of any unit

    Examples
    --------
    >>> box(np.array([[0.0, 0.0], [4.0, 2.0]])).apply(np.array([[4.0, 1.0]]))
    array([[1., 0.]])
    """
    low, high = points.min(axis=0), points.max(axis=0)
    return Scaling((low + high) / 2, (high - low) / 2)
