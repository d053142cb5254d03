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
from scipy.interpolate import CubicSpline

from lscan.records import Floats
from sim.water.axes import ANGLE_AXIS, NEAREST_RAD, Complex, LogAxis, between_nodes
from sim.water.planes import (
    COSINE_AXIS,
    HORIZON_ANGLES,
    SHAPE,
    PlaneCounts,
    fit_planes,
    harmonics,
    horizon_depths,
)
from sim.water.rings import Crossings, fit_rings
from sim.water.single import OnceScattered, once_scattered

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
