"""Several curves as one table, in which each of many places is looked up on a curve of its own."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import comb, factorial

import numpy as np

from lscan.calibration.maps.lines import Curve
from lscan.records import Floats, Ints


@dataclass(frozen=True)
class CurveTable:
    """C curves of P pieces at most, each piece a polynomial of x less the place where it begins.

    Attributes
    ----------
    begin : (C, P) array, in the unit of x, where the pieces begin; inf for those there are not
    powers : (D, C P) array, coefficients of the powers 0 to D - 1 in each piece
    basis_powers : (D, M, C P) array, the same of the M functions that a curve is a sum of
    covariance : (M, M, C) array, of their coefficients, in the unit of y, squared
    """

    begin: Floats
    powers: Floats
    basis_powers: Floats
    covariance: Floats

    @staticmethod
    def of(curves: Sequence[Curve]) -> "CurveTable":
        """The table of some curves.

        Parameters
        ----------
        curves : sequence of Curve, one or more
        """
        begins = [_begins(curve) for curve in curves]
        most = max(len(curve.coefficients) for curve in curves)
        shape = len(curves), max(map(len, begins))
        begin = np.full(shape, np.inf)
        powers = np.zeros((max(curve.degree for curve in curves) + 1, *shape, most))
        values, covariance = np.zeros(powers.shape[:-1]), np.zeros((len(curves), most, most))
        for k, (curve, places) in enumerate(zip(curves, begins, strict=True)):
            pieces, count = slice(len(places)), len(curve.coefficients)
            begin[k, pieces] = places
            covariance[k, :count, :count] = curve.covariance
            rows = _powers_of(curve, places)
            powers[: curve.degree + 1, k, pieces, :count] = rows
            values[: curve.degree + 1, k, pieces] = rows @ curve.coefficients
        size = shape[0] * shape[1]
        basis = powers.reshape(-1, size, most).transpose(0, 2, 1).copy()
        return CurveTable(begin, values.reshape(-1, size), basis, covariance.T.copy())

    def look_up(self, curve: Ints, x: Floats) -> tuple[Floats, Floats]:
        """The values of the curves and their slopes, shaped as the arguments together.

        Parameters
        ----------
        curve : array of int, which curve each place is looked up on
        x : array, the places; beyond a curve's ends its end pieces are continued
        """
        piece, step = self._piece(curve, x)
        value, slope = self.powers[-1].take(piece), np.zeros(step.shape)
        for coefficients in self.powers[-2::-1]:
            slope = slope * step + value
            value = value * step + coefficients.take(piece)
        return value, slope

    def basis(self, curve: Ints, x: Floats) -> Floats:
        """(..., M) values of the functions that the curves are sums of.

        Parameters
        ----------
        curve, x : array, as :meth:`look_up` takes them
        """
        piece, step = self._piece(curve, x)
        value = self.basis_powers[-1].take(piece, axis=1)
        for coefficients in self.basis_powers[-2::-1]:
            value *= step
            value += coefficients.take(piece, axis=1)
        return np.moveaxis(value, 0, -1)

    def variance(self, curve: Ints, rows: Floats) -> Floats:
        """Variances, shaped as ``curve``, of sums of a curve's coefficients.

        Parameters
        ----------
        curve : array of int, whose coefficients are added
        rows : (..., M) array, the factor of each
        """
        factors, total = np.ascontiguousarray(np.moveaxis(rows, -1, 0)), np.zeros(rows.shape[:-1])
        for i, factor in enumerate(factors):
            moved = factor * self.covariance[i, i].take(curve)
            for j in range(i):
                moved += factors[j] * (2 * self.covariance[i, j]).take(curve)
            total += factor * moved
        return total

    def _piece(self, curve: Ints, x: Floats) -> tuple[Ints, Floats]:
        """Number of each place's piece among all C P, and the place from where that begins."""
        count = self.begin.shape[1]
        piece = curve * count
        if count > 1:
            piece = piece + (x[..., None] >= self.begin[curve, 1:]).sum(axis=-1)
        return piece, x - self.begin.reshape(-1).take(piece)


def _begins(curve: Curve) -> Floats:
    """Where the pieces of a curve begin."""
    if _is_whole(curve):
        return curve.knots[:1]
    return np.unique(curve.knots[curve.degree : -curve.degree or None])[:-1]


def _powers_of(curve: Curve, places: Floats) -> Floats:
    """(degree + 1, P, M) coefficients of powers of the M functions in the pieces from P places."""
    if _is_whole(curve):
        step = 1 / (curve.knots[-1] - curve.knots[0])
        scale = step ** np.arange(curve.degree + 1)
        return (_bernstein_powers(curve.degree) * scale[:, None])[:, None]
    each = range(curve.degree + 1)
    return np.stack([curve.basis.derivative(k)(places) / factorial(k) for k in each])


def _is_whole(curve: Curve) -> bool:
    """Whether a curve is one polynomial."""
    knots, last = curve.knots, curve.degree
    is_single = len(curve.coefficients) == last + 1
    return is_single and bool(knots[0] == knots[last] and knots[-1] == knots[-1 - last])


@lru_cache(maxsize=16)
def _bernstein_powers(degree: int) -> Floats:
    """(degree + 1, degree + 1) coefficients of t^p, one row each, in Bernstein's polynomials."""
    powers = np.zeros((degree + 1, degree + 1))
    for k in range(degree + 1):
        for p in range(k, degree + 1):
            powers[p, k] = (-1) ** (p - k) * comb(degree, k) * comb(degree - k, p - k)
    powers.flags.writeable = False
    return powers
