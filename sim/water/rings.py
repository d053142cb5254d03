"""Photons counted where they first cross spheres, and the smooth curves through their counts.

The counts of rings about the axis are fitted as a quasi-Poisson variable whose logarithm is a
cubic spline of the logarithm of the angle.  Its second differences are held small where hardly a
photon falls, within about 1e-4 rad of the axis, and are free where many do (Eilers & Marx 1996;
docs/explanation/physics.md, section 8).
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline

from lscan.records import Floats

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


def _prior(size: int) -> Floats:
    """(M, M) inverse covariance of the coefficients a priori."""
    second = np.diff(np.eye(size), 2, axis=0) / CURVATURE
    return np.asarray(second.T @ second + RIDGE * np.eye(size))


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
    normal = basis.T @ weighted + _prior(basis.shape[1])
    covariance = np.asarray(np.linalg.inv(normal), dtype=float)
    return covariance @ (weighted.T @ values), covariance


def _values(basis: Floats, found: Floats, covariance: Floats) -> tuple[Floats, Floats]:
    """(2, A) values of a spline and their standard errors."""
    return basis @ found, np.sqrt(np.einsum("am,mn,an->a", basis, covariance, basis))
