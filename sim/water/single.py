"""Light of a pencil beam that the water scattered exactly once, by quadrature.

The beam runs from the origin along +z.  A point at the distance r, theta off the axis, receives
light from every place z of the axis, turned by psi.  With h = r sin(theta) and
dz = h dpsi / sin2(psi) the inverse square cancels, and the path is r cos(theta) + h tan(psi / 2).
So the vector irradiance, its radial part real and its tangential part (away from the axis)
imaginary, is

    F = b / h [exp(-c r) J(theta) - exp(-c (t + l)) exp(i (psi_t - theta)) J(psi_t)],
    J(psi) = integral over a from psi to pi of
             p(a) exp(i (a - psi) - c h (tan(a / 2) - tan(psi / 2)))

where the beam ends at the distance t, from where the point is seen under psi_t at the distance l
(docs/explanation/physics.md, section 8).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lscan.records import Floats
from sim.water.axes import ANGLE_AXIS, NEAREST_RAD, Complex, LogAxis, between_nodes

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
