"""How much of the light that a sheet's rays scatter onto a surface other surfaces let through.

Most of it comes along the ray that meets the surface.  Where that is stopped, a place in shadow
receives a fraction of what is received beside it: light on either side is kept apart.
"""

from math import pi

import drjit as dr
import mitsuba as mi

from sim.render.plugins.phase import PhaseTable
from sim.render.plugins.sheet import LaserSheet

# Rays of the sheet that stand for all, and places on each: of equal shares of the light that is
# scattered once where it falls off as the square of the distance from the ray.
RAYS, PLACES = 6, 4
START_MM = 0.01  # off the surface


def visible_share(
    scene: mi.Scene,
    sheet: LaserSheet,
    phase: PhaseTable,
    point: mi.Point3f,
    normal: mi.Vector3f,
) -> mi.Float:
    """Share of the sheet's light, scattered once, that gets to places of surfaces, 0 to 1.

    Parameters
    ----------
    scene : mi.Scene
    sheet : LaserSheet, where it is placed
    phase : PhaseTable, of the water
    point : Point3f, mm, world frame
    normal : Vector3f, of the surface, on the side that is lit
    """
    lane = dr.arange(mi.UInt32, dr.width(point) * RAYS)
    index, ray = lane // RAYS, mi.Float(lane % RAYS)
    point, normal = dr.gather(mi.Point3f, point, index), dr.gather(mi.Vector3f, normal, index)
    phi, rho, s = sheet.coordinates(point, mi.Float(0))
    aside = dr.maximum(dr.abs(s), 0.5 * sheet.half_width(rho))
    angle = phi + aside * dr.tan(pi * ((ray + 0.5) / RAYS - 0.5)) / rho
    inside = dr.abs(angle) <= sheet.half_angle
    way = dr.normalize(sheet.direction(angle))
    apex = sheet.apex(mi.Float(0))
    ends = scene.ray_intersect_preliminary(mi.Ray3f(apex, way), active=inside).t
    offset = point - apex
    foot = dr.dot(offset, way)
    beside = dr.norm(offset - way * foot)
    below = phase.line_integral(dr.atan2(beside, foot))
    above = phase.line_integral(mi.Float(pi / 2))
    start, total, seen = point + normal * START_MM, mi.Float(0), mi.Float(0)
    for place in range(PLACES):
        turned = phase.sample_line(below, above, mi.Float((place + 0.5) / PLACES))
        along = dr.maximum(foot - beside / dr.tan(turned), 0)
        towards = apex + way * along - point
        distance = dr.norm(towards)
        towards /= distance
        weight = dr.select(inside, dr.maximum(dr.dot(towards, normal), 0), 0.0)
        total += weight
        lit = (weight > 0) & (along < ends)
        hidden = scene.ray_test(mi.Ray3f(start, towards, distance, 0.0, []), lit)
        seen += dr.select(lit & ~hidden, weight, 0.0)
    total, seen = dr.block_sum(total, RAYS), dr.block_sum(seen, RAYS)
    return dr.select(total > 0, seen / total, 1.0)


def sees_apex(
    scene: mi.Scene, sheet: LaserSheet, point: mi.Point3f, normal: mi.Vector3f, active: mi.Bool
) -> mi.Bool:
    """Whether nothing lies between places and where a sheet's rays come from; False if inactive.

    Parameters
    ----------
    scene, sheet, point, normal : as those of ``visible_share``
    active : Bool, the places that are asked for
    """
    start = point + normal * START_MM
    way = sheet.apex(mi.Float(0)) - start
    far = dr.norm(way)
    ray = mi.Ray3f(start, way / far, far, 0.0, [])
    return active & (dr.dot(way, normal) > 0) & ~scene.ray_test(ray, active)
