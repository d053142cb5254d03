"""Where surfaces are lit in a picture: what light of higher orders starts from."""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from lscan.records import Floats, Ints
from sim.render.plugins.base import Leg
from sim.render.plugins.camera import RefractiveCamera
from sim.render.plugins.integrator import SheetIntegrator
from sim.render.sparse.rays import film_rays, sample_places

MIN_COSINE = 1e-3  # at less a surface is seen along itself


@dataclass(frozen=True)
class LitCells:
    """What of a surface each uneven pixel shows, N of them, those without direct light left out.

    Attributes
    ----------
    pixel : (N,) array, index of the pixel, row by row
    point_mm : (N, 3) array, mm, world frame: where the light's mean leaves the surface
    normal : (N, 3) array, the light's mean normal, towards the camera; unit
    area_mm2 : (N,) array, mm2, of the surface
    flux : (N,) array, mW/sr: area times the radiance with which it shines at the camera, just
        before the surface
    """

    pixel: Ints
    point_mm: Floats
    normal: Floats
    area_mm2: Floats
    flux: Floats


def lit_cells(
    scene: mi.Scene,
    camera: RefractiveCamera,
    integrator: SheetIntegrator,
    pixels: Ints,
    size_px: tuple[int, int],
    side: int,
) -> LitCells:
    """The lit cells of some pixels of a picture, from side x side rays through each.

    scene, camera, integrator : of the tank, the head in its place
    pixels : (M,) array, indices of pixels, row by row
    size_px : (width, height) of the picture
    side : int, rays a side of each pixel

    A ray stands for the part of the surface's tangent plane half way to the rays around it: behind
    a port, solid angle times squared distance is 4 % off.
    """
    place, _ = sample_places(pixels, size_px, side)
    ray, _ = film_rays(camera, place)
    si = scene.ray_intersect(ray)
    leg = Leg(scene, None, ray, si, mi.Bool(True))
    radiance = sum((integrator.direct(leg, sheet) for sheet in integrator.sheets), mi.Float(0))
    radiance *= dr.exp(integrator.extinction * si.t)
    half = mi.Vector2f(0.5 / (side * size_px[0]), 0), mi.Vector2f(0, 0.5 / (side * size_px[1]))
    across, along = (
        _on_plane(camera, place + step, si) - _on_plane(camera, place - step, si) for step in half
    )
    lit = radiance > 0
    area = dr.select(lit, dr.norm(dr.cross(across, along)), 0.0)
    normal = dr.select(dr.dot(si.n, ray.d) > 0, -si.n, si.n)
    columns = [area, dr.select(lit, radiance * area, 0.0), *si.p, *normal]
    dr.eval(columns)
    rows = np.stack([np.array(column, dtype=float) for column in columns])
    return _pooled(pixels, rows.reshape(len(columns), len(pixels), side**2))


def _on_plane(
    camera: RefractiveCamera, place: mi.Point2f, si: mi.SurfaceInteraction3f
) -> mi.Point3f:
    """Where the ray through a place of the film meets the tangent plane of a surface's point."""
    ray, _ = film_rays(camera, place)
    slope = dr.dot(si.n, ray.d)
    ahead = dr.dot(si.n, si.p - ray.o) / slope
    return dr.select(dr.abs(slope) > MIN_COSINE, ray(ahead), si.p)


def _pooled(pixels: Ints, rows: NDArray[np.float64]) -> LitCells:
    """The cells of (8, M, S) area, flux, point and normal of the S rays of each of M pixels."""
    flux = rows[1].sum(axis=1)
    lit = flux > 0
    share = rows[1, lit] / flux[lit, np.newaxis]
    means = np.einsum("cms,ms->mc", rows[2:, lit], share)
    normal = means[:, 3:] / np.linalg.norm(means[:, 3:], axis=1, keepdims=True)
    return LitCells(pixels[lit], means[:, :3], normal, rows[0, lit].sum(axis=1), flux[lit])
