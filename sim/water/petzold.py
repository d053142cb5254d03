"""Petzold's average particle: the phase function measured in natural waters, from its table."""

from dataclasses import dataclass
from functools import cache

import numpy as np

from lscan.files.disk import packaged_table
from lscan.records import Floats

TABLE_DEG, TABLE_PER_SR = np.array(packaged_table("sim.water", "tables.toml")["petzold"]).T
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
