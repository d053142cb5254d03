"""A smooth function of the pixel, computed once at few pixels and looked up at many."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.polynomial.chebyshev import chebpts1, chebvander, chebvander2d

from lscan.calibration.region import Region
from lscan.records import Floats

SHARE = 1e-7
"""Of the function's largest value: farthest that a table may be from it, well below what the
finite differences leave that it is made from."""
ORDERS = 4, 8, 10, 12, 14, 17, 20, 24
"""Coefficients along u and along v that are tried, each judged at the nodes of the next."""
BLOCK = 512  # pixels: their products of polynomials stay in the processor's cache


@dataclass(frozen=True)
class PixelTable:
    """Chebyshev series in u and v over a rectangle of the picture.

    Attributes
    ----------
    middle_px, half_px : (2,) array, px, of (u, v), the rectangle's middle and half its size
    coefficients : (n, n, K) array, of the products of polynomials in u and in v, for K values
    """

    middle_px: Floats
    half_px: Floats
    coefficients: Floats

    def look_up(self, image_px: Floats) -> Floats:
        """(N, K) values.

        Parameters
        ----------
        image_px : (N, 2) array, px, of (u, v) in the rectangle
        """
        order, _, count = self.coefficients.shape
        matrix = self.coefficients.reshape(order**2, count)
        # In blocks of one size, for the same bytes however many pixels are asked for at once.
        blocks = -(-len(image_px) // BLOCK)
        places = np.zeros((blocks * BLOCK, 2))
        places[: len(image_px)] = (image_px - self.middle_px) / self.half_px
        values = np.empty((blocks * BLOCK, count))
        for first in range(0, len(places), BLOCK):
            block = slice(first, first + BLOCK)
            u, v = places[block].T
            values[block] = chebvander2d(u, v, [order - 1, order - 1]) @ matrix
        return values[: len(image_px)]


def tabulated(function: Callable[[Floats], Floats], region: Region) -> PixelTable | None:
    """The table of a function over a region of the picture; None where it is not so smooth.

    Parameters
    ----------
    function : callable, from (N, 2) px, of (u, v), to (N, K) values, all of one unit
    region : Region, px; the function is computed in all of the rectangle about it

    References
    ----------
    Trefethen, Approximation Theory and Approximation Practice (2013), ch. 3 and 8: interpolation
    in Chebyshev's nodes, whose error falls exponentially for an analytic function.
    """
    low, high = region.bounds_px
    middle, half, table = (low + high) / 2, (high - low) / 2, None
    for order in ORDERS:
        nodes = chebpts1(order)
        grid = np.stack(np.meshgrid(nodes, nodes, indexing="ij"), axis=-1).reshape(-1, 2)
        pixels = middle + half * grid
        values = function(pixels)
        if not np.isfinite(values).all():
            return None
        if table is not None:
            error = np.abs(table.look_up(pixels) - values).max(initial=0.0)
            if error <= SHARE * np.abs(values).max(initial=0.0):
                return table
        # The polynomials are orthogonal over their own nodes.
        inverse = chebvander(nodes, order - 1).T * np.where(np.arange(order) > 0, 2, 1)[:, None]
        inverse /= order
        values = values.reshape(order, order, values.shape[1])
        table = PixelTable(middle, half, np.einsum("iu,jv,uvk->ijk", inverse, inverse, values))
    return None
