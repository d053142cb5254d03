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
from itertools import product
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, CubicSpline
from scipy.ndimage import map_coordinates
from scipy.sparse import coo_array, csc_array, eye_array, kron
from scipy.sparse.linalg import spsolve

from lscan.records import Floats, Mask

# Axes of the tables of scattered light, and interpolation between their nodes.


@dataclass(frozen=True)
class LogAxis:
    """``count`` nodes from ``low`` to ``high``, evenly spaced in log(offset + x)."""

    low: float
    high: float
    count: int
    offset: float = 0.0

    @property
    def start(self) -> float:
        """The logarithm at the first node."""
        return float(np.log(self.low + self.offset))

    @property
    def scale(self) -> float:
        """Nodes per unit of the logarithm."""
        return float((self.count - 1) / (np.log(self.high + self.offset) - self.start))

    def nodes(self) -> Floats:
        """(count,) x at the nodes."""
        nodes = np.exp(self.start + np.arange(self.count) / self.scale) - self.offset
        nodes[[0, -1]] = self.low, self.high
        return nodes

    def place(self, x: Floats) -> Floats:
        """Where x lies, in nodes from the first; same shape.

        Parameters
        ----------
        x : array, between ``low`` and ``high`` or beyond
        """
        return (np.log(x + self.offset) - self.start) * self.scale


Complex = NDArray[np.complex128]
Values = TypeVar("Values", Floats, Complex)

NEAREST_RAD = 1e-6  # below, light scattered once falls as 1 / angle, and little else is left
ANGLE_AXIS = LogAxis(NEAREST_RAD, np.pi, 512)


def between_nodes(table: Values, *places: Floats) -> Values:
    """Values of a table, linear between its nodes and held at its edges; shape of the places.

    Parameters
    ----------
    table : array of as many dimensions as there are places, real or complex
    *places : arrays, each in nodes of its dimension from the first; shapes broadcast
    """
    shape = np.broadcast_shapes(*(np.shape(place) for place in places))
    flat = [np.ravel(np.broadcast_to(place, shape)) for place in places]
    return np.reshape(map_coordinates(table, flat, order=1, mode="nearest"), shape)


# What a plane surface receives of light scattered more than once, beside its vector irradiance.
#
# A photon that leaves a sphere may come from below a surface's horizon, and light from beyond the
# sphere but in front of the surface is missing: -(F . n) is short of the irradiance by
#
#     F_r (1 - cos(beta)) (d0 + d1 cos(chi) + d2 cos(2 chi)),
#
# n = (-cos(beta), sin(beta) cos(chi), sin(beta) sin(chi)) being the surface's normal in the radial,
# the tangential and the third direction.  The d are fitted to photons at their first crossings of
# planes of several tilts and distances.  They are linear between the nodes of a table over
# cos(beta), the optical depth and the angle off the beam.

# Cells of a plane: angle off the beam by azimuth about it, 0 where the plane is farther away.
PLANE_RINGS_FROM, PLANE_RINGS_TO, PLANE_RINGS, SECTORS = 0.01, 1.4, 24, 8
GAUSS = 3  # places across a cell's angle, of Gauss and Legendre
SHAPE = COSINES, PLANE_DEPTHS, ANGLES, HARMONICS = 5, 6, 10, 3  # of the table
HORIZON_ANGLES = LogAxis(PLANE_RINGS_FROM, PLANE_RINGS_TO, ANGLES)
COSINE_AXIS = LogAxis(0.0, 1.0, COSINES, 1.0)
# Standard deviations a priori: of second differences between nodes, and of the d.
BENT, LARGE = 0.1, 1.0
STEEPEST = 0.05  # cosine of the largest angle at which a cell is used


@dataclass(frozen=True)
class PlaneCounts:
    """Photons scattered more than once, at their first crossings of planes.

    Attributes
    ----------
    photons : int, photons sent to each tilt
    tilts : (T,) rad, between the planes' normals and the beam
    distances : (K,) where the planes cross the beam, optical depths
    weight : (T, K, PLANE_RINGS, SECTORS) sums of the photons' weights, over tilts, planes and cells
    """

    photons: int
    tilts: Floats
    distances: Floats
    weight: Floats


def horizon_depths(nearest: float, farthest: float) -> LogAxis:
    """The table's optical depths.

    Parameters
    ----------
    nearest, farthest : float, smallest and largest
    """
    return LogAxis(nearest, farthest, PLANE_DEPTHS)


def harmonics(cosine: Floats, aside: Floats) -> Floats:
    """(HARMONICS, ...) what the d are multiplied by: 1 - cos(beta) times 1, cos(chi), cos(2 chi).

    Parameters
    ----------
    cosine : array, cos(beta)
    aside : array of the same shape, the normal's tangential part
    """
    first = aside / np.sqrt(np.maximum(1 - cosine**2, 1e-12))
    return (1 - cosine) * np.stack([np.ones_like(first), first, 2 * first**2 - 1])


def fit_planes(counts: PlaneCounts, more: Callable[[Floats, Floats], Complex]) -> Floats:
    """(COSINES, PLANE_DEPTHS, ANGLES, HARMONICS) d at the table's nodes.

    Parameters
    ----------
    counts : PlaneCounts, of the water
    more : function of (theta, depth) that gives F_r + i F_t of light scattered more than once
    """
    theta, azimuth, solid = _cells()
    tilt = counts.tilts.reshape(-1, 1, 1, 1, 1)
    distance = counts.distances.reshape(-1, 1, 1, 1)
    sine, along = np.sin(theta) * np.cos(azimuth), np.cos(theta) * np.cos(azimuth)
    cosine = np.cos(theta) * np.cos(tilt) - sine * np.sin(tilt)
    aside = along * np.sin(tilt) + np.sin(theta) * np.cos(tilt)
    depth = distance * np.cos(tilt) / np.maximum(cosine, STEEPEST)
    every = np.broadcast_arrays(theta, solid, cosine, aside, depth)
    # Cells that reach beyond the plane's horizon or the spheres are left out.
    low, high = counts.distances[[0, -1]]
    whole: Mask = ((cosine > STEEPEST) & (depth >= low) & (depth <= high)).all(axis=-1)
    theta, solid, cosine, aside, depth = (values[whole] for values in every)
    light = more(theta, depth)
    # A plane's area is r2 / cos(beta) of the solid angle it is seen under.
    scale = counts.photons * solid * depth**2 * light.real / cosine
    plain = scale * (cosine - light.imag / light.real * aside)
    spread = np.sqrt(np.sum(np.maximum(plain, STEEPEST * scale), axis=1))
    places = (
        COSINE_AXIS.place(cosine),
        horizon_depths(low, high).place(depth),
        HORIZON_ANGLES.place(theta),
    )
    design = _design(places, harmonics(cosine, aside) * scale / spread[:, np.newaxis])
    missed = (counts.weight[whole] - plain.sum(axis=1)) / spread
    found = spsolve(csc_array(design.T @ design + _prior()), design.T @ missed)
    return np.reshape(found, SHAPE)


def _cells() -> tuple[Floats, Floats, Floats]:
    """Angles, azimuths and solid angles (both sides of the beam) of places in cells.

    They broadcast to (PLANE_RINGS, SECTORS, GAUSS).
    """
    edges = np.log(np.geomspace(PLANE_RINGS_FROM, PLANE_RINGS_TO, PLANE_RINGS + 1))
    node, weight = np.polynomial.legendre.leggauss(GAUSS)
    half = np.diff(edges)[0] / 2
    theta = np.exp(edges[:-1, np.newaxis, np.newaxis] + half * (1 + node))
    azimuth = (np.arange(SECTORS)[:, np.newaxis] + 0.5) * np.pi / SECTORS
    return theta, azimuth, 2 * np.pi / SECTORS * np.sin(theta) * theta * half * weight


def _design(places: tuple[Floats, ...], factors: Floats) -> csc_array:
    """(N, M) what each of the table's numbers adds to each of N cells, summed over (N, G) places.

    factors: (HARMONICS, N, G).
    """
    sizes = SHAPE[:3]
    lows = [
        np.clip(place.astype(int), 0, size - 2) for place, size in zip(places, sizes, strict=True)
    ]
    parts = [np.clip(place - low, 0, 1) for place, low in zip(places, lows, strict=True)]
    cells, numbers = factors.shape[1], int(np.prod(SHAPE))
    row = np.broadcast_to(np.arange(cells)[:, np.newaxis], factors.shape[1:])
    total = csc_array((cells, numbers))
    for corner in product((0, 1), repeat=3):
        node = np.ravel_multi_index([low + up for low, up in zip(lows, corner, strict=True)], sizes)
        share = np.prod(
            [part if up else 1 - part for part, up in zip(parts, corner, strict=True)], axis=0
        )
        for harmonic, factor in enumerate(factors):
            column = node * HARMONICS + harmonic
            entries = (share * factor).ravel(), (row.ravel(), column.ravel())
            total = total + coo_array(entries, shape=total.shape).tocsc()
    return total


def _prior() -> csc_array:
    """(M, M) inverse covariance a priori of the table's numbers."""
    total = eye_array(int(np.prod(SHAPE))) / LARGE**2
    for axis in range(3):
        second = np.diff(np.eye(SHAPE[axis]), 2, axis=0)
        before, behind = np.prod(SHAPE[:axis], dtype=int), np.prod(SHAPE[axis + 1 :], dtype=int)
        bent = kron(kron(eye_array(before), second.T @ second), eye_array(behind))
        total = total + bent / BENT**2
    return csc_array(total)


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
    horizon : (COSINES, PLANE_DEPTHS, ANGLES, HARMONICS) of ``PlaneCounts``
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
