"""A smooth surface over a projective map: ``spline``.

What a projective matrix (projective.py) leaves of x and of z is what lens and port bend:
little, and gently.  That rest is fitted by a tensor-product cubic B-spline to the control
points and to the marks of the rulers, with a penalty on its third derivatives whose weight
cross-validation chooses.  The matrix takes the perspective out, which no
penalty on roughness should touch; third derivatives leave every quadratic free, and what
remains of it is bent so little that the penalty costs next to nothing.

Each mark counts by its own uncertainty, propagated to mm by the map's Jacobian.  No variants.
"""

from dataclasses import dataclass, replace
from math import comb
from typing import Annotated, Self

import numpy as np
from pydantic import Field, model_validator
from scipy.interpolate import BSpline

from lscan.calibration.fields import STRICT, Matrix, Vector
from lscan.calibration.maps.polynomial import Scaling, box, terms
from lscan.calibration.maps.projective import Projective, solver as projective
from lscan.calibration.marks import (
    Region,
    all_marks,
    covered_region,
    found_marks,
    found_on,
    joined_marks,
)
from lscan.calibration.physical import BoardKnown, PhysicalMap, board_modes, pixel_table, sheet_of
from lscan.calibration.planemap import (
    Estimate,
    MapSolver,
    PlaneMap,
    SolvedMap,
    estimate_of,
    separate_modes,
    with_lack_of_fit,
)
from lscan.camera.posedboards import priors_of
from lscan.camera.resection import posed_boards
from lscan.config.rig import OpticsSection
from lscan.errors import BoardNotFound
from lscan.files.compiling import compiled, compiled_sums
from lscan.records import BoardReading, Floats

# Tensor-product cubic B-splines over the picture, and how rough such a surface is.


DEGREE = 3
ORDER = 3  # of the derivatives that roughness is made of
FLAT = ORDER * (ORDER + 1) // 2  # terms u^i v^j, i + j < ORDER: they have no roughness
# Exact for degree 7; a product of two cubics has degree 6.
GAUSS_NODES, GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(4)


@dataclass(frozen=True)
class TensorBasis:
    """All products of a cubic B-spline of u and one of v: K = I · J functions, i slowest.

    Attributes
    ----------
    knots_u : (I + 4,) array, in the unit of the points
    knots_v : (J + 4,) array, in the unit of the points
    """

    __pydantic_config__ = STRICT
    knots_u: Vector
    knots_v: Vector

    def __post_init__(self) -> None:
        """Raise ValueError unless both knot vectors rise and suffice for a cubic."""
        for knots in (self.knots_u, self.knots_v):
            if len(knots) < 2 * (DEGREE + 1) or np.any(np.diff(knots) < 0):
                raise ValueError("knots must be eight or more and must not fall")
            if knots[DEGREE] >= knots[-DEGREE - 1]:
                raise ValueError("knots must span a stretch")

    @property
    def count(self) -> int:
        """K."""
        return (len(self.knots_u) - DEGREE - 1) * (len(self.knots_v) - DEGREE - 1)

    def rows(self, points: Floats) -> Floats:
        """(N, K) values of the functions.

        Parameters
        ----------
        points : (N, 2) array, of (u, v)
        """
        of_u, of_v = _values(self.knots_u, points[:, 0]), _values(self.knots_v, points[:, 1])
        return (of_u[:, :, None] * of_v[:, None, :]).reshape(len(points), self.count)

    def roughness(self) -> Floats:
        """(K, K) R so that c @ R @ c is the roughness of the surface with coefficients c.

        It is the integral over the rectangle of the knots of
        f_uuu² + 3 f_uuv² + 3 f_uvv² + f_vvv², which does not depend on how the axes are
        turned (Wahba, "Spline Models for Observational Data" (1990), eq. (2.4.9), m = 3).
        """
        total = np.zeros((self.count, self.count))
        for by_u in range(ORDER + 1):
            of_u, of_v = _products(self.knots_u, by_u), _products(self.knots_v, ORDER - by_u)
            total += comb(ORDER, by_u) * np.kron(of_u, of_v)
        return total


def even_basis(low: Floats, high: Floats, segments: int) -> TensorBasis:
    """The basis on a rectangle with equal segments.

    Parameters
    ----------
    low, high : (2,) array, two opposite corners of the rectangle
    segments : int, a side
    """
    knots = [
        np.concatenate([np.full(DEGREE, a), np.linspace(a, b, segments + 1), np.full(DEGREE, b)])
        for a, b in zip(low, high, strict=True)
    ]
    return TensorBasis(*knots)


def _values(knots: Floats, x: Floats, derivative: int = 0) -> Floats:
    """(N, I) the B-splines on ``knots``, or a derivative of each, at x (N,)."""
    splines = BSpline(knots, np.eye(len(knots) - DEGREE - 1), DEGREE)
    return splines.derivative(derivative)(x) if derivative else splines(x)


def _products(knots: Floats, derivative: int) -> Floats:
    """(I, I) integrals of the products of two B-splines' derivatives, by Gauss's rule."""
    ends = np.unique(knots)
    half = np.diff(ends)[:, None] / 2
    x = (ends[:-1, None] + half * (1 + GAUSS_NODES)).ravel()
    values = _values(knots, x, derivative)
    return (values * (half * GAUSS_WEIGHTS).ravel()[:, None]).T @ values


@compiled_sums
def surface_at(
    knots_u: Floats,
    knots_v: Floats,
    points: Floats,
    coefficients: Floats,
    root_x: Floats,
    root_z: Floats,
    few: int,
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """A smooth surface of two values and what it errs by, at N points.

    Its values (N, 2), their derivatives (N, 2, 2) by u and v, errors of either value by the first
    few columns of its root (N, F), and the sum of squares (N, 2) of those by the others.  Of all
    products of B-splines sixteen are not 0 at a point.

    Parameters
    ----------
    knots_u, knots_v : array, as of :class:`TensorBasis`, in the unit of the points
    points : (N, 2) array, of (u, v)
    coefficients : (2, K) array
    root_x, root_z : (K, M) array, of the coefficients' covariances
    few : int, of the columns
    """
    count, size_v = len(points), len(knots_v) - DEGREE - 1
    values, slopes = np.zeros((count, 2)), np.zeros((count, 2, 2))
    rest = np.zeros((count, 2))
    first = np.empty((count, min(few, root_x.shape[1])))
    second = np.empty((count, min(few, root_z.shape[1])))
    of_u, by_u = np.empty(DEGREE + 1), np.empty(DEGREE + 1)
    of_v, by_v = np.empty(DEGREE + 1), np.empty(DEGREE + 1)
    errors = np.empty(max(root_x.shape[1], root_z.shape[1]))
    for n in range(count):
        begin_u = _splines_at(knots_u, points[n, 0], of_u, by_u)
        begin_v = _splines_at(knots_v, points[n, 1], of_v, by_v)
        for value in range(2):
            root = root_x if value == 0 else root_z
            errors[:] = 0.0
            for i in range(DEGREE + 1):
                for j in range(DEGREE + 1):
                    at = (begin_u + i) * size_v + begin_v + j
                    coefficient, weight, along = (
                        coefficients[value, at],
                        of_u[i] * of_v[j],
                        root[at],
                    )
                    values[n, value] += weight * coefficient
                    slopes[n, value, 0] += by_u[i] * of_v[j] * coefficient
                    slopes[n, value, 1] += of_u[i] * by_v[j] * coefficient
                    for m in range(len(along)):
                        errors[m] += weight * along[m]
            own = first[n] if value == 0 else second[n]
            for m in range(root.shape[1]):
                if m < len(own):
                    own[m] = errors[m]
                else:
                    rest[n, value] += errors[m] ** 2
    return values, slopes, first, second, rest


@compiled
def _splines_at(knots: Floats, x: float, values: Floats, slopes: Floats) -> int:
    """The first of the four cubic B-splines that are not 0 at x; their values and derivatives.

    Beyond the ends the outermost polynomials go on.

    References
    ----------
    Cox and de Boor's recursion: C. de Boor, A Practical Guide to Splines (1978), ch. X.
    """
    piece = DEGREE
    while piece < len(knots) - DEGREE - 2 and x >= knots[piece + 1]:
        piece += 1
    values[:], slopes[:] = 0.0, 0.0
    values[0] = 1.0
    for degree in range(1, DEGREE + 1):
        carried, fallen = 0.0, 0.0
        for i in range(degree):
            right, left = knots[piece + i + 1], knots[piece + i + 1 - degree]
            share = values[i] / (right - left)
            if degree == DEGREE:
                slopes[i] = fallen - DEGREE * share
                fallen = DEGREE * share
            values[i] = carried + (right - x) * share
            carried = (x - left) * share
        values[degree] = carried
        if degree == DEGREE:
            slopes[degree] = fallen
    return piece - DEGREE


def compile_splines() -> None:
    """Compile the loops of this module, for the processes that follow."""
    knots, root = np.array([0.0] * 4 + [1.0] * 4), np.ones((16, 1))
    surface_at(knots, knots, np.zeros((1, 2)), np.ones((2, 16)), root, root, 1)


# Penalised least squares: its weight by cross-validation, its covariance as a posterior.
#
# A smooth surface with coefficients c is fitted to N values y with standard uncertainties sigma: it
# minimises the sum of ((y - rows @ c) / sigma)² plus ``weight`` times the roughness c @ R @ c.  The
# weight is that of the least generalised cross-validation score (Craven & Wahba, Numer. Math. 31
# (1979) 377), in which each degree of freedom counts 1.4 times, so that chance rarely makes the
# surface too rough (Kim & Gu, J. R. Statist. Soc. B 66 (2004) 337).
#
# The penalty is equivalent to a Gaussian prior of the surface, so the posterior of that prior is
# the fit's covariance.  It holds the scatter and the bias of smoothing both: averaged over the
# surface, its intervals contain the truth as often as they state (Nychka, J. Am. Statist. Assoc. 83
# (1988) 1134).


COST = 1.4  # of one degree of freedom
WEIGHTS = np.logspace(3, -12, 151)  # tried, from smooth to rough, over the greatest eigenvalue


@dataclass(frozen=True)
class Smooth:
    """A fitted surface.

    Attributes
    ----------
    coefficients : (K,) array, in the unit of the values
    root : (K, K) array, root @ root.T is their posterior covariance; its columns are independent
    freedom : float, degrees of freedom that the fit spends
    """

    coefficients: Floats
    root: Floats
    freedom: float


def smooth(rows: Floats, y: Floats, sigma: Floats, roughness: Floats, flat: int) -> Smooth:
    """The surface of least error and roughness through N values.

    Where the values scatter more than their sigma, the covariance grows by as much; it never
    shrinks.

    Parameters
    ----------
    rows : (N, K) array, the basis functions at the values' places
    y : (N,) array, the values
    sigma : (N,) array, their standard uncertainties, above 0
    roughness : (K, K) array, the penalty
    flat : int, how many independent surfaces have no roughness; the values must determine those,
        and be more than 1.4 times as many

    References
    ----------
    The scale of the covariance: Birge, Phys. Rev. 40 (1932) 207.
    """
    bending, shapes = np.linalg.eigh(roughness)
    even, bent = shapes[:, :flat], shapes[:, flat:] / np.sqrt(bending[flat:])
    by_even, by_bent = ((rows @ part) / sigma[:, None] for part in (even, bent))
    # The even part is free: with it taken out of both sides, a ridge regression is left.
    square, triangle = np.linalg.qr(by_even)
    even = even @ np.linalg.inv(triangle)
    of_even, crossed = square.T @ (y / sigma), square.T @ by_bent
    left, by_left = y / sigma - square @ of_even, by_bent - square @ crossed
    power, turn = np.linalg.eigh(by_left.T @ by_left)
    power, along = np.maximum(power, 0.0), turn.T @ (by_left.T @ left)
    weight, freedom, scatter = _cross_validate(power, along, left, flat)

    directions = (bent - even @ crossed) @ turn
    root = np.hstack([even, directions / np.sqrt(power + weight)])
    coefficients = even @ of_even + directions @ (along / (power + weight))
    return Smooth(coefficients, root * np.sqrt(max(1.0, scatter)), freedom)


def _cross_validate(
    power: Floats, along: Floats, left: Floats, flat: int
) -> tuple[float, float, float]:
    """The weight of the least score, the degrees of freedom it spends, and the scatter it leaves.

    power, along: eigenvalues of the ridge regression and its right side in their basis.
    left: (N,) what it is to explain.  The scatter is the mean square of the residuals per
    degree of freedom that is left, in units of sigma².
    """
    weights = (WEIGHTS * max(float(power.max()), 1e-300))[:, None]
    freedom = flat + (power / (power + weights)).sum(axis=1)
    explained = (along**2 * (power + 2 * weights) / (power + weights) ** 2).sum(axis=1)
    squares = np.maximum(left @ left - explained, 0.0)
    spare = len(left) - COST * freedom
    score = np.where(spare > 0, squares / np.where(spare > 0, spare, 1.0) ** 2, np.inf)
    best = int(np.argmin(score))
    scatter = squares[best] / (len(left) - freedom[best])
    return float(weights[best, 0]), float(freedom[best]), float(scatter)


# A smooth surface over a projective map: ``spline``.


SEGMENTS = 6  # of the longer side; the penalty, not the knots, limits how much the rest bends
LEAST_SIGMA_PX = 1e-3  # no mark is known better, whatever it states
KEPT = 0.98  # of the variance, on the mean over the region, that the modes must account for
LATTICE = 24  # places a side at which that is judged
FEW = 6  # modes of x and of z, the broadest, that a map beside this one states


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
    lack_of_fit_mm : (2,) array, mm, of x and of z (calibration/planemap.py)
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
        return self._estimate_with(image_px, variance_px2, None)

    def in_few_modes(self, image_px: Floats, variance_px2: Floats) -> Estimate:
        """As ``estimate``, with the strongest modes alone; what the others do is each point's own.

        Parameters
        ----------
        image_px : (N, 2) array, px, of (u, v)
        variance_px2 : (N,) array, px², of either pixel coordinate
        """
        return self._estimate_with(image_px, variance_px2, FEW)

    def _estimate_with(self, image_px: Floats, variance_px2: Floats, most: int | None) -> Estimate:
        """The points with at most so many modes of x and of z."""
        jacobian = self.base.derivatives(image_px)
        x, z = self.roots
        added, bend, first, second, rest = surface_at(
            self.basis.knots_u,
            self.basis.knots_v,
            self.pixels.apply(image_px),
            self.coefficients,
            np.ascontiguousarray(x),
            np.ascontiguousarray(z),
            max(x.shape[1], z.shape[1]) if most is None else most,
        )
        jacobian += bend / self.pixels.scale
        modes = separate_modes(first, second)
        known = estimate_of(self.base.places(image_px) + added, jacobian, modes, variance_px2)
        return replace(known, variance_mm2=known.variance_mm2 + rest)


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
        free = np.linalg.matrix_rank(terms(scaled, ORDER - 1)[0])
        if free < FLAT or len(scaled) <= COST * FLAT:
            raise BoardNotFound(
                f"a spline map needs {int(COST * FLAT) + 1} marks that determine a quadratic "
                f"surface, found {len(scaled)} marks"
            )
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


def with_hidden_errors(
    plane_map: PlaneMap,
    reading: BoardReading,
    optics: OpticsSection,
    smooth: PlaneMap | None = None,
) -> PlaneMap:
    """A map that knows no physics with the errors that neither residuals nor held-out marks show.

    A graticule is straight from line to line, a matrix knows no lens, a high polynomial swings
    between the marks: a plane or a step fitted through many points has that in common.  The map
    errs by its difference from the smooth map, one mode of the points, and by what that errs by.
    What the board's place and form do (board_modes) follows from the camera that [optics] expects.
    A map that knows the physics and one of another package stay as they are, and where the marks
    are too few for a spline.

    Parameters
    ----------
    plane_map : PlaneMap, solved from the reading
    reading : BoardReading, px and mm, the marks of one picture
    optics : OpticsSection, what is known of camera and board beforehand
    smooth : PlaneMap, optional, the spline solved from the same; solved here by default
    """
    if not isinstance(plane_map, SolvedMap) or isinstance(plane_map, PhysicalMap):
        return plane_map
    other = plane_map.model_copy()
    if not isinstance(plane_map, Spline):
        try:
            smooth = smooth or solver.solve(reading, "")
        except BoardNotFound:
            return plane_map
        assert isinstance(smooth, Spline)
        other = plane_map.model_copy(update={"lack_of_fit_mm": smooth.lack_of_fit_mm})
        other._smooth = smooth.in_few_modes
    marks = found_on([joined_marks(reading)], [0])
    theta = priors_of(optics, reading.image_size).mean
    known = any(getattr(optics, name) for name in BoardKnown.__annotations__)
    view = posed_boards(theta, optics.port, marks) if known else None
    if view is not None:

        def by_board(image_px: Floats) -> Floats:
            moved = board_modes(sheet_of(view), optics, plane_map.region, image_px)
            return moved.reshape(len(image_px), 2 * moved.shape[2])

        table = pixel_table(by_board, plane_map.region)
        other._board = table.look_up if table else by_board
    return other


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
    variance, directions = np.linalg.eigh(effect.T @ effect)
    share = np.cumsum(variance[::-1]) / np.sum(variance)
    enough = int(np.searchsorted(share, KEPT)) + 1
    return fit.root @ directions[:, : -enough - 1 : -1] / np.sqrt(share[enough - 1])
