"""By how much dots scatter about a smooth lattice more than the noise of pixels explains.

A coder's quantisation and the interpolation of a colour filter's pixels displace dots as noise
does, but are not seen where the picture is even.  They are seen in the lattice itself: seen by a
lens through a port it is smooth, and its fifth differences next to nothing.
"""

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from lscan.board.search import Nodes
from lscan.records import Floats

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


def _ratios(values: Floats, variance: Floats, axis: int) -> Floats:
    """Fifth differences of (R, C) values along an axis, in their standard deviations."""
    if values.shape[axis] < len(FIFTH):
        return np.empty(0)
    differences = sliding_window_view(values, len(FIFTH), axis=axis) @ FIFTH
    expected = sliding_window_view(variance, len(FIFTH), axis=axis) @ FIFTH**2
    return np.asarray(differences / np.sqrt(expected)).ravel()
