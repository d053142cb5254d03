"""Penalised least squares: its weight by cross-validation, its covariance as a posterior.

A smooth surface with coefficients c is fitted to N values y with standard uncertainties
sigma: it minimises the sum of ((y - rows @ c) / sigma)² plus ``weight`` times the roughness
c @ R @ c.  The weight is that of the least generalised cross-validation score (Craven &
Wahba, Numer. Math. 31 (1979) 377), in which each degree of freedom counts 1.4 times, so
that chance rarely makes the surface too rough (Kim & Gu, J. R. Statist. Soc. B 66 (2004)
337).

The penalty is equivalent to a Gaussian prior of the surface, so the posterior of that
prior is the fit's covariance.  It holds the scatter and the bias of smoothing both: averaged
over the surface, its intervals contain the truth as often as they state (Nychka, J. Am.
Statist. Assoc. 83 (1988) 1134).
"""

from dataclasses import dataclass

import numpy as np

from lscan.records import Floats

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
