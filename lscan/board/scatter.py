"""By how much dots scatter about a smooth lattice more than the noise of pixels explains.

A coder's quantisation and the interpolation of a colour filter's pixels displace dots as noise
does, but are not seen where the picture is even.  They are seen in the lattice itself: seen by a
lens through a port it is smooth, and its fifth differences next to nothing.
"""

from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from lscan.board.search import Nodes
from lscan.records import BoardReading, Floats, Mark, Marks, RingPoints

_Marked = TypeVar("_Marked", Mark, Marks, RingPoints)

FIFTH = np.array([1.0, -5.0, 10.0, -10.0, 5.0, -1.0])
"""Differences that leave nothing of a polynomial of the fourth degree: of six dots in a row over a
tenth of the picture's width a lens leaves 1e-3 px of them, over the norm 16 1e-4 px."""
FEWEST = 40  # differences, many of which share dots: their spread is known to a fifth
CHANCE = 1.5  # times what is expected; below it is taken for chance, or for edges that are coarse


def lattice_scatter(nodes: Nodes) -> float:
    """The scatter of a lattice's fifth differences over what its sigmas make of it; 1 or more.

    Robust: half of the dots may lie anywhere.  Below CHANCE, and with too few dots in rows of
    six, it is 1.

    Parameters
    ----------
    nodes : Nodes, px, with their standard uncertainties

    References
    ----------
    Birge, The calculation of errors by the method of least squares, Phys. Rev. 40, 207 (1932): an
    uncertainty is enlarged by the ratio of what is seen to what was stated.
    """
    points, variance = nodes.points, nodes.sigma_px**2
    each = (points[..., 0], points[..., 1])
    ratios = [_ratios(values, variance, axis) for values in each for axis in (0, 1)]
    found = np.abs(np.concatenate(ratios))
    found = found[np.isfinite(found)]
    if len(found) < FEWEST:
        return 1.0
    scatter = float(np.median(found)) / 0.6745
    return scatter if scatter > CHANCE else 1.0


def less_sure(reading: BoardReading, times: float) -> BoardReading:
    """The reading with all its uncertainties so many times larger: all marks share their cause.

    Parameters
    ----------
    reading : BoardReading
    times : float
    """

    def of(mark: _Marked) -> _Marked:
        return replace(mark, sigma_px=times * mark.sigma_px)

    return replace(
        reading,
        grid=of(reading.grid),
        rulers=tuple(replace(ruler, marks=of(ruler.marks)) for ruler in reading.rulers),
        dots={name: of(dot) for name, dot in reading.dots.items()},
        rings={name: of(ring) for name, ring in reading.rings.items()},
    )


def _ratios(values: Floats, variance: Floats, axis: int) -> Floats:
    """Fifth differences of (R, C) values along an axis, in their standard deviations."""
    if values.shape[axis] < len(FIFTH):
        return np.empty(0)
    differences = sliding_window_view(values, len(FIFTH), axis=axis) @ FIFTH
    expected = sliding_window_view(variance, len(FIFTH), axis=axis) @ FIFTH**2
    return np.asarray(differences / np.sqrt(expected)).ravel()
