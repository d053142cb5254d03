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
from sim.render.plugins.beams import FARTHEST_MM
from sim.render.sparse.rays import END, HeadRays
from sim.render.sparse.reach import SheetReach
from sim.scene import Pose

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
