"""Fitted lines: the longitude and latitude lines of the graticule (paper Sec. III.2, Fig. 13).

A line is a curve ``across = f(along)`` between the two pixel coordinates: along = u and
across = v for a latitude line Y = Y(X), the other way round for a longitude line X = X(Y).
All three fits of the paper are B-splines: a polynomial of order k is a spline of degree k
without inner knots, and the least-squares fit in that basis is the paper's rms fit, only
better conditioned than in powers of a pixel coordinate.
"""

from dataclasses import dataclass
from functools import cached_property
from math import comb
from typing import Literal

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline

from lscan.calibration.stored import STRICT, Count, Matrix, Number, Vector, check_covariance
from lscan.records import Floats, Marks

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


def fit_polynomial(x: Floats, y: Floats, sigma_x: Floats, sigma_y: Floats, order: int) -> Curve:
    """The least-squares polynomial through points.

    Parameters
    ----------
    x, y : (N,) array, of order + 1 different x or more
    sigma_x, sigma_y : (N,) array, standard uncertainties; they give the covariance (an error in x
        counts as one of slope times that in y) and do not weigh the fit: the paper's is the plain
        rms fit
    order : int, of the polynomial

    References
    ----------
    Sec. III.2 of the paper.
    """
    low, high = ends = float(x.min()), float(x.max())
    rows, by_share = _bernstein((x - low) / (high - low), order)
    solved = _solved(rows, by_share / (high - low), y, sigma_x, sigma_y)
    return Curve(order, np.repeat(ends, order + 1), *solved)


def _bernstein(share: Floats, order: int) -> tuple[Floats, Floats]:
    """(N, order + 1) B-splines without inner knots at shares (N,) of the way, and their slopes.

    They are the polynomials of Bernstein: scipy's of any spline take ten times as long.
    """
    upwards, downwards = (np.vander(t, order + 1, increasing=True) for t in (share, 1 - share))
    numbers = np.arange(order)
    rows = upwards * downwards[:, ::-1] * [comb(order, k) for k in range(order + 1)]
    lower = upwards[:, :-1] * downwards[:, -2::-1] * [comb(order - 1, k) for k in numbers]
    by_share = np.zeros_like(rows)
    by_share[:, 1:] = order * lower
    by_share[:, :-1] -= order * lower
    return rows, by_share


def _solved(
    rows: Floats, slopes: Floats, y: Floats, sigma_x: Floats, sigma_y: Floats
) -> tuple[Floats, Floats]:
    """Coefficients of least squares and their covariance.

    rows, slopes: (N, M), of the functions that the curve is a sum of.
    """
    solve = np.linalg.pinv(rows)  # (M, N): coefficients are linear in y
    coefficients = solve @ y
    variance = sigma_y**2 + (slopes @ coefficients * sigma_x) ** 2
    return coefficients, (solve * variance) @ solve.T


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


def fit_line(marks: Marks, along: int, fit: Fit) -> GridLine | None:
    """The line through the marks that were found, None where they are too few for the fit.

    Parameters
    ----------
    marks : Marks, px and mm, of one grid row or one grid column
    along : int, 0 (u) for a grid row, 1 (v) for a grid column
    fit : str, "1", "2" or "bspline"
    """
    found = marks.found
    x, y = marks.image_px[found, along], marks.image_px[found, 1 - along]
    if len(np.unique(x)) <= DEGREE[fit]:
        return None
    at_mm = float(marks.board_mm[:, 1 - along].mean())
    return GridLine(
        at_mm, fit_curve(x, y, marks.sigma_px[found], fit), float(x.min()), float(x.max())
    )


def fit_curve(x: Floats, y: Floats, sigma_px: Floats, fit: Fit) -> Curve:
    """The curve y = f(x) of a kind.

    The B-spline passes through all points, four or more; the second and the last but one are no
    knots ("not a knot").

    Parameters
    ----------
    x, y : (N,) array, px
    sigma_px : (N,) array, px, standard uncertainty of either
    fit : str, "1", "2" or "bspline"

    References
    ----------
    Sec. III.2 of the paper.
    """
    if fit != "bspline":
        return fit_polynomial(x, y, sigma_px, sigma_px, DEGREE[fit])
    order = np.argsort(x)
    knots = make_interp_spline(x[order], y[order], k=DEGREE[fit]).t
    basis = BSpline(knots, np.eye(len(x)), DEGREE[fit])
    solved = _solved(basis(x), basis.derivative()(x), y, sigma_px, sigma_px)
    return Curve(DEGREE[fit], knots, *solved)
