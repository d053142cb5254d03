"""The camera's rays, one a pixel, and the open water's veil along each, in the head's frame.

Camera and laser stand still against each other, so all this is the same in every picture of a
scan; only a wavelength that drifts, or a camera or a laser that moves in the head, changes it.
There is a margin of one pixel, so that every pixel of the picture has neighbours.
"""

from dataclasses import dataclass, replace

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np

from lscan.records import Ints
from sim.render.plugins.arrays import floats, indices, opaque_vector
from sim.render.plugins.camera import RefractiveCamera
from sim.render.plugins.sheet import LaserSheet
from sim.render.sampled.integrator import Leg, SheetIntegrator, crossing_of
from sim.scene import Head, Pose, camera_pose

HEAD = Pose(np.eye(3), np.zeros(3))  # the head's frame itself
# Places at which the light scattered into a ray is summed, at equal shares of the Gaussian that
# it nearly is along the ray: what makes it differ from one changes by 1e-3 over its width.
QUANTILES = 4
# By how much of itself the veil of a pixel's centre may differ from the pixel's mean, which is
# the Laplacian over 24 away to fourth order: beside the apex, in view, it does by more.  What is
# fainter than DIMMEST of the brightest may differ by ROUGHEST of that.
ROUGHEST, DIMMEST = 1e-3, 1e-3


class HeadFrame:
    """The head's frame where the head stands."""

    def __init__(self, head: Pose) -> None:
        """Take on a pose.

        Parameters
        ----------
        head : Pose, of the head in the world
        """
        self._axes = [opaque_vector(column) for column in head.rotation.T]
        self._origin = opaque_vector(head.origin_mm)

    def direction(self, way: mi.Vector3f) -> mi.Vector3f:
        """A direction of the head's frame in the world."""
        x, y, z = self._axes
        return mi.Vector3f(x * way.x + y * way.y + z * way.z)

    def point(self, place: mi.Point3f) -> mi.Point3f:
        """A place of the head's frame, mm, in the world."""
        x, y, z = self._axes
        return mi.Point3f(self._origin + x * place.x + y * place.y + z * place.z)


# Standard deviations of the sheet: farther from its middle there is 4e-6 of the light there.
END = 5.0


@dataclass(frozen=True)
class OpenVeil:
    """One sheet's light scattered into rays with nothing in the way of either.

    crossing, sigma: where along the rays it comes from, mean and standard deviation, mm; infinite
    where the ray of a pixel's centre does not stand for the pixel.
    phi, rho: the mean's angle in the fan, and its distance from the apex, mm.
    radiance: mW/(mm2 sr), the camera's weight included.
    """

    crossing: mi.Float
    sigma: mi.Float
    phi: mi.Float
    rho: mi.Float
    radiance: mi.Float


@dataclass(frozen=True)
class HeadRays:
    """A ray in the water for each pixel's centre, row by row, and for those around the picture.

    size_px: (width, height) with that margin.  origin: mm.  direction: unit.  weight: the
    camera's.  veils: one for each sheet.  pixel_rad: the angle between two neighbours in the
    middle of the picture.
    """

    size_px: tuple[int, int]
    origin: mi.Point3f
    direction: mi.Vector3f
    weight: mi.Float
    veils: tuple[OpenVeil, ...]
    pixel_rad: float

    def seen_from(self, head: Pose) -> mi.Ray3f:
        """The rays in the world."""
        frame = HeadFrame(head)
        return mi.Ray3f(frame.point(self.origin), frame.direction(self.direction))

    def some(self, pixels: Ints) -> tuple["HeadRays", mi.UInt32]:
        """The rays of some pixels, without veils, and their indices for other gathers."""
        index = indices(pixels)
        place, way = (dr.gather(type(v), v, index) for v in (self.origin, self.direction))
        weight = dr.gather(mi.Float, self.weight, index)
        return replace(self, origin=place, direction=way, weight=weight, veils=()), index


def head_rays(
    camera: RefractiveCamera, integrator: SheetIntegrator, head: Head, size_px: tuple[int, int]
) -> HeadRays:
    """The rays of all pixels; camera and sheets are left in the head's frame.

    size_px: (width, height) of the picture.
    """
    camera.place(camera_pose(head))
    for sheet in integrator.sheets:
        sheet.place(HEAD)
    (width, height), wider = size_px, (size_px[0] + 2, size_px[1] + 2)
    index = dr.arange(mi.UInt32, wider[0] * wider[1])
    u, v = mi.Float(index % wider[0]) - 0.5, mi.Float(index // wider[0]) - 0.5
    ray, weight = film_rays(camera, mi.Point2f(u / width, v / height))
    veils = tuple(
        _smooth(_open_veil(integrator, sheet, ray, weight), wider) for sheet in integrator.sheets
    )
    dr.eval(ray, weight, veils)
    middle = (wider[1] // 2) * wider[0] + wider[0] // 2
    pair = dr.gather(mi.Vector3f, ray.d, mi.UInt32(middle, middle + 1))
    first, second = np.array(pair).T
    pixel_rad = float(np.linalg.norm(first - second))
    return HeadRays(wider, ray.o, ray.d, weight, veils, pixel_rad)


def film_rays(camera: RefractiveCamera, place: mi.Point2f) -> tuple[mi.Ray3f, mi.Float]:
    """The camera's rays through places of its film, 0 to 1 along each side, and their weights."""
    ray, weight = camera.sample_ray(mi.Float(0.5), mi.Float(0), place, mi.Point2f(0.5))
    return ray, weight.x


def sample_places(
    pixels: Ints, size_px: tuple[int, int], side: int
) -> tuple[mi.Point2f, mi.UInt32]:
    """Places on the film of side x side samples in each of the pixels, and each sample's number.

    They lie on a regular grid in the pixel, row by row; one pixel's follow each other.
    """
    (width, height), count = size_px, side**2
    lane = dr.arange(mi.UInt32, count * len(pixels))
    pixel = dr.gather(mi.UInt32, indices(pixels), lane // count)
    sample = lane % count
    u = mi.Float(pixel % width) + (mi.Float(sample % side) + 0.5) / side
    v = mi.Float(pixel // width) + (mi.Float(sample // side) + 0.5) / side
    return mi.Point2f(u / width, v / height), sample


def _open_veil(
    integrator: SheetIntegrator, sheet: LaserSheet, ray: mi.Ray3f, weight: mi.Float
) -> OpenVeil:
    crossing, slope = crossing_of(sheet, ray)
    phi, rho, _ = sheet.coordinates(ray(crossing), ray.time)
    sigma = sheet.half_width(rho) / (2 * dr.abs(slope))
    _, beside, offset = sheet.coordinates(ray.o, ray.time)
    # A ray that begins within the sheet sees light from its beginning on, wherever it crosses it.
    begins_within = dr.abs(offset) < END * sheet.half_width(beside) / 2
    sigma = dr.select(begins_within, dr.inf, sigma)
    radiance = mi.Float(0)
    if integrator.has_water:
        nothing = dr.zeros(mi.SurfaceInteraction3f)
        nothing.t = dr.inf
        leg = Leg(mi.load_dict({"type": "scene"}), None, ray, nothing, mi.Bool(True))
        for k in range(QUANTILES):
            radiance += integrator.scattered(leg, sheet, sample=mi.Float((k + 0.5) / QUANTILES))
    inside = dr.abs(phi) <= sheet.half_angle
    light = dr.select(inside, radiance * weight / QUANTILES, 0.0)
    return OpenVeil(crossing, sigma, phi, rho, light)


def _smooth(veil: OpenVeil, size_px: tuple[int, int]) -> OpenVeil:
    """The veil, of infinite sigma where it is not smooth enough for one ray a pixel."""
    light = np.array(veil.radiance)
    if light.size == 1:  # there is no water
        return veil
    curved = cv2.Laplacian(light.reshape(size_px[::-1]), cv2.CV_32F) / 24
    allowed = ROUGHEST * np.maximum(light, DIMMEST * light.max())
    rough = floats(np.abs(curved.ravel()) > allowed)
    return replace(veil, sigma=dr.select(rough > 0, dr.inf, veil.sigma))
