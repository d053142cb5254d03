"""The water's phase function in tables: its value, and angles drawn from it two ways.

Scattering that happens somewhere along a line, of light that comes from (or goes to) one
point, has the angle psi between the line and that point's direction as its natural
coordinate: with dt / r2 = dpsi / h the inverse square cancels, h being the point's distance
from the line (equiangular sampling).  So angles are drawn along a line with the density
p(psi), and in directions with p(psi) sin(psi).
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import log1p, pi

import drjit as dr
import mitsuba as mi
import numpy as np

from lscan.records import Floats
from sim.render.plugins.arrays import floats

# Cells, evenly spaced in log(1 + psi / FINEST): fine where an oceanic forward peak is, which
# rises down to the least angles.  A cell is 0.4 % of its angle wide, so that the logarithm of
# a peak as steep as psi^-2, taken as linear within it, is off by 1e-5.
CELLS = 3072
FINEST = 1e-5
SCALE = CELLS / log1p(pi / FINEST)
# Within the first cell, 4e-8 rad, an oceanic peak that is infinite forward is taken as flat:
# at its mean, integrated from the second angle here up.  Along a line, where that mean would
# be infinite too, angles are drawn as if it were flat from the first.  With a first cell of
# 4e-6 rad, light scattered once on its way to a thin sheet's line came out 0.9 % too low.
FLAT, NEAREST = 1e-8, 1e-14
WITHIN = 16  # points a cell for its integrals


class PhaseTable:
    """A phase function for kernels; angles in radians, values in 1/sr."""

    def __init__(self, phase: Callable[[Floats], Floats]) -> None:
        """Tabulate ``phase``, a function of the angle whose integral over the sphere is 1."""
        place = np.arange(CELLS * WITHIN + 1) / WITHIN
        angle = FINEST * np.expm1(place / SCALE)
        angle[-1] = pi
        value = phase(np.maximum(angle, FLAT))
        steps = np.diff(angle)
        middle = 0.5 * (value[1:] + value[:-1])
        turned = 2 * np.sin(angle / 2) ** 2  # 1 - cos, exact near forward
        along = (middle * steps).reshape(CELLS, WITHIN).sum(axis=1)
        around = (2 * pi * middle * np.diff(turned)).reshape(CELLS, WITHIN).sum(axis=1)
        nodes, values = angle[::WITHIN], value[::WITHIN].copy()
        around[0] = _within(phase, nodes[1])
        values[0] = max(around[0] / (2 * pi * turned[WITHIN]), values[1])
        self.nodes = floats(nodes)
        self.log_value = floats(np.log(values))
        line = np.concatenate([[0.0], np.cumsum(along)])
        # Counted from the middle, so that the faint backward half keeps its digits.
        self.line = floats(line - np.interp(pi / 2, nodes, line))
        self.sphere = floats(np.concatenate([[0.0], np.cumsum(around / around.sum())]))
        self.turned = floats(turned[::WITHIN])

    def value(self, angle: mi.Float) -> mi.Float:
        """The phase function at an angle."""
        cell, part = self._place(angle)
        return dr.exp(dr.lerp(*_pair(self.log_value, cell), part))

    def line_integral(self, angle: mi.Float) -> mi.Float:
        """Integral of the phase function over angles, up to ``angle`` from a fixed one."""
        cell, _ = self._place(angle)
        low, high = _pair(self.nodes, cell)
        return dr.lerp(*_pair(self.line, cell), (angle - low) / (high - low))

    def line_density(self, angle: mi.Float) -> mi.Float:
        """Density, not normalised, of the angles that ``sample_line`` draws."""
        cell, _ = self._place(angle)
        low, high = _pair(self.nodes, cell)
        below, above = _pair(self.line, cell)
        return (above - below) / (high - low)

    def sample_line(self, below: mi.Float, above: mi.Float, sample: mi.Float) -> mi.Float:
        """An angle between two others, given by their line integrals."""
        wanted = dr.lerp(below, above, sample)
        cell = _search(self.line, wanted)
        low, high = _pair(self.line, cell)
        part = dr.select(high > low, (wanted - low) / (high - low), 0.5)
        return dr.lerp(*_pair(self.nodes, cell), dr.clip(part, 0, 1))

    def sample_direction(self, direction: mi.Vector3f, sample: mi.Point2f) -> mi.Vector3f:
        """A direction scattered from ``direction``, drawn with ``direction_density``."""
        cell = _search(self.sphere, sample.x)
        low, high = _pair(self.sphere, cell)
        part = dr.clip((sample.x - low) / (high - low), 0, 1)
        turned = dr.lerp(*_pair(self.turned, cell), part)
        sine = dr.safe_sqrt(turned * (2 - turned))
        s, c = dr.sincos(2 * pi * sample.y)
        scattered = mi.Frame3f(direction).to_world(mi.Vector3f(sine * c, sine * s, 1 - turned))
        return dr.normalize(scattered)

    def direction_density(self, angle: mi.Float) -> mi.Float:
        """Probability per steradian of a direction at an angle: constant in each cell."""
        cell, _ = self._place(angle)
        low, high = _pair(self.sphere, cell)
        near, far = _pair(self.turned, cell)
        return (high - low) / (2 * pi * (far - near))

    def _place(self, angle: mi.Float) -> tuple[mi.UInt32, mi.Float]:
        place = dr.log(1 + angle / FINEST) * SCALE
        cell = dr.clip(mi.UInt32(place), 0, CELLS - 1)
        return cell, dr.clip(place - mi.Float(cell), 0, 1)


@dataclass(frozen=True)
class Approach:
    """A line, and a point that light scattered on the line goes to or comes from.

    The line runs from 0 to ``end`` along a unit direction; a place on it is ``foot`` less
    ``beside`` times the cotangent of the scattering angle.  below, above: the phase
    function's line integrals at the two ends.
    """

    foot: mi.Float
    beside: mi.Float
    below: mi.Float
    above: mi.Float

    def sample(self, table: PhaseTable, sample: mi.Float) -> mi.Float:
        """A place on the line, drawn with the density of ``density``."""
        angle = table.sample_line(self.below, self.above, sample)
        sine, cosine = dr.sincos(angle)
        return self.foot - self.beside * cosine / dr.maximum(sine, 1e-9)

    def density(self, table: PhaseTable, place: mi.Float) -> mi.Float:
        """Probability per mm of drawing a place."""
        ahead = self.foot - place
        squared = dr.square(ahead) + dr.square(self.beside)
        mass = dr.maximum(self.above - self.below, 1e-30)
        angle = dr.atan2(self.beside, ahead)
        return table.line_density(angle) / mass * self.beside / squared


def approach(
    table: PhaseTable,
    origin: mi.Point3f,
    direction: mi.Vector3f,
    end: mi.Float,
    point: mi.Point3f,
) -> Approach:
    """The line from ``origin`` seen from ``point``."""
    offset = point - origin
    foot = dr.dot(offset, direction)
    beside = dr.maximum(dr.norm(offset - direction * foot), 1e-5)
    below = table.line_integral(dr.atan2(beside, foot))
    above = table.line_integral(dr.atan2(beside, foot - end))
    return Approach(foot, beside, below, above)


def angle_between(a: mi.Vector3f, b: mi.Vector3f) -> mi.Float:
    """The angle between two unit vectors, rad, exact for small ones.

    Parameters
    ----------
    a, b : Vector3f, of length 1
    """
    return 2 * dr.safe_asin(0.5 * dr.norm(a - b))


def _within(phase: Callable[[Floats], Floats], angle: float) -> float:
    """Share of the light that is scattered by less than a small angle."""
    fine = np.geomspace(NEAREST, angle, 4001)
    rings = 2 * pi * phase(fine) * fine**2  # of an equal step of the logarithm
    return float(np.trapezoid(rings, np.log(fine)))


def _search(table: mi.Float, value: mi.Float) -> mi.UInt32:
    """The cell of a rising table that holds ``value``."""
    found = dr.binary_search(0, CELLS, lambda index: dr.gather(mi.Float, table, index) <= value)
    return dr.clip(found, 1, CELLS) - 1


def _pair(table: mi.Float, cell: mi.UInt32) -> tuple[mi.Float, mi.Float]:
    return dr.gather(mi.Float, table, cell), dr.gather(mi.Float, table, cell + 1)
