"""Laser light of the first order: even pixels from one ray each, only the others sampled."""

from dataclasses import dataclass, replace
from math import gcd, isqrt, sqrt

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from lscan.records import Floats, Ints, Mask
from sim.render.layers import binned, pixel_parts
from sim.render.plugins.arrays import floats, indices, opaque_vector
from sim.render.plugins.camera import RefractiveCamera
from sim.render.plugins.sheet import LaserSheet
from sim.render.sampled.beams import FARTHEST_MM
from sim.render.sampled.integrator import Leg, SheetIntegrator, crossing_of
from sim.scene import Head, Pose, Scene, camera_pose

# The camera's rays, one a pixel, and the open water's veil along each, in the head's frame.
#
# Camera and laser stand still against each other, so all this is the same in every picture of a
# scan; only a wavelength that drifts, or a camera or a laser that moves in the head, changes it.
# There is a margin of one pixel, so that every pixel of the picture has neighbours.


Picture = NDArray[np.float32]
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


# Multiples of these, less their whole parts, fill a square evenly however many they are: powers of
# the root of x³ = x + 1, inverted (Roberts 2018, "The unreasonable effectiveness of quasirandom
# sequences").
PUPIL_STEPS = 0.7548776662, 0.5698402910
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


PARTS = 8  # of a pixel's side, by which a disc's share of it is known
LATTICE = 9  # places a side of the picture at which it is known how rays through the pupil part
RIM = ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0))


@dataclass(frozen=True)
class Defocus:
    """Rays of some pixels through the pupil's middle, of their neighbours, and through its rim.

    All are (N, 3), origins in mm and unit directions, in the head's frame.
    """

    middle: tuple[Floats, Floats]
    neighbours: tuple[tuple[Floats, Floats], ...]
    rim: tuple[tuple[Floats, Floats], ...]

    @classmethod
    def of(cls, camera: RefractiveCamera, size_px: tuple[int, int]) -> "Defocus":
        """That of a camera placed in the head's frame, with a picture of (width, height)."""
        u, v = (
            mi.Float(axis.ravel().tolist())
            for axis in np.meshgrid(*[(np.arange(LATTICE) + 0.5) / LATTICE] * 2)
        )

        def rays(place: mi.Point2f, pupil: mi.Point2f | None = None) -> tuple[Floats, Floats]:
            ray, _ = camera.ray_through(place, pupil)
            return np.array(ray.o, dtype=float).T, np.array(ray.d, dtype=float).T

        right, down = mi.Point2f(u + 1 / size_px[0], v), mi.Point2f(u, v + 1 / size_px[1])
        here = mi.Point2f(u, v)
        rim = tuple(rays(here, mi.Point2f(*place)) for place in RIM)
        return cls(rays(here), (rays(right), rays(down)), rim)

    def radius_px(self, distances_mm: Floats) -> float:
        """Radius of the disc over which light from anywhere between some distances is spread, px.

        With distance the blur goes down to its focus and up again: it is largest at an end.
        """
        if distances_mm.size == 0:
            return 0.0
        radii = []
        for distance in (distances_mm.min(), distances_mm.max()):
            pixel = np.min([self._apart(ray, distance) for ray in self.neighbours], axis=0)
            radii += [self._apart(ray, distance) / pixel for ray in self.rim]
        return float(np.max(radii))

    def blurred(self, light: Picture, distance_mm: float) -> Picture:
        """Light, (H, W), as that from some distance is blurred."""
        radius = self.radius_px(np.array([distance_mm]))
        reach = int(np.ceil(radius))
        side = 2 * reach + 1
        fine = (np.arange(side * PARTS) + 0.5) / PARTS - reach - 0.5
        inside = np.hypot(*np.meshgrid(fine, fine)) <= max(radius, 0.5)
        disc = inside.reshape(side, PARTS, side, PARTS).mean(axis=(1, 3)) / inside.mean() / side**2
        border = cv2.BORDER_REPLICATE
        return np.asarray(cv2.filter2D(light, -1, disc, borderType=border), np.float32)

    def _apart(self, ray: tuple[Floats, Floats], distance: float) -> Floats:
        """(N,) mm between other rays and the middle ones, across these, so far along them."""
        start, way = self.middle
        aside = ray[0] - start - distance * way
        across = np.sum(aside * way, axis=1) / np.sum(ray[1] * way, axis=1)
        return np.asarray(np.linalg.norm(aside - across[:, np.newaxis] * ray[1], axis=1))


@dataclass(frozen=True)
class HeadRays:
    """A ray in the water for each pixel's centre, row by row, and for those around the picture.

    size_px: (width, height) with that margin.  origin: mm.  direction: unit.  weight: the
    camera's.  veils: one for each sheet.  pixel_rad: the angle between two neighbours in the
    middle of the picture.  defocus: None where everything is sharp.
    """

    size_px: tuple[int, int]
    origin: mi.Point3f
    direction: mi.Vector3f
    weight: mi.Float
    veils: tuple[OpenVeil, ...]
    pixel_rad: float
    defocus: Defocus | None = None

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
    defocus = Defocus.of(camera, size_px) if camera.lens_is_open else None
    return HeadRays(wider, ray.o, ray.d, weight, veils, pixel_rad, defocus)


def film_rays(
    camera: RefractiveCamera, place: mi.Point2f, sample: mi.UInt32 | None = None
) -> tuple[mi.Ray3f, mi.Float]:
    """The camera's rays through places of its film, 0 to 1 along each side, and their weights.

    sample: each ray's number among those of its pixel, through points spread over the pupil; all
    through its middle if None.
    """
    pupil = None
    if sample is not None and camera.lens_is_open:
        spread = mi.Point2f(*(mi.Float(sample) * step for step in PUPIL_STEPS))
        pupil = camera.pupil_point(place, spread - dr.floor(spread))
    ray, weight = camera.ray_through(place, pupil)
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


# What each pixel's central ray meets, and in which pixels the laser's light is not even.
#
# A ray that meets a surface far behind a sheet sees all of its veil, one that ends far before it
# none; only where it ends within the sheet is there direct light.  A pixel whose neighbours all
# see alike needs no more than its central ray.


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
    # Bent: no part of a plane with the four pixels beside it.
    far = np.minimum(np.array(distance).reshape(shape), np.float32(FARTHEST_MM))
    curved = cv2.Laplacian(far, cv2.CV_32F, borderType=cv2.BORDER_REFLECT)
    bent = (np.abs(curved) > BENT * rays.pixel_rad * far)[inner]
    return PixelSurvey(light, np.flatnonzero(_uneven(states)[inner]), bent, hit)


def _uneven(states: NDArray[np.uint8]) -> Mask:
    """(H, W) the pixels that are mixed or unlike any of their neighbours."""
    most, least = cv2.dilate(states, NEIGHBOURS), cv2.erode(states, NEIGHBOURS)
    return np.asarray((most == MIXED) | (most != least))


# Laser light of the first order: even pixels from one ray each, only the others sampled.


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

    def picture(self, head: Pose, samples: int, sharp: bool = False) -> FirstOrder:
        """The light of a picture, (f H, f W) of the scene's fineness f.

        head: where camera and sheets are placed.  samples: a pixel, where it needs them.  sharp: as
        through the pupil's middle alone.
        """
        (width, height), fineness = self._size_px, self._fineness
        direct = np.zeros((fineness * height, fineness * width), np.float32)
        reaches = tuple(sheet_reach(self._scene, sheet) for sheet in self._integrator.sheets)
        seen = survey(self._scene, self.rays, head, reaches)
        if self.rays.defocus is not None and seen.uneven.size and not sharp:
            seen = replace(seen, uneven=self._spread(seen, self.rays.defocus))
        layers = direct, pixel_parts(seen.veil, fineness)
        if seen.uneven.size:
            side = isqrt(samples)
            dark = self._put_samples(layers, seen.uneven, side, sharp)
            edges = self._edges(seen, direct, dark)
            if edges.size:
                self._put_samples(layers, edges, FINER * side, sharp)
        return FirstOrder(*layers, seen)

    def _spread(self, seen: PixelSurvey, defocus: Defocus) -> Ints:
        """Indices of the pixels into which an uneven one's light is spread out of focus."""
        width, height = self._size_px
        shape = self.rays.size_px[::-1]
        ends = [np.array(seen.hit.t), *(np.array(veil.crossing) for veil in self.rays.veils)]
        far = np.stack([end.reshape(shape)[1:-1, 1:-1].ravel()[seen.uneven] for end in ends])
        # What crosses the sheet behind a surface sends no light from there.
        far = np.minimum(far, far[0])
        radius = defocus.radius_px(far[(far > 0) & (far < FARTHEST_MM)])
        mask = np.zeros(height * width, np.uint8)
        mask[seen.uneven] = 1
        return np.flatnonzero(_grown(mask.reshape(height, width), radius))

    def _put_samples(
        self, layers: tuple[Picture, Picture], pixels: Ints, side: int, sharp: bool
    ) -> Picture:
        """Sample pixels, put their light into the layers; (N,) share of each without any."""
        (width, height), fineness = self._size_px, self._fineness
        row, column = np.divmod(pixels, width)
        *means, dark = self._sampled(pixels, side, sharp)
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

    def _sampled(self, pixels: Ints, side: int, sharp: bool) -> list[Picture]:
        """In the parts of the pixels, (N, f, f), of side x side samples a pixel: both layers, and
        the share of the samples without direct light.

        The samples lie on a regular grid.  For what the water scatters, each has a quantile of
        its own of the light along the ray, far from those of the samples beside it.
        """
        count, fineness = side**2, self._fineness
        place, sample = sample_places(pixels, self._size_px, side)
        ray, weight = film_rays(self._camera, place, None if sharp else sample)
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


def _grown(mask: NDArray[np.uint8], radius_px: float) -> NDArray[np.uint8]:
    """A mask grown by a disc, in the same time whatever its size."""
    far = cv2.distanceTransform(1 - mask, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(far <= np.ceil(radius_px), np.uint8)


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
    centre, distance = _light(scene, integrator, rays.seen_from(head), rays.weight)
    dr.eval(centre, distance)
    wide = np.array(centre).reshape(rays.size_px[::-1])
    across, along = (cv2.Sobel(wide, cv2.CV_32F, *order, ksize=1) for order in ((2, 0), (0, 2)))
    edges = (cv2.max(np.abs(across), np.abs(along)) > EVEN * wide).astype(np.uint8)
    inner = np.s_[1:-1, 1:-1]
    if rays.defocus is not None:
        far = np.array(distance).reshape(edges.shape)[edges > 0]
        edges = _grown(edges, rays.defocus.radius_px(far[far < FARTHEST_MM]))
    uneven = np.flatnonzero(cv2.dilate(edges, NEIGHBOURS)[inner])
    fineness, (height, width) = camera.fineness, wide[inner].shape
    picture = pixel_parts(np.ascontiguousarray(wide[inner]), fineness)
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
    place, sample = sample_places(pixels, size_px, side)
    light, _ = _light(scene, integrator, *film_rays(camera, place, sample))
    share = side // fineness
    shape = (len(pixels), fineness, share, fineness, share)
    return np.array(light).reshape(shape).mean(axis=(2, 4))


def _light(
    scene: mi.Scene, integrator: SheetIntegrator, ray: mi.Ray3f, weight: mi.Float
) -> tuple[mi.Float, mi.Float]:
    """Ambient light along rays, the camera's weight included, and mm to what they meet."""
    met = scene.ray_intersect(ray, mi.RayFlags.All, coherent=True)
    leg = Leg(scene, None, ray, met, mi.Bool(True))
    return integrator.ambient(leg) * weight, met.t
