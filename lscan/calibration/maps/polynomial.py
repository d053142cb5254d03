"""Two polynomials for the whole picture (paper Sec. I, eqs. (1) and (2), [17]).

The variant is the order N, 1 to 9: x and z are polynomials in u and v with all terms
u^i v^j, i + j <= N, fitted to all control points found by least squares.  The rulers are not
used, as in the paper; they judge the lack of fit.  Instead of powers of pixels, products of
Legendre polynomials of coordinates scaled to -1 to 1 are fitted: they span the same
polynomials, so the map is that of eqs. (1) and (2), and it keeps its digits at order 9.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Any, Self

import numpy as np
from numpy.polynomial import legendre
from pydantic import Field, model_validator

from lscan.calibration.api import NOTHING_KNOWN
from lscan.calibration.evaluate import (
    Estimate,
    lack_of_fit_mm,
    separate_modes,
    square_root,
    to_points,
)
from lscan.calibration.maps.scaling import Scaling, box
from lscan.calibration.region import Region, covered_region
from lscan.calibration.stored import Matrix, Pair, check_covariance
from lscan.config.documents import Strict, check
from lscan.config.rig import OpticsSection
from lscan.errors import BoardNotFound, InputError
from lscan.records import BoardReading, Floats, PlanePoints

ORDERS = range(1, 10)


class PolynomialParameters(Strict):
    """What a polynomial map is made of, as a file holds it."""

    pixels: Scaling
    coefficients: Matrix
    covariances: Annotated[tuple[Matrix, ...], Field(min_length=2, max_length=2)]
    region: Region
    lack_of_fit_mm: Pair

    @model_validator(mode="after")
    def _sizes(self) -> Self:
        for covariance in self.covariances:
            check_covariance(covariance, self.coefficients.shape[1])
        return self


@dataclass(frozen=True)
class Polynomial:
    """A solved polynomial map of ``order`` N with K = (N + 1)(N + 2) / 2 terms.

    pixels: scales (u, v) to -1 to 1.  coefficients: (2, K) mm of x and of z, the C_ij and
    D_ij of eq. (1) for Legendre products, i varying slowest.  covariances: (K, K) mm^2 of
    either.  lack_of_fit_mm: (2,) of x and of z (evaluate.py).
    """

    order: int
    pixels: Scaling
    coefficients: Floats
    covariances: tuple[Floats, ...]
    region: Region
    lack_of_fit_mm: Floats

    @property
    def name(self) -> str:
        """Full name, solver and order."""
        return f"polynomial-{self.order}"

    def to_plane(self, image_px: Floats, sigma_px: Floats | None = None) -> PlanePoints:
        """Points in the sheet, (N, 2) mm, of the pixels (N, 2), as api.PlaneMap promises.

        sigma_mm combines the pixel's uncertainty, the covariance of the coefficients and
        the map's mean lack of fit; the coefficients are the modes, those of x and those of
        z apart.
        """
        return to_points(self, image_px, sigma_px)

    def estimate(self, image_px: Floats, variance_px2: Floats) -> Estimate:
        """Points of covered pixels."""
        rows, by_u, by_v = terms(self.pixels.apply(image_px), self.order)
        slope_u = by_u @ self.coefficients.T / self.pixels.scale[0]
        slope_v = by_v @ self.coefficients.T / self.pixels.scale[1]
        noise = variance_px2[:, None] * (slope_u**2 + slope_v**2)
        modes = separate_modes(*(rows @ root for root in self._roots))
        return Estimate(rows @ self.coefficients.T, noise + (modes**2).sum(axis=2), modes)

    @cached_property
    def _roots(self) -> tuple[Floats, Floats]:
        of_x, of_z = self.covariances
        return square_root(of_x), square_root(of_z)

    def parameters(self) -> dict[str, Any]:
        """The coefficients, their covariances, the region and the lack of fit, as JSON types."""
        return PolynomialParameters(
            pixels=self.pixels,
            coefficients=self.coefficients,
            covariances=self.covariances,
            region=self.region,
            lack_of_fit_mm=self.lack_of_fit_mm,
        ).model_dump(mode="json")


class PolynomialSolver:
    """Solves polynomial maps; the variant is the order."""

    def check_variant(self, variant: str) -> None:
        """InputError for a variant that there is not; nothing is solved."""
        _order(variant)

    def solve(
        self, reading: BoardReading, variant: str, optics: OpticsSection = NOTHING_KNOWN
    ) -> Polynomial:
        """The polynomials of eq. (1) that solve eq. (2) for the control points found.

        Raises InputError for an unknown order, BoardNotFound where the points found do not
        determine all terms.
        """
        order = _order(variant)
        grid, found = reading.grid, reading.grid.found
        region = covered_region(reading, found)
        pixels = box(grid.image_px[found])
        rows, by_u, by_v = terms(pixels.apply(grid.image_px[found]), order)
        if np.linalg.matrix_rank(rows) < rows.shape[1]:
            raise BoardNotFound(
                f"a polynomial map of order {order} has {rows.shape[1]} terms, which the "
                f"{len(rows)} control points found do not determine"
            )
        solve = np.linalg.pinv(rows)
        coefficients = (solve @ grid.board_mm[found]).T
        slope_u = by_u @ coefficients.T / pixels.scale[0]
        slope_v = by_v @ coefficients.T / pixels.scale[1]
        noise = grid.sigma_px[found, None] ** 2 * (slope_u**2 + slope_v**2)
        covariances = tuple((solve * noise[:, c]) @ solve.T for c in (0, 1))
        solved = Polynomial(order, pixels, coefficients, covariances, region, np.zeros(2))
        return replace(solved, lack_of_fit_mm=lack_of_fit_mm(solved, reading))

    def restore(self, variant: str, parameters: dict[str, Any]) -> Polynomial:
        """The map that ``parameters`` came from; InputError where they do not fit."""
        order = _order(variant)
        read = check(PolynomialParameters, parameters, where=None, prefix="parameters")
        count = (order + 1) * (order + 2) // 2
        if read.coefficients.shape != (2, count):
            raise InputError(
                "bad shape",
                where="parameters.coefficients",
                value=read.coefficients.shape,
                allowed=(2, count),
            )
        return Polynomial(
            order,
            read.pixels,
            read.coefficients,
            read.covariances,
            read.region,
            read.lack_of_fit_mm,
        )


solver = PolynomialSolver()


def _order(variant: str) -> int:
    allowed = {str(order): order for order in ORDERS}
    if variant not in allowed:
        raise InputError(
            "no such polynomial map",
            where="plane map",
            value=f"polynomial-{variant}",
            allowed="polynomial-1 to polynomial-9",
        )
    return allowed[variant]


def terms(scaled: Floats, order: int) -> tuple[Floats, Floats, Floats]:
    """All terms L_i(a) L_j(b), i + j <= order, of scaled pixels (N, 2), and their derivatives.

    Returns (N, K) values, (N, K) derivatives by a, (N, K) derivatives by b; i varies slowest.
    """
    i, j = np.indices((order + 1, order + 1)).reshape(2, -1)
    i, j = i[i + j <= order], j[i + j <= order]
    a, b = (legendre.legvander(scaled[:, c], order) for c in (0, 1))
    derive = legendre.legder(np.eye(order + 1))
    by_a, by_b = (legendre.legvander(scaled[:, c], order - 1) @ derive for c in (0, 1))
    return a[:, i] * b[:, j], by_a[:, i] * b[:, j], a[:, i] * by_b[:, j]
