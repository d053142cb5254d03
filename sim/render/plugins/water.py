"""The water's phase function and the spread of beams in tables for kernels.

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
from sim.render.plugins.arrays import floats, opaque
from sim.water.spread import (
    ANGLE_AXIS,
    COSINE_AXIS,
    FARTHEST_RAD,
    HORIZON_ANGLES,
    NEAREST_RAD,
    LogAxis,
    Spread,
    horizon_depths,
)

# The water's phase function in tables: its value, and angles drawn from it two ways.

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
    table: PhaseTable, origin: mi.Point3f, direction: mi.Vector3f, end: mi.Float, point: mi.Point3f
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


# The tables of a beam's scattered light (sim.water.spread) for kernels; lengths in mm.


TINY = 1e-9  # smaller than the first node of every axis

Pair = tuple[mi.Float, mi.Float]


class SpreadLookup:
    """A beam's scattered light at a point: four reads of a table, each between its nodes."""

    def __init__(self, spread: Spread, extinction_per_mm: float) -> None:
        """Copy the tables.

        Parameters
        ----------
        spread : Spread, of the water
        extinction_per_mm : float, the water's attenuation, 1/mm
        """
        once = spread.once.table
        depths = horizon_depths(spread.nearest, spread.farthest)
        self.once = _KernelTable(
            np.stack([once.real, once.imag], axis=-1), spread.once.across_axis, ANGLE_AXIS
        )
        self.multiple = _KernelTable(spread.multiple, spread.depth_axis, ANGLE_AXIS)
        self.horizon = _KernelTable(spread.horizon, COSINE_AXIS, depths, HORIZON_ANGLES)
        self.extinction = opaque(extinction_per_mm)
        self.albedo, self.loss = opaque(spread.once.albedo), opaque(spread.loss)

    def received(
        self,
        origin: mi.Point3f,
        direction: mi.Vector3f,
        point: mi.Point3f,
        normal: mi.Vector3f,
        end: mi.Float,
    ) -> mi.Float:
        """What a plane surface at a point receives from a beam of unit power, 1/mm2.

        Parameters
        ----------
        origin, direction : of the beam, mm and of length 1
        point, normal : of the surface, mm and of length 1; it faces the beam's origin
        end : mm, where the beam ends for light scattered once
        """
        offset = point - origin
        distance = dr.norm(offset)
        up = offset / distance
        apart = up - direction  # exact where the angle is small
        away = apart - up * dr.dot(apart, up)
        away /= dr.maximum(dr.norm(away), TINY)
        theta = angle_between(up, direction)
        cosine = dr.maximum(-dr.dot(up, normal), 0)
        return self.irradiance(theta, distance, cosine, dr.dot(away, normal), end)

    def vector_irradiance(self, theta: mi.Float, distance: mi.Float, end: mi.Float) -> Pair:
        """Radial and tangential part of the vector irradiance of a beam of unit power, 1/mm2.

        Parameters
        ----------
        theta : rad off the beam
        distance : mm from the beam's origin
        end : mm, where on the beam it ends for light scattered once
        """
        once, once_aside = self._once(theta, distance, end)
        more, more_aside = self._more(theta, distance)
        return once + more, once_aside + more_aside

    def irradiance(
        self, theta: mi.Float, distance: mi.Float, cosine: mi.Float, aside: mi.Float, end: mi.Float
    ) -> mi.Float:
        """What a plane surface receives from a beam of unit power, 1/mm2.

        Parameters
        ----------
        theta, distance, end : as of ``vector_irradiance``
        cosine : 0 to 1, of the angle between the surface's normal and the way back to the origin
        aside : the normal's tangential part
        """
        once, once_aside = self._once(theta, distance, end)
        more, more_aside = self._more(theta, distance)
        first = aside * dr.rsqrt(dr.maximum(1 - dr.square(cosine), 1e-12))
        even, odd, double = self.horizon(cosine, self.extinction * distance, theta)
        missed = (1 - cosine) * (even + odd * first + double * (2 * dr.square(first) - 1))
        plain = (once + more) * cosine - (once_aside + more_aside) * aside
        return dr.maximum(plain + more * missed, 0)

    def _once(self, theta: mi.Float, distance: mi.Float, end: mi.Float) -> Pair:
        """What was scattered once, before ``end`` (sim.water.spread)."""
        theta = dr.clip(theta, NEAREST_RAD, FARTHEST_RAD)
        depth, end = self.extinction * distance, self.extinction * end
        sine, cosine = dr.sincos(theta)
        across, ahead = depth * sine, depth * cosine - end
        onward = dr.hypot(across, ahead)
        seen = dr.maximum(dr.atan2(across, ahead), NEAREST_RAD)
        near, near_aside = self.once(across, theta)
        far, far_aside = self.once(across, seen)
        turn_sine, turn_cosine = dr.sincos(seen - theta)
        scale = dr.square(self.extinction) * self.albedo / across
        before = scale * dr.exp(-depth) / theta
        behind = scale * dr.exp(-(end + onward)) / seen
        radial = before * near - behind * (far * turn_cosine - far_aside * turn_sine)
        aside = before * near_aside - behind * (far * turn_sine + far_aside * turn_cosine)
        return radial, aside

    def _more(self, theta: mi.Float, distance: mi.Float) -> Pair:
        """What was scattered more than once."""
        depth = self.extinction * distance
        log_value, ratio = self.multiple(depth, theta)
        more = dr.square(self.extinction) * dr.exp(log_value - self.loss * depth)
        return more, more * ratio


class _KernelTable:
    """A table of a few numbers a node, linear between its nodes and held at its edges."""

    def __init__(self, table: Floats, *axes: LogAxis) -> None:
        self.axes = [
            (opaque(axis.offset), opaque(axis.start), opaque(axis.scale), axis.count)
            for axis in axes
        ]
        tensor = mi.TensorXf(np.ascontiguousarray(table, dtype=np.float32))
        self.point = {2: mi.Point2f, 3: mi.Point3f}[len(axes)]
        # Units that interpolate in hardware keep 8 bits of a place.
        texture = {2: mi.Texture2f, 3: mi.Texture3f}[len(axes)]
        self.texture = texture(tensor, use_accel=False)

    def __call__(self, *values: mi.Float) -> list[mi.Float]:
        places: list[mi.Float] = []
        for value, (offset, start, scale, count) in zip(values, self.axes, strict=True):
            place = (dr.log(dr.maximum(value + offset, TINY)) - start) * scale
            places.insert(0, (place + 0.5) / count)
        return self.texture.eval(self.point(*places))
