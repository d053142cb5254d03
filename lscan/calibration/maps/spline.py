"""A smooth surface over a projective map: ``spline``.

What a projective matrix (projective.py) leaves of x and of z is what lens and port bend:
little, and gently.  That rest is fitted by a tensor-product cubic B-spline to the control
points and to the marks of the rulers, with a penalty on its third derivatives whose weight
cross-validation chooses (smoothing.py).  The matrix takes the perspective out, which no
penalty on roughness should touch; third derivatives leave every quadratic free, and what
remains of it is bent so little that the penalty costs next to nothing.

Each mark counts by its own uncertainty, carried to mm by the matrix's slope.  No variants.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Any, Self

import numpy as np
from pydantic import Field, model_validator

from lscan.calibration.api import NOTHING_KNOWN
from lscan.calibration.evaluate import (
    Estimate,
    found_marks,
    lack_of_fit_mm,
    separate_modes,
    to_points,
)
from lscan.calibration.maps.polynomial import terms
from lscan.calibration.maps.projective import Projective
from lscan.calibration.maps.projective import solver as projective
from lscan.calibration.maps.scaling import Scaling, box
from lscan.calibration.maps.smoothing import COST, Smooth, smooth
from lscan.calibration.maps.tensorspline import FLAT, ORDER, TensorBasis, even_basis
from lscan.calibration.region import Region, covered_region
from lscan.calibration.stored import Matrix, Pair
from lscan.config.documents import Strict, check
from lscan.config.rig import OpticsSection
from lscan.errors import BoardNotFound, InputError
from lscan.records import BoardReading, Floats, PlanePoints

SEGMENTS = 6  # of the longer side; the penalty, not the knots, says how much the rest bends
LEAST_SIGMA_PX = 1e-3  # no mark is known better, whatever it states
KEPT = 0.98  # of the variance, on the mean over the region, that the modes must account for
LATTICE = 24  # places a side at which that is judged


class SplineParameters(Strict):
    """What a spline map is made of, as a file holds it."""

    base: dict[str, Any]
    pixels: Scaling
    basis: TensorBasis
    coefficients: Matrix
    roots: Annotated[tuple[Matrix, ...], Field(min_length=2, max_length=2)]
    region: Region
    lack_of_fit_mm: Pair

    @model_validator(mode="after")
    def _sizes(self) -> Self:
        if self.coefficients.shape != (2, self.basis.count):
            raise ValueError(f"coefficients must be two rows of {self.basis.count}")
        if any(len(root) != self.basis.count for root in self.roots):
            raise ValueError(f"each of roots must have {self.basis.count} rows")
        return self


@dataclass(frozen=True)
class Spline:
    """A solved spline map.

    base: the projective map beneath.  pixels: scales (u, v), both alike, for the basis.
    coefficients: (2, K) mm of x and of z beyond the base.  roots: of x and of z, (K, M) each,
    mm; root @ root.T stands for the covariance of the coefficients (_strongest).
    lack_of_fit_mm: (2,) of x and of z (evaluate.py).
    """

    base: Projective
    pixels: Scaling
    basis: TensorBasis
    coefficients: Floats
    roots: tuple[Floats, ...]
    region: Region
    lack_of_fit_mm: Floats
    name: str = "spline"

    def to_plane(self, image_px: Floats, sigma_px: Floats | None = None) -> PlanePoints:
        """Points in the sheet, (N, 2) mm, of the pixels (N, 2), as api.PlaneMap promises.

        sigma_mm combines the pixel's uncertainty, the scatter and bias of the smoothing,
        which give the modes, and the map's mean lack of fit.
        """
        return to_points(self, image_px, sigma_px)

    def estimate(self, image_px: Floats, variance_px2: Floats) -> Estimate:
        """Points of covered pixels."""
        base, slope = self.base.places(image_px), self.base.slopes(image_px)
        scaled = self.pixels.apply(image_px)
        rows = self.basis.rows(scaled)
        for axis, by in enumerate(((1, 0), (0, 1))):
            bend = self.basis.rows(scaled, *by) @ self.coefficients.T
            slope[:, :, axis] += bend / self.pixels.scale[axis]
        noise = variance_px2[:, None] * (slope**2).sum(axis=2)
        modes = separate_modes(*(rows @ root for root in self.roots))
        places = base + rows @ self.coefficients.T
        return Estimate(places, noise + (modes**2).sum(axis=2), modes)

    def parameters(self) -> dict[str, Any]:
        """The base, the coefficients, their roots, the region and the lack of fit, as JSON."""
        return SplineParameters(
            base=self.base.parameters(),
            pixels=self.pixels,
            basis=self.basis,
            coefficients=self.coefficients,
            roots=self.roots,
            region=self.region,
            lack_of_fit_mm=self.lack_of_fit_mm,
        ).model_dump(mode="json")


class SplineSolver:
    """Solves spline maps."""

    def check_variant(self, variant: str) -> None:
        """InputError for a variant that there is not; nothing is solved."""
        if variant:
            raise InputError(
                "no such spline map", where="plane map", value=f"spline-{variant}", allowed="spline"
            )

    def solve(
        self, reading: BoardReading, variant: str, optics: OpticsSection = NOTHING_KNOWN
    ) -> Spline:
        """The spline through all marks found, control points and rulers.

        Raises InputError for any variant, BoardNotFound where the marks do not determine a
        quadratic surface with some to spare.
        """
        self.check_variant(variant)
        base = projective.solve(reading, "")
        grid, rulers = reading.grid, [ruler.marks for ruler in reading.rulers]
        known, image, sigma_px = found_marks([grid, *rulers])
        region = covered_region(reading, grid.found)
        pixels = _even_scaling(image)
        scaled = pixels.apply(image)
        _require_spread(scaled)
        basis = _basis(scaled, region.margin_px / pixels.scale[0])
        slope = np.sqrt((base.slopes(image) ** 2).sum(axis=2))
        sigma = np.maximum(sigma_px, LEAST_SIGMA_PX)[:, None] * slope
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
        return replace(solved, lack_of_fit_mm=lack_of_fit_mm(solved, reading))

    def restore(self, variant: str, parameters: dict[str, Any]) -> Spline:
        """The map that ``parameters`` came from; InputError where they do not fit."""
        self.check_variant(variant)
        read = check(SplineParameters, parameters, where=None, prefix="parameters")
        return Spline(
            base=projective.restore("", read.base),
            pixels=read.pixels,
            basis=read.basis,
            coefficients=read.coefficients,
            roots=read.roots,
            region=read.region,
            lack_of_fit_mm=read.lack_of_fit_mm,
        )


solver = SplineSolver()


def _even_scaling(image_px: Floats) -> Scaling:
    """The longer side of the points' bounding box from -1 to 1, the other to the same scale."""
    tight = box(image_px)
    return Scaling(tight.centre, np.full(2, tight.scale.max()))


def _require_spread(scaled: Floats) -> None:
    free = np.linalg.matrix_rank(terms(scaled, ORDER - 1)[0])
    if free < FLAT or len(scaled) <= COST * FLAT:
        raise BoardNotFound(
            f"a spline map needs {int(COST * FLAT) + 1} marks that determine a quadratic "
            f"surface, found {len(scaled)} marks"
        )


def _basis(scaled: Floats, margin: float) -> TensorBasis:
    """The basis over the points (N, 2) and the margin by which a region may go beyond them."""
    return even_basis(scaled.min(axis=0) - margin, scaled.max(axis=0) + margin, SEGMENTS)


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
