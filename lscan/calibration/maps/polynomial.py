"""Two polynomials for the whole picture (paper Sec. I, eqs. (1) and (2), [17]).

The variant is the order N, 1 to 9: x and z are polynomials in u and v with all terms
u^i v^j, i + j <= N, fitted to all control points found by least squares.  The rulers are not
used, as in the paper; they judge the lack of fit.  Instead of powers of pixels, products of
Legendre polynomials of coordinates scaled to -1 to 1 are fitted: they span the same
polynomials, so the map is that of eqs. (1) and (2), and it keeps its digits at order 9.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, Self

import numpy as np
from numpy.polynomial import legendre
from pydantic import Field, model_validator

from lscan.calibration.fields import STRICT, Matrix, Place, check_covariance
from lscan.calibration.marks import covered_region
from lscan.calibration.planemap import (
    Estimate,
    MapSolver,
    SolvedMap,
    estimate_of,
    separate_modes,
    square_root,
    with_lack_of_fit,
)
from lscan.config.rig import OpticsSection
from lscan.errors import BoardNotFound, InputError
from lscan.records import BoardReading, Floats

# Shifting and scaling of coordinates, so that least squares stays well conditioned.


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


# Two polynomials for the whole picture (paper Sec. I, eqs. (1) and (2), [17]).


ORDERS = range(1, 10)
TERMS = [(order + 1) * (order + 2) // 2 for order in ORDERS]


class Polynomial(SolvedMap):
    """A solved polynomial map of order N with K = (N + 1)(N + 2) / 2 terms.

    Attributes
    ----------
    pixels : Scaling, of (u, v) to -1 to 1
    coefficients : (2, K) array, mm, of x and of z, the C_ij and D_ij of eq. (1) for Legendre
        products, i varying slowest
    covariances : tuple of array, mm², (K, K) of either
    region : Region, px, where the map holds
    lack_of_fit_mm : (2,) array, mm, of x and of z (calibration/planemap.py)

    References
    ----------
    Sec. I and eqs. (1) and (2) of the paper.
    """

    pixels: Scaling
    coefficients: Matrix
    covariances: Annotated[tuple[Matrix, ...], Field(min_length=2, max_length=2)]

    @model_validator(mode="after")
    def _sizes(self) -> Self:
        for covariance in self.covariances:
            check_covariance(covariance, self.coefficients.shape[1])
        return self

    def estimate(self, image_px: Floats, variance_px2: Floats) -> Estimate:
        """Points of covered pixels; those of x and those of z have no mode in common.

        Parameters
        ----------
        image_px : (N, 2) array, px, of (u, v)
        variance_px2 : (N,) array, px², of either pixel coordinate
        """
        order = ORDERS[TERMS.index(self.coefficients.shape[1])]
        rows, by_u, by_v = terms(self.pixels.apply(image_px), order)
        jacobian = _jacobian(by_u, by_v, self.coefficients, self.pixels)
        modes = separate_modes(*(rows @ root for root in self._roots))
        return estimate_of(rows @ self.coefficients.T, jacobian, modes, variance_px2)

    @cached_property
    def _roots(self) -> tuple[Floats, Floats]:
        of_x, of_z = self.covariances
        return square_root(of_x), square_root(of_z)


class PolynomialSolver(MapSolver[Polynomial]):
    """Solves polynomial maps; the variant is the order."""

    family, model, what = "polynomial", Polynomial, "polynomial map"
    variants = tuple(map(str, ORDERS))

    def fit(self, reading: BoardReading, variant: str, optics: OpticsSection) -> Polynomial:
        """The polynomials of eq. (1) that solve eq. (2) for the control points found.

        Parameters
        ----------
        reading : BoardReading, px and mm, the marks of one picture
        variant : str, the order, "1" to "9"
        optics : OpticsSection, not used

        Raises
        ------
        BoardNotFound
            Where the control points found do not determine the terms.

        References
        ----------
        Sec. I and eqs. (1) and (2) of the paper.
        """
        grid, found = reading.grid, reading.grid.found
        region = covered_region(reading, found)
        pixels = box(grid.image_px[found])
        rows, by_u, by_v = terms(pixels.apply(grid.image_px[found]), int(variant))
        if np.linalg.matrix_rank(rows) < rows.shape[1]:
            raise BoardNotFound(
                f"a polynomial map of order {variant} has {rows.shape[1]} terms, which the "
                f"{len(rows)} control points found do not determine"
            )
        solve = np.linalg.pinv(rows)
        coefficients = (solve @ grid.board_mm[found]).T
        jacobian = _jacobian(by_u, by_v, coefficients, pixels)
        noise = grid.sigma_px[found, None] ** 2 * (jacobian**2).sum(axis=2)
        solved = Polynomial(
            pixels=pixels,
            coefficients=coefficients,
            covariances=tuple((solve * noise[:, c]) @ solve.T for c in (0, 1)),
            region=region,
            lack_of_fit_mm=np.zeros(2),
        )
        return with_lack_of_fit(solved, reading)

    def restore(self, variant: str, parameters: dict[str, Any]) -> Polynomial:
        """The map that parameters came from.

        Parameters
        ----------
        variant : str, the order, "1" to "9"
        parameters : dict, as ``Polynomial.parameters`` gave them

        Raises
        ------
        InputError
            Where they do not fit.
        """
        solved = super().restore(variant, parameters)
        shape = (2, TERMS[int(variant) - 1])
        if solved.coefficients.shape != shape:
            what, where = "bad shape", "parameters.coefficients"
            raise InputError(what, where=where, value=solved.coefficients.shape, allowed=shape)
        return solved


solver = PolynomialSolver()


def _jacobian(by_u: Floats, by_v: Floats, coefficients: Floats, pixels: Scaling) -> Floats:
    """(N, 2, 2) mm per px of x and of z, by u and by v."""
    return np.stack([by_u @ coefficients.T, by_v @ coefficients.T], axis=2) / pixels.scale


def terms(scaled: Floats, order: int) -> tuple[Floats, Floats, Floats]:
    """All terms L_i(a) L_j(b), i + j <= order, of scaled pixels, and their derivatives.

    Parameters
    ----------
    scaled : (N, 2) array, (a, b), from -1 to 1
    order : int, of the polynomial

    Returns
    -------
    tuple of array
        (N, K) values, (N, K) derivatives by a, (N, K) derivatives by b; i varies slowest.

    References
    ----------
    Eq. (1) of the paper, its powers replaced by Legendre polynomials.
    """
    i, j = np.indices((order + 1, order + 1)).reshape(2, -1)
    i, j = i[i + j <= order], j[i + j <= order]
    a, b = (legendre.legvander(scaled[:, c], order) for c in (0, 1))
    derive = legendre.legder(np.eye(order + 1))
    by_a, by_b = (legendre.legvander(scaled[:, c], order - 1) @ derive for c in (0, 1))
    return a[:, i] * b[:, j], by_a[:, i] * b[:, j], a[:, i] * by_b[:, j]
