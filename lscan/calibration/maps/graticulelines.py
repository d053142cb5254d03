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
from itertools import zip_longest
from math import comb
from typing import Literal

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline

from lscan.calibration.fields import STRICT, Count, Matrix, Number, Vector, check_covariance
from lscan.calibration.planemap import square_root
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

    @cached_property
    def pieces(self) -> tuple[Floats, Floats]:
        """(P,) where its pieces begin, and (D, P, M) powers from there of what ``basis`` gives."""
        orders, ends = np.arange(self.degree + 1), self.knots[self.degree : -self.degree or None]
        nodes, to_powers, bernstein = _nodes(self.degree)
        if len(ends) == 2 and self.knots[0] == ends[0] and self.knots[-1] == ends[1]:
            by_share, step = bernstein[:, None], ends[1:] - ends[:-1]
        else:
            ends = np.unique(ends)
            step = np.diff(ends)
            by_share = np.tensordot(to_powers, self.basis(ends[:-1] + nodes[:, None] * step), 1)
        return ends[:-1], by_share / (step ** orders[:, None])[..., None]

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
        curves = _polynomials_of_one_order([several[number] for number in numbers], order)
        found.update(zip(numbers, curves, strict=True))
    return [found[number] for number in range(len(several))]


def _polynomials_of_one_order(several: Sequence[CurvePoints], order: int) -> list[Curve]:
    """Polynomials through sets of as many points each: solved together, in a third of the time."""
    x, y, sigma_x, sigma_y = (
        np.stack([getattr(points, field.name) for points in several])
        for field in fields(CurvePoints)
    )
    low, high = x.min(axis=1, keepdims=True), x.max(axis=1, keepdims=True)
    rows, by_share = _bernstein((x - low) / (high - low), order)
    solved = _least_squares(rows, by_share / (high - low)[..., None], y, sigma_x, sigma_y)
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


def _least_squares(
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
    return [_interpolating_spline(points) for points in several]


def _interpolating_spline(points: CurvePoints) -> Curve:
    x, degree = points.x, DEGREE["bspline"]
    order = np.argsort(x)
    knots = make_interp_spline(x[order], points.y[order], k=degree).t
    basis = BSpline(knots, np.eye(len(x)), degree)
    parts = points.y, points.sigma_x, points.sigma_y
    return Curve(degree, knots, *_least_squares(basis(x), basis.derivative()(x), *parts))


# Several curves as one table, in which each of many places is looked up on a curve of its own.


@dataclass(frozen=True)
class CurveTable:
    """Curves of P pieces at most, each piece a polynomial of x less the place where it begins.

    Attributes
    ----------
    curves : tuple of Curve, one or more
    """

    curves: tuple[Curve, ...]

    def look_up(self, curve: Ints, x: Floats) -> tuple[Floats, Floats]:
        """The values of the curves and their slopes, shaped as the arguments together.

        Parameters
        ----------
        curve : array of int, which curve each place is looked up on
        x : array, the places; beyond a curve's ends its end pieces are continued
        """
        piece, step = self._piece(curve, x)
        value, slope = self._values[-1].take(piece), np.zeros(step.shape)
        for coefficients in self._values[-2::-1]:
            slope = slope * step + value
            value = value * step + coefficients.take(piece)
        return value, slope

    def modes(self, curve: Ints, x: Floats) -> Floats:
        """(M, ...) by which one standard deviation of each of M errors displaces the values.

        Parameters
        ----------
        curve, x : array, as :meth:`look_up` takes them
        """
        piece, step = self._piece(curve, x)
        value = self._modes[-1].take(piece, axis=1)
        for coefficients in self._modes[-2::-1]:
            value *= step
            value += coefficients.take(piece, axis=1)
        return value

    def _piece(self, curve: Ints, x: Floats) -> tuple[Ints, Floats]:
        """Number of each place's piece among all, and the place from where that begins."""
        count = self._begin.shape[1]
        piece = curve * count
        if count > 1:
            piece = piece + (x[..., None] >= self._begin[curve, 1:]).sum(axis=-1)
        return piece, x - self._begin.reshape(-1).take(piece)

    @cached_property
    def _begin(self) -> Floats:
        """(C, P) where the pieces begin; inf for those there are not."""
        own = [curve.pieces[0] for curve in self.curves]
        return np.array(list(zip_longest(*own, fillvalue=np.inf))).T

    @cached_property
    def _values(self) -> Floats:
        return self._powers([curve.coefficients[:, None] for curve in self.curves])[:, 0]

    @cached_property
    def _modes(self) -> Floats:
        return self._powers([square_root(curve.covariance) for curve in self.curves])

    def _powers(self, coefficients: list[Floats]) -> Floats:
        """(D, J, C P) powers 0 to D - 1 in each piece of splines of coefficients (M, J)."""
        degree = max(curve.degree for curve in self.curves)
        most = max(own.shape[1] for own in coefficients)
        powers = np.zeros((degree + 1, most, *self._begin.shape))
        for k, (curve, own) in enumerate(zip(self.curves, coefficients, strict=True)):
            part = (curve.pieces[1] @ own).swapaxes(1, 2)
            powers[: len(part), : own.shape[1], k, : part.shape[2]] = part
        return powers.reshape(degree + 1, most, -1)


@lru_cache(maxsize=16)
def _nodes(degree: int) -> tuple[Floats, Floats, Floats]:
    """Shares of a piece, what makes powers of the share of values there, and those of Bernstein."""
    nodes = (np.arange(degree + 1) + 0.5) / (degree + 1)
    to_powers = np.linalg.inv(np.vander(nodes, increasing=True)).astype(np.float64)
    return nodes, to_powers, to_powers @ _bernstein(nodes, degree)[0]
