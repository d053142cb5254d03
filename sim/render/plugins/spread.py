"""The tables of a beam's scattered light (sim.water.spread) for kernels; lengths in mm."""

import drjit as dr
import mitsuba as mi
import numpy as np

from lscan.records import Floats
from sim.render.plugins.opaque import opaque
from sim.render.plugins.phase import angle_between
from sim.water.planes import COSINE_AXIS, HORIZON_ANGLES, horizon_depths
from sim.water.spread import ANGLE_AXIS, FARTHEST_RAD, NEAREST_RAD, LogAxis, Spread

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
