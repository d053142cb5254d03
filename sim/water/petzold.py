"""Petzold's average particle: the phase function measured in natural waters, from its table."""

from dataclasses import dataclass
from functools import cache

import numpy as np

from lscan.records import Floats

# Degrees and 1/sr (Petzold 1972, averaged as in Mobley 1994).
TABLE_DEG, TABLE_PER_SR = np.array(
    [
        (0.1, 1.7826e3), (0.1259, 1.3074e3), (0.1585, 9.5877e2), (0.1995, 7.0541e2),
        (0.2512, 5.1833e2), (0.3162, 3.7978e2), (0.3981, 2.7882e2), (0.5012, 2.0302e2),
        (0.6310, 1.4567e2), (0.7944, 1.0317e2), (1, 7.2256e1), (1.259, 5.0029e1),
        (1.585, 3.4258e1), (1.995, 2.3019e1), (2.512, 1.5299e1), (3.162, 1.0106e1),
        (3.981, 6.6391), (5.012, 4.3341), (6.310, 2.8323), (7.943, 1.8357), (10, 1.1630),
        (15, 4.9377e-1), (20, 2.4663e-1), (25, 1.4848e-1), (30, 8.6863e-2), (35, 5.9844e-2),
        (40, 4.2479e-2), (45, 3.0950e-2), (50, 2.2959e-2), (55, 1.7144e-2), (60, 1.3244e-2),
        (65, 1.0557e-2), (70, 8.5650e-3), (75, 7.0391e-3), (80, 5.8952e-3), (85, 4.9979e-3),
        (90, 4.3311e-3), (95, 3.8158e-3), (100, 3.4348e-3), (105, 3.1441e-3), (110, 2.9386e-3),
        (115, 2.8223e-3), (120, 2.7100e-3), (125, 2.5947e-3), (130, 2.4984e-3), (135, 2.3982e-3),
        (140, 2.3500e-3), (145, 2.3340e-3), (150, 2.3861e-3), (155, 2.5285e-3), (160, 2.6859e-3),
        (165, 2.8604e-3), (170, 3.0579e-3), (175, 3.1200e-3), (180, 3.1822e-3),
    ]
).T  # fmt: skip
TABLE_RAD = np.radians(TABLE_DEG)
FORWARD_SLOPE = -1.346  # of log p over log angle below 0.1 degrees
SMALLEST_RAD = 1e-100  # below, the density is held: its power law is infinite at 0
NODES_A_CELL = 16  # of Gauss and Legendre; 8 give the integral to 1e-13 as well


@dataclass(frozen=True)
class PetzoldTable:
    """Petzold's table, interpolated in the logarithms of value and angle.

    Straight lines there keep what the table's author had of it: before the normalisation to 1
    done here the integral is 0.999935 (published: 0.99994), then the mean cosine is 0.92397 and
    the backscattered share 0.018295, as published.  Curves (a monotone cubic, a spline) round
    the corners but make the integral 1.0014 to 1.0016 and the share 0.01825.
    """

    def density(self, angle: Floats) -> Floats:
        """Phase function, 1/sr; same shape as ``angle``.

        Parameters
        ----------
        angle : array, scattering angle in rad; 0 is forward
        """
        return table_density(angle) / table_integral()


def table_density(angle: Floats) -> Floats:
    """The table's own value, 1/sr, at angles in rad; not normalised."""
    log_angle = np.log(np.maximum(angle, SMALLEST_RAD))
    log_first = np.log(TABLE_RAD[0])
    inside = np.interp(log_angle, np.log(TABLE_RAD), np.log(TABLE_PER_SR))
    return np.exp(inside + FORWARD_SLOPE * np.minimum(log_angle - log_first, 0))


@cache
def table_integral() -> float:
    """Integral of the table over the sphere: Gauss and Legendre's rule in each of its cells.

    Below 0.1 degrees the power law is integrated in closed form, where the angle is its sine
    to 5e-7.
    """
    node, weight = np.polynomial.legendre.leggauss(NODES_A_CELL)
    low, high = np.log(TABLE_RAD[:-1, np.newaxis]), np.log(TABLE_RAD[1:, np.newaxis])
    angle = np.exp((low + high) / 2 + (high - low) / 2 * node)
    rings = 2 * np.pi * np.sin(angle) * angle * table_density(angle)
    forward = 2 * np.pi * TABLE_PER_SR[0] * TABLE_RAD[0] ** 2 / (2 + FORWARD_SLOPE)
    return float(forward + np.sum((high - low) / 2 * weight * rings))
