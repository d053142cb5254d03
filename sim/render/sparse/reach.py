"""How far a sheet's light gets into the tank before a surface stops it."""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from sim.render.plugins.sheet import LaserSheet

NODES = 2048  # across a fan of 70 degrees: 0.36 mm at 600 mm, a third of a usual pixel
# Places across the sheet, in half widths: beyond, 0.3 % of its light is left on either side.
ACROSS = (-1.4, 0.0, 1.4)


@dataclass(frozen=True)
class SheetReach:
    """Where rays of the sheet first meet a surface, at NODES angles from edge to edge of the fan.

    nearest, farthest: over the places across the sheet, rho in mm.  half_angle: the fan's.
    """

    nearest: mi.Float
    farthest: mi.Float
    half_angle: mi.Float

    def shows(self, phi: mi.Float, rho: mi.Float) -> tuple[mi.Bool, mi.Bool]:
        """Whether all the light of the sheet reaches a place, and whether none does."""
        place = (phi / self.half_angle + 1) * (0.5 * (NODES - 1))
        cell = dr.clip(mi.UInt32(dr.maximum(place, 0)), 0, NODES - 2)
        near = dr.minimum(*(dr.gather(mi.Float, self.nearest, cell + k) for k in (0, 1)))
        far = dr.maximum(*(dr.gather(mi.Float, self.farthest, cell + k) for k in (0, 1)))
        return rho < near, rho > far


def sheet_reach(scene: mi.Scene, sheet: LaserSheet) -> SheetReach:
    """The reach of the sheet where it stands; rays widen across it as it does."""
    phi = sheet.half_angle * (dr.arange(mi.Float, NODES) * (2 / (NODES - 1)) - 1)
    middle, apex = sheet.direction(phi), sheet.apex(mi.Float(0))
    width = sheet.half_width(mi.Float(0))
    # The length of a direction is 1 in the fan's plane: distances along it are rho.
    rho = scene.ray_intersect_preliminary(mi.Ray3f(apex, middle), coherent=True).t
    rho = dr.minimum(rho, dr.maximum(dr.abs(sheet.waist_distance), 100.0))
    widens = (sheet.half_width(rho) - width) / rho
    nearest, farthest = mi.Float(dr.inf), mi.Float(0)
    for share in ACROSS:
        origin = apex + sheet.normal * (share * width)
        way = middle + sheet.normal * (share * widens)
        met = scene.ray_intersect_preliminary(mi.Ray3f(origin, way), coherent=True).t
        nearest, farthest = dr.minimum(nearest, met), dr.maximum(farthest, met)
    reach = SheetReach(nearest, farthest, sheet.half_angle)
    dr.eval(reach)
    return reach
