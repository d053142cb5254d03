"""One projective matrix for the whole picture: the map of Chen & Kak (paper Sec. I, [16]).

Their 4 x 3 matrix takes a pixel to a point of the light sheet in space.  Expressed in the
sheet's own (x, z) it has three rows, a plane homography of eight parameters.  It knows
neither lens distortion nor the bending of rays at the port.  It has no variants.
"""

from dataclasses import dataclass
from typing import Annotated, Self

import numpy as np
from pydantic import model_validator
from scipy.optimize import least_squares

from lscan.calibration.fields import Matrix, Vector, check_covariance, of_length
from lscan.calibration.maps.polynomial import Scaling, hartley
from lscan.calibration.marks import covered_region
from lscan.calibration.planemap import (
    Estimate,
    MapSolver,
    SolvedMap,
    estimate_of,
    square_root,
    with_lack_of_fit,
)
from lscan.config.rig import OpticsSection
from lscan.errors import BoardNotFound
from lscan.records import BoardReading, Floats

COUNT = 8
IDENTITY = np.array([0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0])  # plane = pixel, both scaled


@dataclass(frozen=True)
class Homography:
    """Eight numbers h that take scaled pixels (a, b) to scaled plane points.

    first = (h0 + h1 a + h2 b) / (1 + h6 a + h7 b), second = (h3 + h4 a + h5 b) / (same).
    The centroid of the control points is (0, 0), so the denominator is 1 there.
    """

    h: Floats

    def denominator(self, scaled: Floats) -> Floats:
        """(N,) of points (N, 2)."""
        return 1 + scaled @ self.h[6:]

    def apply(self, scaled: Floats) -> Floats:
        """(N, 2) plane points of (N, 2)."""
        above = self.h[[0, 3]] + scaled @ self.h[[[1, 4], [2, 5]]]
        return above / self.denominator(scaled)[:, None]

    def by_parameters(self, scaled: Floats) -> Floats:
        """(N, 2, 8) derivatives of the plane points by h."""
        plane = self.apply(scaled)
        derivative = np.zeros((len(scaled), 2, COUNT))
        homogeneous = np.column_stack([np.ones(len(scaled)), scaled])
        derivative[:, 0, 0:3] = derivative[:, 1, 3:6] = homogeneous
        derivative[:, :, 6:8] = -plane[:, :, None] * scaled[:, None, :]
        return derivative / self.denominator(scaled)[:, None, None]

    def by_pixel(self, scaled: Floats) -> Floats:
        """(N, 2, 2) derivatives of the plane points by the scaled pixel."""
        plane = self.apply(scaled)
        direct = self.h[[[1, 2], [4, 5]]]
        turned = direct - plane[:, :, None] * self.h[None, None, 6:]
        return turned / self.denominator(scaled)[:, None, None]


class Projective(SolvedMap):
    """A solved projective map.

    Attributes
    ----------
    pixels : Scaling, of (u, v)
    plane : Scaling, of (x, z) in mm
    h : (8,) array, of :class:`Homography`
    covariance : (8, 8) array, of h
    region : Region, px, where the map holds
    lack_of_fit_mm : (2,) array, mm, of x and of z (calibration/planemap.py)

    References
    ----------
    Chen and Kak (1987), as in Sec. I of the paper; docs/explanation/physics.md, section 9.
    """

    pixels: Scaling
    plane: Scaling
    h: Annotated[Vector, of_length(COUNT)]
    covariance: Matrix

    @model_validator(mode="after")
    def _sizes(self) -> Self:
        check_covariance(self.covariance, COUNT)
        return self

    def estimate(self, image_px: Floats, variance_px2: Floats) -> Estimate:
        """Points of covered pixels.

        Parameters
        ----------
        image_px : (N, 2) array, px, of (u, v)
        variance_px2 : (N,) array, px², of either pixel coordinate
        """
        rows = Homography(self.h).by_parameters(self.pixels.apply(image_px))
        modes = rows @ square_root(self.covariance) * self.plane.scale[:, None]
        return estimate_of(self.places(image_px), self.derivatives(image_px), modes, variance_px2)

    def places(self, image_px: Floats) -> Floats:
        """(N, 2) mm of pixels, wherever they lie.

        Parameters
        ----------
        image_px : (N, 2) array, px, of (u, v)
        """
        return self.plane.undo(Homography(self.h).apply(self.pixels.apply(image_px)))

    def derivatives(self, image_px: Floats) -> Floats:
        """(N, 2, 2) mm per px, derivatives of (x, z) by (u, v).

        Parameters
        ----------
        image_px : (N, 2) array, px, of (u, v)
        """
        scaled = Homography(self.h).by_pixel(self.pixels.apply(image_px))
        return scaled * self.plane.scale[:, None] / self.pixels.scale


class ProjectiveSolver(MapSolver[Projective]):
    """Solves projective maps."""

    family, model, what = "projective", Projective, "projective map"

    def fit(self, reading: BoardReading, variant: str, optics: OpticsSection) -> Projective:
        """The matrix that fits the control points found with the least error in the plane.

        In Hartley's scaling both sides are alike but for a turn, which the first step finds.

        Parameters
        ----------
        reading : BoardReading, px and mm, the marks of one picture
        variant : str, ""
        optics : OpticsSection, not used

        Raises
        ------
        BoardNotFound
            Where four points in general position are missing, or the points found are no picture of
            a plane.
        """
        grid, found = reading.grid, reading.grid.found
        region = covered_region(reading, found)
        pixels, plane = hartley(grid.image_px[found]), hartley(grid.board_mm[found])
        scaled, known = pixels.apply(grid.image_px[found]), plane.apply(grid.board_mm[found])
        h = _least_squares_homography(scaled, known)
        solved = Projective(
            pixels=pixels,
            plane=plane,
            h=h,
            covariance=_covariance(h, scaled, grid.sigma_px[found] / pixels.scale[0]),
            region=region,
            lack_of_fit_mm=np.zeros(2),
        )
        return with_lack_of_fit(solved, reading)


solver = ProjectiveSolver()


def _least_squares_homography(scaled: Floats, known: Floats) -> Floats:
    """(8,) that minimise the sum of squared distances in the plane."""
    if np.linalg.matrix_rank(Homography(IDENTITY).by_parameters(scaled).reshape(-1, COUNT)) < COUNT:
        raise BoardNotFound(
            f"a projective map needs four control points in general position, "
            f"found {len(scaled)} control points"
        )

    def residual(h: Floats) -> Floats:
        return (Homography(h).apply(scaled) - known).ravel()

    def jacobian(h: Floats) -> Floats:
        return Homography(h).by_parameters(scaled).reshape(-1, COUNT)

    answer = least_squares(
        residual, IDENTITY, jac=jacobian, method="lm", xtol=1e-8, ftol=1e-8, gtol=1e-8
    )
    if not (Homography(answer.x).denominator(scaled) > 0).all():
        raise BoardNotFound("the control points found are no picture of a plane")
    # The sum of squares is flat to its rounding where the map is still 1e-8 mm off; steps of Gauss
    # and Newton, which do not look at the sum, close that.
    h = answer.x
    for _ in range(2):
        h = h - np.linalg.lstsq(jacobian(h), residual(h), rcond=None)[0]
    return np.asarray(h, dtype=np.float64)


def _covariance(h: Floats, scaled: Floats, sigma: Floats) -> Floats:
    """(8, 8) from the marks' own uncertainties, carried through the least-squares solution."""
    homography = Homography(h)
    solve = np.linalg.pinv(homography.by_parameters(scaled).reshape(-1, COUNT))
    solve = solve.reshape(COUNT, len(scaled), 2)
    spread = np.einsum("pnc,ncj->pnj", solve, homography.by_pixel(scaled)) * sigma[:, None]
    return np.einsum("pnj,qnj->pq", spread, spread)
