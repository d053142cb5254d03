"""What each pixel's central ray meets, and in which pixels the laser's light is not even.

A ray that meets a surface far behind a sheet sees all of its veil, one that ends far before it
none; only where it ends within the sheet is there direct light.  A pixel whose neighbours all
see alike needs no more than its central ray.
"""

from dataclasses import dataclass

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from lscan.records import Ints, Mask
from sim.render.firstorder.rays import END, HeadRays
from sim.render.plugins.sheet import LaserSheet
from sim.render.sampled.beams import FARTHEST_MM
from sim.scene import Pose

# How far a sheet's light gets into the tank before a surface stops it.


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


# What each pixel's central ray meets, and in which pixels the laser's light is not even.


MIXED = 255  # of a pixel's state: any sheet's light is there in part
MOST_SHEETS = 7  # of which a state has room for a bit each, and is not MIXED
NEIGHBOURS = np.ones((3, 3), np.uint8)
# A surface is bent where its distance's second differences add up to more than this share of a
# pixel's width on it: a crease of 17 degrees seen from straight ahead.
BENT = 0.3


@dataclass(frozen=True)
class PixelSurvey:
    """One picture's central rays.

    veil: (H, W) radiance that the water scatters, where it is even, mW/(mm2 sr), the camera's
    weight included.  uneven: indices of the other pixels, row by row.  bent: (H, W) the pixels at
    which a surface ends, begins or is bent.  hit: what each of the rays meets; its distance t in
    mm is infinite where that is nothing.
    """

    veil: NDArray[np.float32]
    uneven: Ints
    bent: Mask
    hit: mi.PreliminaryIntersection3f


def survey(
    scene: mi.Scene, rays: HeadRays, head: Pose, reaches: tuple[SheetReach, ...]
) -> PixelSurvey:
    """What is seen with the head at a pose; reaches: of the sheets there."""
    hit = scene.ray_intersect_preliminary(rays.seen_from(head), coherent=True)
    distance = hit.t
    veil, state, mixed = mi.Float(0), mi.UInt32(0), mi.Bool(False)
    for number, (open_veil, reach) in enumerate(zip(rays.veils, reaches, strict=True)):
        behind = (distance - open_veil.crossing) / open_veil.sigma
        lit, dark = reach.shows(open_veil.phi, open_veil.rho)
        lit &= dr.abs(open_veil.phi) <= reach.half_angle
        dark |= dr.abs(open_veil.phi) > reach.half_angle
        whole = (behind > END) & lit
        none = (behind < -END) | ((behind > END) & dark)
        veil += dr.select(whole, open_veil.radiance, 0.0)
        state += dr.select(whole, mi.UInt32(1 << number), 0)
        mixed |= ~(whole | none)
    state = dr.select(mixed, MIXED, state)
    dr.eval(veil, state, hit)
    shape = rays.size_px[::-1]
    states = np.array(state).astype(np.uint8).reshape(shape)
    inner = np.s_[1:-1, 1:-1]
    light = np.ascontiguousarray(np.array(veil).reshape(shape)[inner])
    bent = _bent(np.array(distance).reshape(shape), rays.pixel_rad)[inner]
    return PixelSurvey(light, np.flatnonzero(_uneven(states)[inner]), bent, hit)


def _bent(distance: NDArray[np.float32], pixel_rad: float) -> Mask:
    """(H, W) the pixels that are no part of a plane with the four beside them."""
    distance = np.minimum(distance, np.float32(FARTHEST_MM))
    curved = cv2.Laplacian(distance, cv2.CV_32F, borderType=cv2.BORDER_REFLECT)
    return np.asarray(np.abs(curved) > BENT * pixel_rad * distance)


def _uneven(states: NDArray[np.uint8]) -> Mask:
    """(H, W) the pixels that are mixed or unlike any of their neighbours."""
    most, least = cv2.dilate(states, NEIGHBOURS), cv2.erode(states, NEIGHBOURS)
    return np.asarray((most == MIXED) | (most != least))
