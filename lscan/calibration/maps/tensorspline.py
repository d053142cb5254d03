"""Tensor-product cubic B-splines over the picture, and how rough such a surface is."""

from dataclasses import dataclass
from math import comb

import numpy as np
from scipy.interpolate import BSpline

from lscan.calibration.stored import STRICT, Vector
from lscan.records import Floats

DEGREE = 3
ORDER = 3  # of the derivatives that roughness is made of
FLAT = ORDER * (ORDER + 1) // 2  # terms u^i v^j, i + j < ORDER: they have no roughness
GAUSS_POINTS = 4  # exact for degree 7; a product of two cubics has degree 6


@dataclass(frozen=True)
class TensorBasis:
    """All products of a cubic B-spline of u and one of v: K = I · J functions, i slowest.

    Attributes
    ----------
    knots_u : (I + 4,) array, in the unit of the points
    knots_v : (J + 4,) array, in the unit of the points
    """

    __pydantic_config__ = STRICT
    knots_u: Vector
    knots_v: Vector

    def __post_init__(self) -> None:
        """Raise ValueError unless both knot vectors rise and suffice for a cubic."""
        for knots in (self.knots_u, self.knots_v):
            if len(knots) < 2 * (DEGREE + 1) or np.any(np.diff(knots) < 0):
                raise ValueError("knots must be eight or more and must not fall")
            if knots[DEGREE] >= knots[-DEGREE - 1]:
                raise ValueError("knots must span a stretch")

    @property
    def count(self) -> int:
        """K."""
        return (len(self.knots_u) - DEGREE - 1) * (len(self.knots_v) - DEGREE - 1)

    def rows(self, points: Floats, by_u: int = 0, by_v: int = 0) -> Floats:
        """(N, K) values of the functions, or of their derivatives.

        Parameters
        ----------
        points : (N, 2) array, of (u, v)
        by_u, by_v : int, how often they are derived by u and by v
        """
        of_u = _values(self.knots_u, points[:, 0], by_u)
        of_v = _values(self.knots_v, points[:, 1], by_v)
        return (of_u[:, :, None] * of_v[:, None, :]).reshape(len(points), self.count)

    def roughness(self) -> Floats:
        """(K, K) R so that c @ R @ c is the roughness of the surface with coefficients c.

        It is the integral over the rectangle of the knots of
        f_uuu² + 3 f_uuv² + 3 f_uvv² + f_vvv², which does not depend on how the axes are
        turned (Wahba, "Spline Models for Observational Data" (1990), eq. (2.4.9), m = 3).
        """
        total = np.zeros((self.count, self.count))
        for by_u in range(ORDER + 1):
            of_u, of_v = _products(self.knots_u, by_u), _products(self.knots_v, ORDER - by_u)
            total += comb(ORDER, by_u) * np.kron(of_u, of_v)
        return total


def even_basis(low: Floats, high: Floats, segments: int) -> TensorBasis:
    """The basis on a rectangle with equal segments.

    Parameters
    ----------
    low, high : (2,) array, two opposite corners of the rectangle
    segments : int, a side
    """
    knots = [
        np.concatenate([np.full(DEGREE, a), np.linspace(a, b, segments + 1), np.full(DEGREE, b)])
        for a, b in zip(low, high, strict=True)
    ]
    return TensorBasis(*knots)


def _values(knots: Floats, x: Floats, derivative: int) -> Floats:
    """(N, I) the B-splines on ``knots``, or a derivative of each, at x (N,)."""
    splines = BSpline(knots, np.eye(len(knots) - DEGREE - 1), DEGREE)
    return splines.derivative(derivative)(x) if derivative else splines(x)


def _products(knots: Floats, derivative: int) -> Floats:
    """(I, I) integrals of the products of two B-splines' derivatives, by Gauss's rule."""
    nodes, weights = np.polynomial.legendre.leggauss(GAUSS_POINTS)
    ends = np.unique(knots)
    half = np.diff(ends)[:, None] / 2
    x = (ends[:-1, None] + half * (1 + nodes)).ravel()
    values = _values(knots, x, derivative)
    return (values * (half * weights).ravel()[:, None]).T @ values
