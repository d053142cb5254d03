"""How a pencil beam spreads in endless water: the vector irradiance of its scattered light.

A beam of unit power leaves the origin along +z.  At the distance r, theta off the axis, its
scattered light has the vector irradiance (F_r, F_t), radial and tangential (away from the axis).
What was scattered once comes from quadrature, the rest from photons at their first crossings of
spheres about the origin.  Lengths are optical depths, r times the attenuation c, irradiances are
in units of c2: then only the albedo b / c and the phase function matter
(docs/explanation/physics.md, section 8).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import BSpline, CubicSpline

from lscan.records import Floats
from sim.water.planes import (
    ANGLE_AXIS,
    COSINE_AXIS,
    HORIZON_ANGLES,
    NEAREST_RAD,
    SHAPE,
    Complex,
    LogAxis,
    PlaneCounts,
    between_nodes,
    fit_planes,
    harmonics,
    horizon_depths,
)

# Photons counted where they first cross spheres, and the smooth curves through their counts.
#
# The counts of rings about the axis are fitted as a quasi-Poisson variable whose logarithm is a
# cubic spline of the logarithm of the angle.  Its second differences are held small where hardly a
# photon falls, within about 1e-4 rad of the axis, and are free where many do (Eilers & Marx 1996;
# docs/explanation/physics.md, section 8).


# The innermost ring reaches to EDGES_FROM; the others are 3 % of their angle wide.  A mean over
# a ring where light falls as the angle to the power -3 is 6e-4 above the value at its middle.
RINGS, EDGES_FROM = 400, 1e-5
KNOT = 0.4  # between knots, of the angle's logarithm
SMALLEST = 1e-6  # rad, where the spline begins
# A second difference over knots has this standard deviation a priori: the logarithm's curvature
# is 1 at most where light falls most steeply.
CURVATURE = KNOT**2
RIDGE = 1e-6  # where no photon falls at all, and the prior leaves a straight line free
ITERATIONS = 20  # Newton's method on a convex function: 8 are enough from a count's logarithm


@dataclass(frozen=True)
class Crossings:
    """Sums over photons at their first crossings of spheres about the beam's origin.

    The first index of the sums is 0 for light scattered once, 1 for light scattered more often.

    Attributes
    ----------
    photons : int, photons sent
    depths : (K,) the spheres' optical radii c r, rising
    weight : (2, K, R) of the photons' weights
    squared : (2, K, R) of the weights' squares
    tangential : (2, K, R) of weight times tangential over radial part of the direction
    """

    photons: int
    depths: Floats
    weight: Floats
    squared: Floats
    tangential: Floats


@dataclass(frozen=True)
class RingFit:
    """Smooth curves over the angle, at (A,) angles of (K,) spheres.

    Attributes
    ----------
    log_value : (K, A) logarithm of F_r r2, the power per solid angle seen from the origin, 1/sr
    log_error : (K, A) its standard error
    ratio : (K, A) F_t / F_r
    ratio_error : (K, A) its standard error, as if it scattered alike at all angles: too large by
        three near the beam, too small by two behind its origin
    """

    log_value: Floats
    log_error: Floats
    ratio: Floats
    ratio_error: Floats


def ring_edges() -> Floats:
    """(RINGS + 1,) angles between the rings, rad, from 0 to pi."""
    return np.concatenate([[0.0], np.geomspace(EDGES_FROM, np.pi, RINGS)])


def solid_angles() -> Floats:
    """(RINGS,) solid angles of the rings, sr."""
    return 4 * np.pi * np.diff(np.sin(ring_edges() / 2) ** 2)


def fit_rings(crossings: Crossings, angles: Floats) -> RingFit:
    """Curves through the counts of light scattered more than once.

    Parameters
    ----------
    crossings : Crossings, the counts
    angles : (A,) rad, where the curves are wanted
    """
    edges = ring_edges()
    middle = 2 * np.arcsin(np.sqrt((np.sin(edges[:-1] / 2) ** 2 + np.sin(edges[1:] / 2) ** 2) / 2))
    basis, wanted = _splines(middle), _splines(angles)
    weight, squared, tangential = (
        sums[1] for sums in (crossings.weight, crossings.squared, crossings.tangential)
    )
    curves = []
    for sphere in range(len(crossings.depths)):
        # Counts of photons of equal weight that scatter as much as these sums do.
        unit = squared[sphere].sum() / weight[sphere].sum() if weight[sphere].any() else 1.0
        counts = weight[sphere] / unit
        log_rate = _poisson(basis, counts, crossings.photons / unit * solid_angles())
        seen = counts > 0
        means = tangential[sphere][seen] / weight[sphere][seen]
        ratio = _least_squares(basis[seen], means, counts[seen])
        curves += [_values(wanted, *log_rate), _values(wanted, *ratio)]
    stacked = np.array(curves).reshape(len(crossings.depths), 4, len(angles))
    return RingFit(*np.moveaxis(stacked, 1, 0))


def _splines(angles: Floats) -> Floats:
    """(N, M) cubic B-splines of the logarithm of (N,) angles."""
    low, high = float(np.log(SMALLEST)), float(np.log(np.pi))
    inner = np.linspace(low, high, 1 + round((high - low) / KNOT))
    knots = np.concatenate([[low] * 3, inner, [high] * 3])
    place = np.clip(np.log(angles), low, high)
    return np.asarray(BSpline.design_matrix(place, knots, 3).toarray())


def _poisson(basis: Floats, counts: Floats, exposure: Floats) -> tuple[Floats, Floats]:
    """Coefficients of the logarithm of counts per exposure, and their covariance."""
    mean = counts + 0.5
    log_rate = np.log(mean / exposure)
    for _ in range(ITERATIONS):
        found, covariance = _solve(basis, log_rate + counts / mean - 1, mean)
        log_rate = basis @ found
        mean = exposure * np.exp(log_rate)
    return found, covariance


def _least_squares(basis: Floats, values: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """Coefficients of the values, and their covariance by how much the values scatter."""
    found, covariance = _solve(basis, values, weights)
    freedom = max(len(values) - basis.shape[1], 1)
    return found, covariance * np.sum(weights * (values - basis @ found) ** 2) / freedom


def _solve(basis: Floats, values: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """Coefficients by penalised least squares, and the inverse of their normal matrix."""
    weighted = weights[:, np.newaxis] * basis
    size = basis.shape[1]
    second = np.diff(np.eye(size), 2, axis=0) / CURVATURE
    # With the inverse covariance of the coefficients a priori.
    normal = basis.T @ weighted + (second.T @ second + RIDGE * np.eye(size))
    covariance = np.asarray(np.linalg.inv(normal), dtype=float)
    return covariance @ (weighted.T @ values), covariance


def _values(basis: Floats, found: Floats, covariance: Floats) -> tuple[Floats, Floats]:
    """(2, A) values of a spline and their standard errors."""
    return basis @ found, np.sqrt(np.einsum("am,mn,an->a", basis, covariance, basis))


# Light of a pencil beam that the water scattered exactly once, by quadrature.
#
# The beam runs from the origin along +z.  A point at the distance r, theta off the axis, receives
# light from every place z of the axis, turned by psi.  With h = r sin(theta) and dz = h dpsi /
# sin2(psi) the inverse square cancels, and the path is r cos(theta) + h tan(psi / 2). So the vector
# irradiance, its radial part real and its tangential part (away from the axis) imaginary, is
#
#     F = b / h [exp(-c r) J(theta) - exp(-c (t + l)) exp(i (psi_t - theta)) J(psi_t)],
#     J(psi) = integral over a from psi to pi of
#              p(a) exp(i (a - psi) - c h (tan(a / 2) - tan(psi / 2)))
#
# where the beam ends at the distance t, from where the point is seen under psi_t at the distance l
# (docs/explanation/physics.md, section 8).


NODES_A_CELL = 4  # of Gauss and Legendre
FARTHEST_RAD = np.pi - 1e-3  # where the formula becomes 0 / 0
# Rows of the table, c h: evenly spaced up to about ROWS_EVEN.
ROWS, ROWS_EVEN = 128, 0.3


@dataclass(frozen=True)
class OnceScattered:
    """Tables of light scattered once.

    Attributes
    ----------
    albedo : float, b / c
    farthest : float, largest optical depth
    table : (ROWS, A) complex, the angle times J, at optical distances from the beam and at the
        angles of ``ANGLE_AXIS``
    """

    albedo: float
    farthest: float
    table: Complex

    @property
    def across_axis(self) -> LogAxis:
        """The table's rows: optical distances from the beam, c h."""
        return _across_axis(self.farthest)

    def vector_irradiance(self, theta: Floats, depth: Floats, end: Floats) -> Complex:
        """Radial (real) and tangential part, in units of c2 times the beam's power.

        Parameters
        ----------
        theta : array, rad off the axis; shapes broadcast
        depth : array, optical distance from the origin, c r
        end : array, where on the axis the beam ends, c t
        """
        theta = np.clip(theta, NEAREST_RAD, FARTHEST_RAD)
        across = depth * np.sin(theta)
        ahead = depth * np.cos(theta) - end
        onward, seen = np.hypot(across, ahead), np.arctan2(across, ahead)
        behind = np.exp(-(end + onward) + 1j * (seen - theta)) * self._integral(seen, across)
        before = np.exp(-depth) * self._integral(theta, across)
        return np.asarray(self.albedo / across * (before - behind))

    def _integral(self, angle: Floats, across: Floats) -> Complex:
        """J, 1/sr."""
        angle = np.maximum(angle, NEAREST_RAD)
        row, column = self.across_axis.place(across), ANGLE_AXIS.place(angle)
        return between_nodes(self.table, row, column) / angle


def once_scattered(
    phase: Callable[[Floats], Floats], albedo: float, farthest: float
) -> OnceScattered:
    """The tables of a water.

    Parameters
    ----------
    phase : function of the scattering angle in rad, 1/sr
    albedo : float, b / c
    farthest : float, largest optical depth
    """
    angles = ANGLE_AXIS.nodes()
    integrals = _integrals(phase, angles, _across_axis(farthest).nodes())
    return OnceScattered(albedo, farthest, angles * integrals)


def _across_axis(farthest: float) -> LogAxis:
    return LogAxis(0.0, farthest, ROWS, ROWS_EVEN)


def _integrals(phase: Callable[[Floats], Floats], angles: Floats, across: Floats) -> Complex:
    """(H, A) J at (A,) angles rising to pi and (H,) optical distances from the beam."""
    low, high = angles[:-1], angles[1:]
    node, weight = np.polynomial.legendre.leggauss(NODES_A_CELL)
    half = np.log(high / low)[:, np.newaxis] / 2
    angle = np.sqrt(low * high)[:, np.newaxis] * np.exp(half * node)
    share = phase(angle) * angle * half * weight * np.exp(1j * (angle - low[:, np.newaxis]))
    detour = np.tan(angle / 2) - np.tan(low / 2)[:, np.newaxis]
    cells = np.stack([np.sum(share * np.exp(-depth * detour), axis=1) for depth in across])
    longer = np.tan(high / 2) - np.tan(low / 2)
    onward = np.exp(1j * (high - low) - across[:, np.newaxis] * longer)
    total = np.zeros((len(across), len(angles)), dtype=complex)
    for cell in reversed(range(len(low))):
        total[:, cell] = cells[:, cell] + onward[:, cell] * total[:, cell + 1]
    return total


# How a pencil beam spreads in endless water: the vector irradiance of its scattered light.


DEPTHS = 128


@dataclass(frozen=True, eq=False)  # each is itself, so that what is made of it can be kept
class Spread:
    """Tables of a beam's scattered light in one water.

    Attributes
    ----------
    once : OnceScattered, of light scattered once
    nearest, farthest : float, optical depths between which photons were counted
    multiple : (DEPTHS, A, 2), of light scattered more often, at the angles of ``ANGLE_AXIS``:
        the logarithm of F_r exp((1 - albedo / 2) depth), and F_t / F_r
    error : (DEPTHS, A) standard error of F_r, over F_r of all scattered light
    horizon : (COSINES, DEPTHS, ANGLES, HARMONICS) of ``sim.water.planes``
    """

    once: OnceScattered
    nearest: float
    farthest: float
    multiple: Floats
    error: Floats
    horizon: Floats

    @property
    def depth_axis(self) -> LogAxis:
        """The rows of ``multiple`` and ``error``."""
        return _depth_axis(self.nearest, self.farthest)

    @property
    def loss(self) -> float:
        """What ``multiple`` is relieved of, per optical depth: absorption and half the scattering.

        Scattered light is dimmed by less than all of it and by more than absorption alone.
        """
        return _loss(self.once.albedo)

    def vector_irradiance(self, theta: Floats, depth: Floats, end: Floats) -> tuple[Floats, Floats]:
        """Radial and tangential part, in units of c2 times the beam's power; shapes broadcast.

        Parameters
        ----------
        theta : array, rad off the axis
        depth : array, optical distance from the origin, c r
        end : array, where on the axis the beam ends for light scattered once, c t
        """
        light = self.once.vector_irradiance(theta, depth, end) + self.more(theta, depth)
        return light.real, light.imag

    def irradiance(
        self, theta: Floats, depth: Floats, cosine: Floats, aside: Floats, end: Floats
    ) -> Floats:
        """What a plane surface receives, in units of c2 times the beam's power; shapes broadcast.

        Each table is read at as many places as what it depends on has: sparse grids cost least.

        Parameters
        ----------
        theta, depth, end : arrays, as of ``vector_irradiance``
        cosine : array, 0 to 1, of the angle between the surface's normal and the way back to
            the origin: the normal's radial part is its negative
        aside : array, the normal's tangential part
        """
        once, more = self.once.vector_irradiance(theta, depth, end), self.more(theta, depth)
        place = (
            COSINE_AXIS.place(cosine),
            horizon_depths(self.nearest, self.farthest).place(depth),
            HORIZON_ANGLES.place(np.maximum(theta, NEAREST_RAD)),
        )
        missed = sum(
            factor * between_nodes(self.horizon[..., harmonic], *place)
            for harmonic, factor in enumerate(harmonics(cosine, aside))
        )
        light = once + more
        return np.maximum(light.real * cosine - light.imag * aside + more.real * missed, 0)

    def more(self, theta: Floats, depth: Floats) -> Complex:
        """Radial (real) and tangential part of light scattered more than once.

        Parameters
        ----------
        theta, depth : arrays, as of ``vector_irradiance``; shapes broadcast
        """
        place = self.depth_axis.place(depth), ANGLE_AXIS.place(np.maximum(theta, NEAREST_RAD))
        log_value, ratio = (between_nodes(self.multiple[..., part], *place) for part in (0, 1))
        return np.asarray(np.exp(log_value - self.loss * depth) * (1 + 1j * ratio))


def tabulate(
    phase: Callable[[Floats], Floats], albedo: float, crossings: Crossings, counts: PlaneCounts
) -> Spread:
    """The tables of a water.

    Parameters
    ----------
    phase : function of the scattering angle in rad, 1/sr
    albedo : float, b / c
    crossings : Crossings, of spheres by photons in this water
    counts : PlaneCounts, of planes
    """
    spheres = np.log(crossings.depths)
    nearest, farthest = (float(depth) for depth in crossings.depths[[0, -1]])
    rows = _depth_axis(nearest, farthest).nodes()
    once = once_scattered(phase, albedo, farthest)
    fit = fit_rings(crossings, ANGLE_AXIS.nodes())
    gain = _loss(albedo) * crossings.depths - 2 * spheres
    log_value, ratio, log_error = (
        CubicSpline(spheres, curves)(np.log(rows))
        for curves in (fit.log_value + gain[:, np.newaxis], fit.ratio, np.log(fit.log_error))
    )
    theta, depth = np.meshgrid(ANGLE_AXIS.nodes(), rows)
    more = np.exp(log_value - _loss(albedo) * depth)
    share = more / (more + once.vector_irradiance(theta, depth, depth).real)
    multiple = np.stack([log_value, ratio], axis=-1)
    error = share * np.exp(log_error)
    spread = Spread(once, nearest, farthest, multiple, error, np.zeros(SHAPE))
    return replace(spread, horizon=fit_planes(counts, spread.more))


def _depth_axis(nearest: float, farthest: float) -> LogAxis:
    return LogAxis(nearest, farthest, DEPTHS)


def _loss(albedo: float) -> float:
    return 1 - albedo / 2
