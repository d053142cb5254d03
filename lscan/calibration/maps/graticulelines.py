"""Fitted lines: the longitude and latitude lines of the graticule (paper Sec. III.2, Fig. 13).

A line is a curve ``across = f(along)`` between the two pixel coordinates: along = u and
across = v for a latitude line Y = Y(X), the other way round for a longitude line X = X(Y).
All three fits of the paper are B-splines: a polynomial of order k is a spline of degree k
without inner knots, and the least-squares fit in that basis is the paper's rms fit, only
better conditioned than in powers of a pixel coordinate.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property, lru_cache
from math import comb, factorial
from typing import Literal

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline

from lscan.calibration.planemap import STRICT, Count, Matrix, Number, Vector, check_covariance
from lscan.records import Floats, Ints, Marks

Fit = Literal["1", "2", "bspline"]
DEGREE: dict[Fit, int] = {"1": 1, "2": 2, "bspline": 3}


@dataclass(frozen=True)
class Curve:
    """A spline y = f(x) of M coefficients, with their covariance.

    Outside the knots the end pieces are continued.

    Attributes
    ----------
    degree : int, of the pieces
    knots : (M + degree + 1,) array, in the unit of x
    coefficients : (M,) array, in the unit of y
    covariance : (M, M) array, in the unit of y, squared
    """

    __pydantic_config__ = STRICT
    degree: Count
    knots: Vector
    coefficients: Vector
    covariance: Matrix

    def __post_init__(self) -> None:
        """Raise ValueError where the parts do not make a spline."""
        if self.degree < 0 or len(self.knots) != len(self.coefficients) + self.degree + 1:
            raise ValueError("a spline has degree + 1 more knots than coefficients")
        if len(self.coefficients) <= self.degree or np.any(np.diff(self.knots) < 0):
            raise ValueError("knots must not fall, and coefficients must outnumber the degree")
        if self.knots[self.degree] >= self.knots[-self.degree - 1]:
            raise ValueError("knots must span a stretch")
        check_covariance(self.covariance, len(self.coefficients))

    @cached_property
    def _spline(self) -> BSpline:
        return BSpline(self.knots, self.coefficients, self.degree)

    @cached_property
    def slope(self) -> BSpline:
        """df/dx, a function of x."""
        return self._spline.derivative()

    @cached_property
    def basis(self) -> BSpline:
        """Gives (N, M) of x (N,) so that ``basis(x) @ coefficients`` is f."""
        return BSpline(self.knots, np.eye(len(self.coefficients)), self.degree)

    def __call__(self, x: Floats) -> Floats:
        """f at x, same shape."""
        return self._spline(x)


@dataclass(frozen=True)
class CurvePoints:
    """N points that a curve y = f(x) is fitted to.

    Attributes
    ----------
    x, y : (N,) array
    sigma_x, sigma_y : (N,) array, standard uncertainties
    """

    x: Floats
    y: Floats
    sigma_x: Floats
    sigma_y: Floats


def fit_polynomials(several: Sequence[CurvePoints], orders: Sequence[int]) -> list[Curve]:
    """The least-squares polynomials through several sets of points.

    The uncertainties give the covariance (an error in x counts as one of slope times that in y) and
    do not weigh the fit: the paper's is the plain rms fit.

    Parameters
    ----------
    several : sequence of CurvePoints, each of order + 1 different x or more
    orders : sequence of int, of their polynomials

    References
    ----------
    Sec. III.2 of the paper.
    """
    alike: dict[tuple[int, int], list[int]] = {}
    for number, (points, order) in enumerate(zip(several, orders, strict=True)):
        alike.setdefault((order, len(points.x)), []).append(number)
    found: dict[int, Curve] = {}
    for (order, _), numbers in alike.items():
        curves = _of_one_order([several[number] for number in numbers], order)
        found.update(zip(numbers, curves, strict=True))
    return [found[number] for number in range(len(several))]


def _of_one_order(several: Sequence[CurvePoints], order: int) -> list[Curve]:
    """Polynomials through sets of as many points each: solved together, in a third of the time."""
    x, y, sigma_x, sigma_y = (
        np.stack([getattr(points, field.name) for points in several])
        for field in fields(CurvePoints)
    )
    low, high = x.min(axis=1, keepdims=True), x.max(axis=1, keepdims=True)
    rows, by_share = _bernstein((x - low) / (high - low), order)
    solved = _solved(rows, by_share / (high - low)[..., None], y, sigma_x, sigma_y)
    knots = np.repeat(np.hstack([low, high]), order + 1, axis=1)
    return [Curve(order, *parts) for parts in zip(knots, *solved, strict=True)]


def _bernstein(share: Floats, order: int) -> tuple[Floats, Floats]:
    """(..., order + 1) B-splines without inner knots at shares of the way, and their slopes.

    They are the polynomials of Bernstein: scipy's of any spline take ten times as long.
    """
    numbers = np.arange(order + 1)
    upwards, downwards = (t[..., None] ** numbers for t in (share, 1 - share))
    rows = upwards * downwards[..., ::-1] * [comb(order, k) for k in numbers]
    lower = upwards[..., :-1] * downwards[..., -2::-1]
    lower *= [comb(order - 1, k) for k in numbers[:-1]]
    by_share = np.zeros_like(rows)
    by_share[..., 1:] = order * lower
    by_share[..., :-1] -= order * lower
    return rows, by_share


def _solved(
    rows: Floats, slopes: Floats, y: Floats, sigma_x: Floats, sigma_y: Floats
) -> tuple[Floats, Floats]:
    """Coefficients (..., M) of least squares and their covariance (..., M, M).

    rows, slopes: (..., N, M), of the functions that the curve is a sum of.
    """
    solve = np.linalg.pinv(rows)  # (..., M, N): coefficients are linear in y
    coefficients = (solve @ y[..., None])[..., 0]
    variance = sigma_y**2 + ((slopes @ coefficients[..., None])[..., 0] * sigma_x) ** 2
    return coefficients, (solve * variance[..., None, :]) @ np.swapaxes(solve, -1, -2)


@dataclass(frozen=True)
class GridLine:
    """A longitude or latitude line.

    Attributes
    ----------
    at_mm : float, mm, its place on the board: x of a longitude line, z of a latitude line
    curve : Curve, across px as a function of along px
    first_px, last_px : float, px, along: where its outermost marks lie
    """

    __pydantic_config__ = STRICT
    at_mm: Number
    curve: Curve
    first_px: Number
    last_px: Number


def fit_lines(several: Sequence[Marks], along: int, fit: Fit) -> list[GridLine | None]:
    """The lines through the marks that were found, None where they are too few for the fit.

    Parameters
    ----------
    several : sequence of Marks, px and mm, each of one grid row or one grid column
    along : int, 0 (u) for grid rows, 1 (v) for grid columns
    fit : str, "1", "2" or "bspline"
    """
    lines: list[GridLine | None] = [None] * len(several)
    enough: dict[int, CurvePoints] = {}
    for number, marks in enumerate(several):
        found = marks.found
        x, y = marks.image_px[found, along], marks.image_px[found, 1 - along]
        if len(set(x.tolist())) > DEGREE[fit]:
            sigma = marks.sigma_px[found]
            enough[number] = CurvePoints(x, y, sigma, sigma)
    curves = fit_curves(list(enough.values()), fit)
    for (number, points), curve in zip(enough.items(), curves, strict=True):
        at_mm = float(several[number].board_mm[:, 1 - along].mean())
        lines[number] = GridLine(at_mm, curve, float(points.x.min()), float(points.x.max()))
    return lines


def fit_curves(several: Sequence[CurvePoints], fit: Fit) -> list[Curve]:
    """The curves y = f(x) of a kind.

    The B-spline passes through all points, four or more; the second and the last but one are no
    knots ("not a knot").

    Parameters
    ----------
    several : sequence of CurvePoints, px
    fit : str, "1", "2" or "bspline"

    References
    ----------
    Sec. III.2 of the paper.
    """
    if fit != "bspline":
        return fit_polynomials(several, [DEGREE[fit]] * len(several))
    return [_interpolating(points) for points in several]


def _interpolating(points: CurvePoints) -> Curve:
    x, degree = points.x, DEGREE["bspline"]
    order = np.argsort(x)
    knots = make_interp_spline(x[order], points.y[order], k=degree).t
    basis = BSpline(knots, np.eye(len(x)), degree)
    parts = points.y, points.sigma_x, points.sigma_y
    return Curve(degree, knots, *_solved(basis(x), basis.derivative()(x), *parts))


# Several curves as one table, in which each of many places is looked up on a curve of its own.


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
