"""Where the sheets' rays end: the lit line as points of light, for all that they light in turn."""

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from sim.render.ambient.field import reflectance
from sim.render.plugins.beams import straight_rays
from sim.render.plugins.sheet import LaserSheet

ANGLES = 1024  # across the fan: two thirds of a usual pixel
# Gauss and Hermite's nodes across the sheet, in standard deviations, which keep its variance.
ACROSS, SHARES = (-np.sqrt(3), 0.0, np.sqrt(3)), (1 / 6, 2 / 3, 1 / 6)


@dataclass(frozen=True)
class LitPoints:
    """Points of the lines of all sheets, in the world.

    point: mm.  power: radiance times area of the surface, mW/sr, of matt surfaces.  normal: on
    the side that the laser lights.
    """

    point: mi.Point3f
    normal: mi.Normal3f
    power: mi.Float


def lit_points(scene: mi.Scene, sheets: Sequence[LaserSheet], extinction: mi.Float) -> LitPoints:
    """The lines of sheets where they are placed.

    extinction: of the water, 1/mm.
    """
    lines = [_line(scene, sheet, extinction) for sheet in sheets]
    if len(lines) == 1:
        return lines[0]
    columns = zip(*((*line.point, *line.normal, line.power) for line in lines), strict=True)
    px, py, pz, nx, ny, nz, power = (dr.concat(column) for column in columns)
    return LitPoints(mi.Point3f(px, py, pz), mi.Normal3f(nx, ny, nz), power)


def _line(scene: mi.Scene, sheet: LaserSheet, extinction: mi.Float) -> LitPoints:
    lane = dr.arange(mi.UInt32, ANGLES * len(ACROSS))
    number, across = lane % ANGLES, lane // ANGLES
    phi = sheet.half_angle * ((mi.Float(number) + 0.5) * (2 / ANGLES) - 1)
    rays = straight_rays(scene, sheet, phi, mi.Float(0), mi.Bool(True))
    nodes = mi.Float([float(x) for x in ACROSS]), mi.Float([float(x) for x in SHARES])
    offset, share = (dr.gather(mi.Float, node, across) for node in nodes)
    origin, way = rays.line(offset)
    way = dr.normalize(way)
    si = scene.ray_intersect(mi.Ray3f(origin, way), mi.RayFlags.All, coherent=True)
    step = sheet.half_angle * (2 / ANGLES)
    power = sheet.power_density(phi) * step * share * dr.exp(-extinction * si.t)
    power = dr.select(si.is_valid(), power * reflectance(si) / dr.pi, 0.0)
    normal = dr.select(dr.dot(si.n, way) > 0, -si.n, si.n)
    point = dr.select(si.is_valid(), si.p, origin)
    return LitPoints(point, mi.Normal3f(normal), power)
