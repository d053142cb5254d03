"""The ambient layer from few rays: one in an even pixel, many where the picture is uneven."""

from math import isqrt

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from lscan.records import Ints
from sim.render.plugins.base import Leg
from sim.render.plugins.camera import RefractiveCamera
from sim.render.plugins.integrator import SheetIntegrator
from sim.render.sparse.rays import HeadRays, film_rays, sample_places
from sim.render.sparse.survey import NEIGHBOURS
from sim.scene import Pose

Picture = NDArray[np.float32]
# A pixel is even where the second differences of the light of centres are less than this part of
# it.  At a crease the centre differs from its pixel's mean by an 8th of either, 2.5e-3 together.
EVEN = 0.01


def ambient_picture(
    scene: mi.Scene,
    camera: RefractiveCamera,
    integrator: SheetIntegrator,
    rays: HeadRays,
    head: Pose,
    samples: int,
) -> Picture:
    """Ambient light, (f H, f W) in mW/(mm2 sr), of the fineness f of the camera.

    Parameters
    ----------
    scene : mi.Scene
    camera : RefractiveCamera, placed
    integrator : SheetIntegrator, which knows the scene's sky
    rays : HeadRays, of the camera
    head : Pose, where the camera is placed
    samples : int, of an uneven pixel, a square number in each of its parts
    """
    centre = _light(scene, integrator, rays.seen_from(head), rays.weight)
    dr.eval(centre)
    wide = np.array(centre).reshape(rays.size_px[::-1])
    across, along = (cv2.Sobel(wide, cv2.CV_32F, *order, ksize=1) for order in ((2, 0), (0, 2)))
    edges = (cv2.max(np.abs(across), np.abs(along)) > EVEN * wide).astype(np.uint8)
    inner = np.s_[1:-1, 1:-1]
    uneven = np.flatnonzero(cv2.dilate(edges, NEIGHBOURS)[inner])
    picture, fineness = np.ascontiguousarray(wide[inner]), camera.fineness
    height, width = picture.shape
    picture = picture.repeat(fineness, axis=0).repeat(fineness, axis=1)
    if uneven.size:
        row, column = np.divmod(uneven, width)
        parts = picture.reshape(height, fineness, width, fineness)
        size_px = (width, height)
        parts[row, :, column, :] = _sampled(scene, camera, integrator, uneven, size_px, samples)
    return picture


def _sampled(
    scene: mi.Scene,
    camera: RefractiveCamera,
    integrator: SheetIntegrator,
    pixels: Ints,
    size_px: tuple[int, int],
    samples: int,
) -> Picture:
    """(N, f, f) means in the parts of pixels over a regular grid of samples."""
    side, fineness = isqrt(samples), camera.fineness
    place, _ = sample_places(pixels, size_px, side)
    light = _light(scene, integrator, *film_rays(camera, place))
    share = side // fineness
    shape = (len(pixels), fineness, share, fineness, share)
    return np.array(light).reshape(shape).mean(axis=(2, 4))


def _light(
    scene: mi.Scene, integrator: SheetIntegrator, ray: mi.Ray3f, weight: mi.Float
) -> mi.Float:
    met = scene.ray_intersect(ray, mi.RayFlags.All, coherent=True)
    leg = Leg(scene, None, ray, met, mi.Bool(True))
    return integrator.ambient(leg) * weight
