"""A smooth surface over a projective map: ``spline``.

What a projective matrix (projective.py) leaves of x and of z is what lens and port bend:
little, and gently.  That rest is fitted by a tensor-product cubic B-spline to the control
points and to the marks of the rulers, with a penalty on its third derivatives whose weight
cross-validation chooses (smoothing.py).  The matrix takes the perspective out, which no
penalty on roughness should touch; third derivatives leave every quadratic free, and what
remains of it is bent so little that the penalty costs next to nothing.

Each mark counts by its own uncertainty, propagated to mm by the map's Jacobian.  No variants.
"""

from typing import Annotated, Self

import numpy as np
from pydantic import Field, model_validator

from lscan.calibration.evaluate import Estimate, propagated, separate_modes
from lscan.calibration.maps.polynomial import terms
from lscan.calibration.maps.projective import Projective, solver as projective
from lscan.calibration.maps.scaling import Scaling, box
from lscan.calibration.maps.smoothing import COST, Smooth, smooth
from lscan.calibration.maps.tensorspline import FLAT, ORDER, TensorBasis, even_basis
from lscan.calibration.readings import all_marks, found_marks
from lscan.calibration.region import Region, covered_region
from lscan.calibration.solved import MapSolver, SolvedMap, with_lack_of_fit
from lscan.calibration.stored import Matrix
from lscan.config.rig import OpticsSection
from lscan.errors import BoardNotFound
from lscan.records import BoardReading, Floats

SEGMENTS = 6  # of the longer side; the penalty, not the knots, limits how much the rest bends
LEAST_SIGMA_PX = 1e-3  # no mark is known better, whatever it states
KEPT = 0.98  # of the variance, on the mean over the region, that the modes must account for
LATTICE = 24  # places a side at which that is judged


class Spline(SolvedMap):
    """A solved spline map.

    Attributes
    ----------
    base : Projective, the map beneath
    pixels : Scaling, of (u, v), both alike, for the basis
    basis : TensorBasis, of K functions
    coefficients : (2, K) array, mm, of x and of z beyond the base
    roots : tuple of array, mm, (K, M) of x and of z; root @ root.T stands for the covariance of the
        coefficients (_strongest)
    region : Region, px, where the map holds
    lack_of_fit_mm : (2,) array, mm, of x and of z (solved.py)
    """

    base: Projective
    pixels: Scaling
    basis: TensorBasis
    coefficients: Matrix
    roots: Annotated[tuple[Matrix, ...], Field(min_length=2, max_length=2)]

    @model_validator(mode="after")
    def _sizes(self) -> Self:
        if self.coefficients.shape != (2, self.basis.count):
            raise ValueError(f"coefficients must be two rows of {self.basis.count}")
        if any(len(root) != self.basis.count for root in self.roots):
            raise ValueError(f"each of roots must have {self.basis.count} rows")
        return self

    def estimate(self, image_px: Floats, variance_px2: Floats) -> Estimate:
        """Points of covered pixels; the scatter and bias of the smoothing give the modes.

        Parameters
        ----------
        image_px : (N, 2) array, px, of (u, v)
        variance_px2 : (N,) array, px², of either pixel coordinate
        """
        jacobian, scaled = self.base.derivatives(image_px), self.pixels.apply(image_px)
        rows = self.basis.rows(scaled)
        for axis, by in enumerate(((1, 0), (0, 1))):
            bend = self.basis.rows(scaled, *by) @ self.coefficients.T
            jacobian[:, :, axis] += bend / self.pixels.scale[axis]
        modes = separate_modes(*(rows @ root for root in self.roots))
        places = self.base.places(image_px) + rows @ self.coefficients.T
        return propagated(places, jacobian, modes, variance_px2)


class SplineSolver(MapSolver[Spline]):
    """Solves spline maps."""

    family, model, what = "spline", Spline, "spline map"

    def fit(self, reading: BoardReading, variant: str, optics: OpticsSection) -> Spline:
        """The spline through all marks found, control points and rulers.

        Parameters
        ----------
        reading : BoardReading, px and mm, the marks of one picture
        variant : str, ""
        optics : OpticsSection, not used

        Raises
        ------
        BoardNotFound
            Where the marks do not determine a quadratic surface with some to spare.
        """
        base = projective.solve(reading, "")
        known, image, sigma_px = found_marks(all_marks(reading))
        region = covered_region(reading, reading.grid.found)
        tight = box(image)
        pixels = Scaling(tight.centre, np.full(2, tight.scale.max()))  # both sides alike
        scaled = pixels.apply(image)
        _require_spread(scaled)
        margin = region.margin_px / pixels.scale[0]  # by which a region goes beyond the marks
        basis = even_basis(scaled.min(axis=0) - margin, scaled.max(axis=0) + margin, SEGMENTS)
        mm_per_px = np.sqrt((base.derivatives(image) ** 2).sum(axis=2))
        sigma = np.maximum(sigma_px, LEAST_SIGMA_PX)[:, None] * mm_per_px
        rest, rows, rough = known - base.places(image), basis.rows(scaled), basis.roughness()
        fits = [smooth(rows, rest[:, c], sigma[:, c], rough, FLAT) for c in (0, 1)]
        lattice = basis.rows(pixels.apply(_lattice(region)))
        solved = Spline(
            base=base,
            pixels=pixels,
            basis=basis,
            coefficients=np.array([fit.coefficients for fit in fits]),
            roots=tuple(_strongest(fit, lattice) for fit in fits),
            region=region,
            lack_of_fit_mm=np.zeros(2),
        )
        return with_lack_of_fit(solved, reading)


solver = SplineSolver()


def _require_spread(scaled: Floats) -> None:
    free = np.linalg.matrix_rank(terms(scaled, ORDER - 1)[0])
    if free < FLAT or len(scaled) <= COST * FLAT:
        raise BoardNotFound(
            f"a spline map needs {int(COST * FLAT) + 1} marks that determine a quadratic "
            f"surface, found {len(scaled)} marks"
        )


def _lattice(region: Region) -> Floats:
    """(N, 2) px of places all over the region."""
    low, high = region.outline_px.min(axis=0), region.outline_px.max(axis=0)
    u, v = np.meshgrid(*np.linspace(low, high, LATTICE).T)
    places = np.column_stack([u.ravel(), v.ravel()])
    return places[region.covers(places)]


def _strongest(fit: Smooth, rows: Floats) -> Floats:
    """(K, M) the few independent errors that make up the fit's covariance at places ``rows``.

    They are the principal components of its effect there, each place counting alike, made
    larger by what the left-out ones would have added to the variance on the mean.
    """
    effect = rows @ fit.root
    effect /= np.linalg.norm(effect, axis=1, keepdims=True)
    _, strength, directions = np.linalg.svd(effect, full_matrices=False)
    share = np.cumsum(strength**2) / np.sum(strength**2)
    enough = int(np.searchsorted(share, KEPT)) + 1
    return fit.root @ directions[:enough].T / np.sqrt(share[enough - 1])
