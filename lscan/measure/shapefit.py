"""A shape fitted to the points of a surface by least squares of their distances from it.

A point's distance has the standard uncertainty that its own noise has along the shape's normal,
and is weighed by it.  Three things make the fitted parameters uncertain:

* the points' own noise, through the least squares;
* errors that neighbours share, such as a lens's blur on a flank: they show as a scatter of the
  scores, summed over cells of the region, that is larger than independent noise gives, and enlarge
  the covariance by that ratio (the scores' scatter over clusters: Liang and Zeger 1986);
* the errors of calibration and alignment that all points share, the surface's modes: each changes
  the parameters by a weighted sum of what it does to the distances.

All is of first order in the noise: the radius of a sphere grows by s²/r, 0.3 µm of 30 mm for noise
of 0.1 mm.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lscan.errors import MeasurementError
from lscan.records import Floats, Ints, Mask, Surface, has_value
from lscan.surface.align.alignment import own_variances, turned_modes

OUTLIER = 5.0
"""Points beyond so many robust standard deviations are left out: of a normal distribution one in
two million."""

LEAST_SIGMA_MM = 1e-4
"""Points are weighed as if known to no better than this: exact ones have weights too."""

CELLS_ACROSS = 8
"""Cells of a region along its longer side: errors of neighbours change within less than that."""

CELLS_A_PARAMETER = 4
"""Fewest cells for each parameter, from which the scatter of their scores is judged: a variance
from 16 or more is known to a third."""

MOST_ITERATIONS = 100

UNDECIDED_ITERATIONS = 15
"""Rounds after which it stays as it is which points are outliers: a doubtful one that came and
went would keep the fit from settling."""

SETTLED = 1e-4
"""Length of a step, in standard deviations, at which the iteration ends."""

SLOW_ITERATIONS = 25
"""Rounds after which it also ends once a step no longer lessens the squares: over the facets of a
mesh steps stay longer."""

SINGULAR = 1e-12
"""Least eigenvalue of the normal matrix, each parameter in its own scale, that determines all of
them: rounding of a double is 2e-16 for each of some thousand points."""

FELT = 1e-9
"""A parameter that changes the distances by less than this, against what another one of them does,
is not determined: a plane's normal has components of 1e-16 within it by rounding alone."""


@dataclass(frozen=True)
class MeasuredPoints:
    """K points of a surface.

    Attributes
    ----------
    xyz_mm : (K, 3) array, mm, frame of the surface
    own_mm2 : (K, 3) array, mm², variances of x, y and z that are each point's own
    modes_mm : (K, 3, M) array, mm, what each independent error of calibration and alignment
        displaces the points by
    """

    xyz_mm: Floats
    own_mm2: Floats
    modes_mm: NDArray[np.floating]

    def only(self, wanted: Mask | Ints) -> "MeasuredPoints":
        """Those of a mask (K,) or of indices.

        Parameters
        ----------
        wanted : (K,) mask or array of indices, of the points kept
        """
        return MeasuredPoints(self.xyz_mm[wanted], self.own_mm2[wanted], self.modes_mm[wanted])


def measured_points(surface: Surface, wanted: Mask | None = None) -> MeasuredPoints:
    """The points of a surface that have a value, profile by profile.

    Parameters
    ----------
    surface : Surface, of F by N points, in either frame
    wanted : (F, N) mask, optional, of those wanted; by default all
    """
    valid = has_value(surface.status) & np.isfinite(surface.xyz_mm).all(axis=-1)
    if wanted is not None:
        valid &= wanted
    index = np.flatnonzero(valid)
    modes = turned_modes(surface, np.eye(3), index)
    return MeasuredPoints(surface.xyz_mm[valid], own_variances(surface)[valid], modes)


@dataclass(frozen=True)
class ShapeTerms:
    """Where K points lie against a shape of P parameters.

    Attributes
    ----------
    distance_mm : (K,) array, mm, signed distance of each point from the shape
    normal : (K, 3) array, unit normals, along which the distance grows
    design : (K, P) array, derivatives of the distances by the parameters
    usable : (K,) mask, of the points that the shape has a distance for
    turn : (P, 3) array, optional, change of the normals by the parameters, alike at all points
    """

    distance_mm: Floats
    normal: Floats
    design: Floats
    usable: Mask
    turn: Floats | None = None

    def sigma_mm(self, points: MeasuredPoints) -> Floats:
        """(K,) mm, standard uncertainty of the distances by the points' own noise.

        Parameters
        ----------
        points : MeasuredPoints, the K points
        """
        variance = (self.normal**2 * points.own_mm2).sum(axis=1)
        return np.sqrt(np.maximum(variance, LEAST_SIGMA_MM**2))

    def by_sigma(self, points: MeasuredPoints) -> Floats:
        """(K, P) derivatives of the distances over their sigma, which turns with the normals.

        Without that, heights alone being uncertain, a plane would come out too steep.

        Parameters
        ----------
        points : MeasuredPoints, the K points
        """
        sigma = self.sigma_mm(points)[:, None]
        if self.turn is None:
            return self.design / sigma
        turned = (self.normal * points.own_mm2) @ self.turn.T / sigma**2
        return (self.design - self.distance_mm[:, None] * turned) / sigma

    def by_modes(self, points: MeasuredPoints) -> Floats:
        """(K, M) mm, change of the distances by each of the points' modes.

        Parameters
        ----------
        points : MeasuredPoints, the K points
        """
        return np.einsum("ki,kim->km", self.normal, points.modes_mm)


class FittedShape(Protocol):
    """A shape in space, of P parameters."""

    def terms(self, xyz_mm: Floats) -> ShapeTerms:
        """Where points (K, 3), mm, lie against it."""
        ...

    def moved(self, step: Floats) -> "FittedShape":
        """The shape with its parameters changed by a step (P,)."""
        ...


@dataclass(frozen=True)
class ShapeFit:
    """A shape fitted to points.

    Attributes
    ----------
    shape : FittedShape, of P parameters
    covariance : (P, P) array, of the parameters, from noise and from errors that neighbours share
    modes : (P, M) array, change of the parameters by each of the points' modes
    determined : bool, whether the points determine all parameters
    terms : ShapeTerms, of all points about the shape
    kept : (K,) mask, of the points that are no outliers
    """

    shape: FittedShape
    covariance: Floats
    modes: Floats
    determined: bool
    terms: ShapeTerms
    kept: Mask

    @property
    def rms_mm(self) -> float:
        """Root mean square distance of the points that are no outliers, mm."""
        return float(np.sqrt(np.mean(self.terms.distance_mm[self.kept] ** 2)))

    def sigma(self, gradient: Floats) -> Floats:
        """(Q,) standard uncertainties of quantities, all causes together.

        Parameters
        ----------
        gradient : (Q, P) array, of the quantities by the parameters
        """
        own = np.einsum("qi,ij,qj->q", gradient, self.covariance, gradient)
        return np.sqrt(np.maximum(own, 0.0) + np.square(gradient @ self.modes).sum(axis=1))

    def share_of_noise(self, points: MeasuredPoints) -> float:
        """How much of what determines the parameters is the points' own noise: of variances.

        Points on one line have noise aside of it too, by which any plane through the line seems
        determined.  The noise counts as alike along all axes: the shape may stand wrongly.

        Parameters
        ----------
        points : MeasuredPoints, that it was fitted to
        """
        noise = np.sqrt(np.maximum(points.own_mm2.max(axis=1, keepdims=True), LEAST_SIGMA_MM**2))
        ways = noise * np.eye(3)[:, None]
        change = np.stack([self.shape.terms(points.xyz_mm + way).design for way in ways])
        change = (change - self.terms.design) / self.terms.sigma_mm(points)[:, None]
        change = change[:, self.kept].reshape(-1, len(self.covariance))
        return float(((change @ self.covariance) * change).sum())


def fit_shape(start: FittedShape, points: MeasuredPoints, what: str) -> ShapeFit:
    """The shape of least squares through points, outliers left out.

    Parameters
    ----------
    start : FittedShape, from which it is looked for
    points : MeasuredPoints, mm
    what : str, how messages call it

    Raises
    ------
    MeasurementError
        Where there are too few points, or the fit does not settle.

    References
    ----------
    Covariance with errors that neighbours share: K.-Y. Liang and S. L. Zeger, Biometrika 73, 13
    (1986).
    """
    shape, kept, least = start, None, np.inf
    for iteration in range(MOST_ITERATIONS):
        terms = shape.terms(points.xyz_mm)
        sigma = terms.sigma_mm(points)
        if kept is None or iteration < UNDECIDED_ITERATIONS:
            kept = _no_outliers(terms, sigma)
        count, fewest = int(kept.sum()), 2 * terms.design.shape[1]
        if count < fewest:
            raise MeasurementError(f"{what}: {count} points lie there, {fewest} are needed")
        step, length = _step(terms.by_sigma(points)[kept], terms.distance_mm[kept] / sigma[kept])
        squares = float(np.square(terms.distance_mm[kept] / sigma[kept]).sum())
        idle = iteration >= SLOW_ITERATIONS and squares >= least
        if (length < SETTLED and iteration >= UNDECIDED_ITERATIONS) or idle:
            return _fitted(shape, points, kept)
        shape, least = shape.moved(step), squares
    raise MeasurementError(f"{what}: the fit does not settle: does what lies there determine it?")


def _no_outliers(terms: ShapeTerms, sigma: Floats) -> Mask:
    """(K,) which points are no outliers; a distance that rounding explains is none."""
    ratio = np.abs(terms.distance_mm) / sigma
    if not terms.usable.any():
        return terms.usable
    # Of a normal distribution the median of the absolute value is 0.6745 sigma.
    spread = float(np.median(ratio[terms.usable])) / 0.6745
    return terms.usable & (ratio <= OUTLIER * spread + LEAST_SIGMA_MM / sigma)


def _step(weighted: Floats, ratio: Floats) -> tuple[Floats, float]:
    """The Gauss-Newton step (P,) and its length in standard deviations; see ``_excess``."""
    inverse, _ = _inverse(weighted.T @ weighted)
    step = -inverse @ (weighted.T @ ratio)
    return step, float(np.linalg.norm(weighted @ step))


def _inverse(matrix: Floats) -> tuple[Floats, bool]:
    """The inverse of a normal matrix, of what it determines, and whether that is all."""
    squares = np.diag(matrix)
    scale = np.sqrt(np.where(squares > FELT**2 * squares.max(), squares, np.inf))
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    known = values > SINGULAR
    inverse = (vectors[:, known] / values[known]) @ vectors[:, known].T
    return inverse / np.outer(scale, scale), bool(known.all())


def _fitted(shape: FittedShape, points: MeasuredPoints, kept: Mask) -> ShapeFit:
    """The fit with its uncertainty, the shape and the points that had a part in it decided."""
    terms = shape.terms(points.xyz_mm)
    sigma = terms.sigma_mm(points)[kept]
    weighted = terms.by_sigma(points)[kept]
    inverse, determined = _inverse(weighted.T @ weighted)
    ratio = terms.distance_mm[kept] / sigma
    excess = _excess(weighted, ratio, inverse, _cells(points.xyz_mm[kept]))
    common = terms.by_modes(points)[kept] / sigma[:, None]
    return ShapeFit(
        shape=shape,
        covariance=inverse * excess,
        modes=-inverse @ (weighted.T @ common),
        determined=determined,
        terms=terms,
        kept=kept,
    )


def _cells(xyz: Floats) -> Ints:
    """(K,) number of the square cell in plan that each point lies in, from 0."""
    plan = xyz[:, :2] - xyz[:, :2].min(axis=0)
    side = max(float(plan.max()) / CELLS_ACROSS, np.finfo(float).tiny)
    place = np.minimum(plan / side, CELLS_ACROSS - 1).astype(np.int64)
    number: Ints = np.unique(place @ [CELLS_ACROSS, 1], return_inverse=True)[1]
    return number


def _excess(weighted: Floats, ratio: Floats, inverse: Floats, cell: Ints) -> float:
    """By how much the parameters' variances are larger than the points' own noise says; 1 or more.

    weighted: (K, P) design and ratio: (K,) distances in units of sigma.
    """
    count, parameters = weighted.shape
    excess = max(1.0, float(ratio @ ratio) / max(count - parameters, 1))
    cells = int(cell.max()) + 1
    if cells < CELLS_A_PARAMETER * parameters:
        return excess
    scores = np.zeros((cells, parameters))
    np.add.at(scores, cell, weighted * ratio[:, None])
    # The fit takes its own freedom out of the scores' scatter.
    freedom = cells / (cells - parameters)
    of_cells = freedom * float(np.trace(inverse @ (scores.T @ scores))) / parameters
    return max(excess, of_cells)
