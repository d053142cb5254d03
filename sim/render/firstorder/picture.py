"""Laser light of the first order: even pixels from one ray each, only the others sampled."""

from dataclasses import dataclass
from math import gcd, isqrt, sqrt

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from lscan.records import Ints
from sim.render.firstorder.rays import HeadRays, film_rays, head_rays, sample_places
from sim.render.firstorder.survey import MOST_SHEETS, NEIGHBOURS, PixelSurvey, sheet_reach, survey
from sim.render.layers import binned
from sim.render.plugins.camera import RefractiveCamera
from sim.render.sampled.integrator import Leg, SheetIntegrator
from sim.scene import Head, Pose, Scene

Picture = NDArray[np.float32]
GOLDEN = (sqrt(5) - 1) / 2
# Samples a side of a pixel at an edge, over those elsewhere; an edge matters where a pixel around
# it has more than FAINT of the brightest one's light.  With 9 samples everywhere the paper's groove
# and sandwave are up to 6 and 8 grey values off behind the lens, so 3 and 2, for a third more time.
FINER, FAINT = 2, 1e-2


@dataclass(frozen=True)
class FirstOrder:
    """Laser light of the first order in a picture, mW/(mm2 sr), and what is seen there.

    direct, scattered: (f H, f W).  seen: of the picture's (H, W) pixels.
    """

    direct: Picture
    scattered: Picture
    seen: PixelSurvey


def reason_for_samples(scene: Scene) -> str:
    """Why every pixel of the scene needs samples; "" where they do not."""
    if scene.tank.head.speed_mm_s != 0:
        return "head.speed_mm_s: the head moves while a picture is taken"
    if scene.tank.lens.focus_mm is not None:
        return "lens.focus_mm: what is out of focus is blurred"
    if len(scene.tank.laser.sheets) > MOST_SHEETS:
        return f"laser.lines: more than {MOST_SHEETS}"
    return ""


class SparseLaserLight:
    """The laser's direct and scattered light in a tank, wherever its head stands."""

    def __init__(
        self,
        scene: Scene,
        mitsuba_scene: mi.Scene,
        camera: RefractiveCamera,
        integrator: SheetIntegrator,
    ) -> None:
        """Take the tank's parts, to be configured and placed by the tank."""
        self._size_px = scene.rig.camera.size_px
        self._fineness = scene.tank.render.fineness
        self._scene, self._camera, self._integrator = mitsuba_scene, camera, integrator
        self._rays: HeadRays | None = None

    def look(self, head: Head, anew: bool = False) -> None:
        """Compute what is the same in all pictures of a wavelength, unless that is done already.

        Camera and sheets are configured, and have to be placed afterwards.  head: where the camera
        is in it.  anew: even if done.
        """
        if self._rays is None or anew:
            self._rays = head_rays(self._camera, self._integrator, head, self._size_px)

    @property
    def rays(self) -> HeadRays:
        """The camera's, of the wavelength that ``look`` was called for."""
        assert self._rays is not None, "look() comes first"
        return self._rays

    def picture(self, head: Pose, samples: int) -> FirstOrder:
        """The light of a picture, (f H, f W) of the scene's fineness f.

        head: where camera and sheets are placed.  samples: a pixel, where it needs them.
        """
        (width, height), fineness = self._size_px, self._fineness
        direct = np.zeros((fineness * height, fineness * width), np.float32)
        reaches = tuple(sheet_reach(self._scene, sheet) for sheet in self._integrator.sheets)
        seen = survey(self._scene, self.rays, head, reaches)
        layers = direct, seen.veil.repeat(fineness, axis=0).repeat(fineness, axis=1)
        if seen.uneven.size:
            side = isqrt(samples)
            dark = self._put(layers, seen.uneven, side)
            edges = self._edges(seen, direct, dark)
            if edges.size:
                self._put(layers, edges, FINER * side)
        return FirstOrder(*layers, seen)

    def _put(self, layers: tuple[Picture, Picture], pixels: Ints, side: int) -> Picture:
        """Sample pixels, put their light into the layers; (N,) share of each without any."""
        (width, height), fineness = self._size_px, self._fineness
        row, column = np.divmod(pixels, width)
        *means, dark = self._sampled(pixels, side)
        for layer, mean in zip(layers, means, strict=True):
            layer.reshape(height, fineness, width, fineness)[row, :, column, :] = mean
        return dark.mean(axis=(1, 2))

    def _edges(self, seen: PixelSurvey, direct: Picture, dark: Picture) -> Ints:
        """Indices of the pixels on the line at which a surface, or a shadow on it, ends."""
        width, height = self._size_px
        lit, unlit = np.zeros((2, height * width), np.uint8)
        lit[seen.uneven], unlit[seen.uneven] = dark < 1, dark > 0
        near = [cv2.dilate(mask.reshape(height, width), NEIGHBOURS) > 0 for mask in (lit, unlit)]
        light = cv2.dilate(binned(direct, self._fineness), NEIGHBOURS)
        edge = (light > FAINT * light.max()) & (seen.bent | (near[0] & near[1]))
        return seen.uneven[edge.ravel()[seen.uneven]]

    def _sampled(self, pixels: Ints, side: int) -> list[Picture]:
        """In the parts of the pixels, (N, f, f), of side x side samples a pixel: both layers, and
        the share of the samples without direct light.

        The samples lie on a regular grid.  For what the water scatters, each has a quantile of
        its own of the light along the ray, far from those of the samples beside it.
        """
        count, fineness = side**2, self._fineness
        place, sample = sample_places(pixels, self._size_px, side)
        ray, weight = film_rays(self._camera, place)
        leg = Leg(self._scene, None, ray, self._scene.ray_intersect(ray), mi.Bool(True))
        quantile = (mi.Float((sample * _stride(count)) % count) + 0.5) / count
        direct, scattered = mi.Float(0), mi.Float(0)
        for sheet in self._integrator.sheets:
            direct += self._integrator.direct(leg, sheet)
            if self._integrator.has_water:
                scattered += self._integrator.scattered(leg, sheet, sample=quantile)
        layers = [direct * weight, scattered * weight, dr.select(direct == 0, mi.Float(1), 0.0)]
        dr.eval(layers)
        share = side // fineness
        shape = (len(pixels), fineness, share, fineness, share)
        return [np.array(layer).reshape(shape).mean(axis=(2, 4)) for layer in layers]


def _stride(count: int) -> int:
    """A step that visits all of ``count`` places, each far from the one before."""
    steps = range(max(1, round(GOLDEN * count)), 2 * count + 1)
    return next(step for step in steps if gcd(step, count) == 1)


# The ambient layer from few rays: one in an even pixel, many where the picture is uneven.


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
