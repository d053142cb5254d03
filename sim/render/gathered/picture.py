"""The laser's light of all higher orders in one picture of a tank, without random noise."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import sqrt

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np

from lscan.records import Floats, Ints, Mask
from sim.meshes import MeshPart
from sim.render.ambient import reflectance
from sim.render.firstorder import HEAD, NEIGHBOURS, HeadFrame, HeadRays, PixelSurvey
from sim.render.gathered.halo import (
    CameraLeg,
    Chart,
    ChartGrid,
    Picture,
    Shining,
    cells_in_picture,
    make_chart,
    summed_in_cells,
)
from sim.render.gathered.line import Glow, facing, lit_points
from sim.render.gathered.surfaces import LitSurfaces, Reflections
from sim.render.gathered.veil import HaloPaths, HigherVeil
from sim.render.layers import binned
from sim.render.plugins.arrays import floats, indices, opaque_vector, vectors
from sim.render.sampled.integrator import SheetIntegrator
from sim.render.spreads import spread_of
from sim.scene import Head, Pose, Scene, head_pose
from sim.water import Optics

STEP = 4  # pixels between the places at which smooth light is worked out
ABOUT_LINE = 8  # pixels on either side of the line, worked out one by one
FINER_ROWS = 4  # samples down a fine cell of the chart that the line crosses
# And down the line in each column, for on steep surfaces it may be far narrower than a pixel; of
# less than FAINT of the column's brightest, a pixel is off the line.
LINE_ROWS, FAINT = 13, 0.05
# Samples of a pixel at which surfaces end, so many rows from the line: light differs across it.
EDGE_SAMPLES, ABOUT_EDGES = 4, 16
GOLDEN = (sqrt(5) - 1) / 2  # by which samples lie farther to the right, of a pixel, from row to row
FAINTEST = 1e-12  # transmittance of the water, below which nothing is seen through it
APART = 16  # pixels between the rays that say how surfaces are tilted in the mean
NEAREST_MM, FARTHEST_MM = 1.0, 1e4  # of what a ray meets; where one ends that meets nothing
LEFT_APART_MM = 5.0  # along the track, between places at which it is known what surfaces leave


_Traced = tuple[mi.Ray3f, mi.PreliminaryIntersection3f]


@dataclass(frozen=True)
class Seen:
    """What N rays meet.

    Attributes
    ----------
    distance : (N,) mm along the ray, FARTHEST_MM where there is nothing
    normal : (N, 3) of the surface, towards the camera, head frame; 0 where there is nothing
    radiance : (N,) that the surface sends on of the light that the water scattered onto it,
        mW/(mm2 sr)
    """

    distance: Picture
    normal: Picture
    radiance: Picture

    def split(self, *counts: int) -> "list[Seen]":
        """The first so many rays, the next, and so on."""
        ends = np.cumsum(counts)
        columns = (np.split(v, ends[:-1]) for v in (self.distance, self.normal, self.radiance))
        return [Seen(*values) for values in zip(*columns, strict=True)]


def reason_for_random(scene: Scene, parts: Sequence[MeshPart], water: Optics) -> str:
    """Why a scene's light of higher orders cannot be gathered; "" where it can.

    Parameters
    ----------
    scene : Scene
    parts : sequence of MeshPart, its surfaces
    water : Optics
    """
    if water.scattering_per_mm <= 0:
        return "water: it scatters nothing, so there are no tables of it"
    if scene.tank.laser.drift is not None:
        return "laser.drift: tables are made for one wavelength"
    if any(part.finish.kind != "matt" for part in parts):
        return f"target.finish: {scene.tank.target.finish} surfaces do not reflect evenly"
    if scene.tank.target.sand is not None:
        return "target.sand: the grains are finer than the lattice"
    return ""


# Tanks of one process often have the same water: reading its tables takes as long as a picture.
_last_spreads = lru_cache(maxsize=4)(spread_of)


@dataclass(frozen=True)
class SeenCells:
    """What the rays through the middles of a grid's cells meet.

    Attributes
    ----------
    power : (rows, columns) radiance times area as the camera sees it, of each steradian, mW/sr2
    distance : (rows, columns) mm, from where pixels' rays start, on average
    normal : (rows, columns, 3) of the surface, towards the camera, head frame; 0 for nothing
    """

    power: Picture
    distance: Picture
    normal: Picture


@dataclass(frozen=True)
class CellRays:
    """Rays from a chart's middle: one in each of some cells, and more down those on the line.

    Attributes
    ----------
    grid : ChartGrid
    cells, on_line : numbers of the cells
    directions : (3, N) unit vectors, head frame
    """

    grid: ChartGrid
    cells: Ints
    on_line: Ints
    directions: Floats


class GatheredLight:
    """The laser's light of second and higher orders, wherever the head stands."""

    def __init__(
        self,
        scene: mi.Scene,
        parts: Sequence[MeshPart],
        integrator: SheetIntegrator,
        rays: HeadRays,
        head: Head,
        water: Optics,
        places: Sequence[Pose],
    ) -> None:
        """Sum up what does not change while the head moves; the sheets are left in its frame.

        places: where the head stands in the course of a scan.
        """
        self._scene, self._integrator, self._rays = scene, integrator, rays
        for sheet in integrator.sheets:
            sheet.place(HEAD)
        veil = HigherVeil(water, integrator.sheets, rays, _mean_normal(scene, rays, places))
        self._chart = make_chart(rays, head)
        self._grids = self._chart.inner, self._chart.outer
        self._in_view = cells_in_picture(self._chart)
        outer = np.ones(self._chart.outer.shape, bool)
        outer[self._chart.block] = False
        # Cells of each grid that the picture does not show, and no other grid holds.
        self._outside = np.flatnonzero(~self._in_view.inside), np.flatnonzero(outer)
        spread, extinction = _last_spreads(water), water.extinction_per_mm
        self._glows = [Glow(sheet, spread, extinction) for sheet in integrator.sheets]
        self._reflections = Reflections(scene, parts, integrator, water, self._glows)
        self._camera = CameraLeg(self._chart, spread, extinction)
        halo = HaloPaths(integrator, self._chart)

        def left_at(number: float) -> list[Picture]:
            there = head_pose(head, number * LEFT_APART_MM)
            return [halo.left(scene, there), *veil.left(scene, there)]

        self._veil, self._left_at = veil, lru_cache(maxsize=2)(left_at)
        width, height = rays.size_px
        self._inner = np.arange(height * width).reshape(height, width)[1:-1, 1:-1]
        self._index = indices(self._inner)
        self._weight = dr.gather(mi.Float, rays.weight, self._index)
        rows, columns = self._chart.inner.shape
        x, y = map(floats, self._chart.pixels)
        self._places = mi.Point2f((x + 0.5) / columns, (y + 0.5) / rows)
        dr.eval(self._weight, self._places, self._index)
        self._camera_weight = np.array(self._weight).reshape(self._inner.shape)
        self._pixel_rays = np.vstack([np.array(rays.origin), np.array(rays.direction)]).T.copy()

    def families(
        self, head: Pose, position_mm: float, direct: Picture, seen: PixelSurvey
    ) -> Mapping[str, Picture]:
        """(H, W) light of each family, mW/(mm2 sr), the camera's weight included.

        "surfaces", that comes straight from them, lit by scattered or reflected light; "camera",
        that the water scatters on its way from them; "veil", that met none.

        Parameters
        ----------
        head : Pose, where the sheets are placed
        position_mm : float, mm along the track, about where the head is
        direct : (f H, f W) the line as the camera sees it, sharp, of any fineness f
        seen : PixelSurvey, of the picture
        """
        direct = binned(direct, direct.shape[0] // self._inner.shape[0])
        line = self._line_in_view(head)
        lines = [_splat(grid, self._chart, *line) for grid in self._grids]
        glow, tilt, cells = self._surfaces(head, direct, seen, lines)
        left = self._shares_left(position_mm)
        layers = self._picture_layers(direct, glow, tilt, cells, seen, left)
        if (defocus := self._rays.defocus) is None or not direct.any():
            return layers
        # It is brightest about the line, where the line's blur is its own.
        far = np.array(seen.hit.t).reshape(self._rays.size_px[::-1])[1:-1, 1:-1]
        far_mm = float(np.average(np.minimum(far, FARTHEST_MM), weights=direct))
        return {name: defocus.blurred(light, far_mm) for name, light in layers.items()}

    def _shares_left(self, position_mm: float) -> list[Picture]:
        """What surfaces leave of the halo and of each sheet's veil, between known places."""
        number, part = divmod(position_mm / LEFT_APART_MM, 1)
        before, behind = (self._left_at(number + step) for step in (0, 1))
        return [a + np.float32(part) * (b - a) for a, b in zip(before, behind, strict=True)]

    def _picture_layers(
        self,
        direct: Picture,
        glow: Picture,
        tilt: Picture,
        cells: list[Shining],
        seen: PixelSurvey,
        left: list[Picture],
    ) -> Mapping[str, Picture]:
        """The light of the pixels, of the surfaces' and of what the water scatters of it."""
        distance = dr.minimum(dr.gather(mi.Float, seen.hit.t, self._index), FARTHEST_MM)
        passed = dr.exp(-self._integrator.extinction * distance) * self._weight
        radiance = dr.select(passed > FAINTEST, floats(direct) / passed, 0.0)
        sent = floats(glow)
        radiance += sent
        halo_left, *veil_left = left
        halo = (self._camera.halo(*cells) * halo_left)[..., np.newaxis]
        (wide,) = mi.Texture2f(mi.TensorXf(halo), use_accel=False).eval_cubic(self._places)
        camera = (wide + radiance * self._camera.near_gain(distance)) * self._weight
        columns = distance, radiance, camera, sent * passed
        dr.eval(columns)
        far, bright, camera, surfaces = (
            np.array(values).reshape(self._inner.shape) for values in columns
        )
        camera += self._camera.near_peaked(bright, far, tilt) * self._camera_weight
        return {"surfaces": surfaces, "camera": camera, "veil": self._veil.picture(far, veil_left)}

    def _surfaces(
        self, head: Pose, direct: Picture, seen: PixelSurvey, lines: list[Shining]
    ) -> tuple[Picture, Picture, list[Shining]]:
        """What surfaces send on of the glow, in the picture, and of all light, in the grids.

        And how they are tilted, (H, W, 2), where the picture shows the line.
        """
        fine, samples = _cut_pixels(direct, seen.bent)
        coarse, exact = self._inner[::STEP, ::STEP], self._uneven(direct, seen, fine)
        index = np.concatenate([coarse.ravel(), self._inner.ravel()[exact]])
        cells = [
            self._cell_rays(grid, outside, line.power)
            for grid, outside, line in zip(self._grids, self._outside, lines, strict=True)
        ]
        lit = self._reflections.lit()
        within = self._within(self._inner.ravel()[fine], samples)
        finer, directions = within[:, 3:], [each.directions for each in cells]
        counts = coarse.size, exact.size, *(way.shape[1] for way in directions), len(finer)
        rays, place = self._rays.some(index)
        known = rays.seen_from(head), dr.gather(mi.PreliminaryIntersection3f, seen.hit, place)
        ray = self._world_rays(head, np.hstack(directions), within)
        traced = ray, self._scene.ray_intersect_preliminary(ray)
        # All at once: such a kernel takes as long to be put together as to run.
        ray, hit = _joined(known, traced)
        even, near, *of_cells, down = self._seen_along(ray, hit, head, lit).split(*counts)
        picture = _upsample(even.radiance.reshape(coarse.shape), *self._inner.shape)
        picture.ravel()[exact] = near.radiance
        first = np.cumsum(samples) - samples
        picture.ravel()[fine] = np.add.reduceat(down.radiance, first) / samples
        tilt = np.zeros((*self._inner.shape, 2), np.float32)
        tangents = self._chart.tilt(down.normal, finer.T)
        tilt.reshape(-1, 2)[fine] = np.add.reduceat(tangents, first) / samples[:, np.newaxis]
        glows = [self._trace_cells(*each) for each in zip(cells, of_cells, strict=True)]
        self._put_view(glows[0], picture, even.normal.reshape(*coarse.shape, 3), seen)
        shining = [
            line + summed_in_cells(glow.power * grid.solid_angle, glow.distance, glow.normal)
            for grid, line, glow in zip(self._grids, lines, glows, strict=True)
        ]
        return picture, tilt, shining

    def _cell_rays(self, grid: ChartGrid, cells: Ints, line: Picture) -> CellRays:
        """Rays of cells of a grid, given the line's light in all of them."""
        # On the line and beside it, where the glow peaks, each cell in so many places down it.
        near = np.flatnonzero(cv2.dilate((line > 0).astype(np.uint8), NEIGHBOURS))
        on_line = np.intersect1d(near, cells, assume_unique=True)
        row, column = np.divmod(on_line, grid.shape[1])
        count = self._finer(grid)
        below = (np.arange(count) + 0.5) / count - 0.5
        places = np.stack([column.repeat(count), (row[:, np.newaxis] + below).ravel()])
        finer = self._chart.between(grid, places)
        directions = np.hstack([grid.directions[:, cells], finer])
        return CellRays(grid, cells, on_line, directions)

    def _trace_cells(self, rays: CellRays, seen: Seen) -> SeenCells:
        """What a grid's cells send on in each steradian; none where there were no rays."""
        grid, cells = rays.grid, rays.cells
        even, fine = seen.split(cells.size, seen.distance.size - cells.size)
        count = grid.directions.shape[1]
        power, normal = np.zeros(count, np.float32), np.zeros((count, 3), np.float32)
        distance = np.full(count, FARTHEST_MM, np.float32)
        power[cells], normal[cells] = even.radiance * even.distance**2, even.normal
        within = (fine.radiance * fine.distance**2).reshape(-1, self._finer(grid))
        power[rays.on_line] = within.mean(axis=1)
        distance[cells] = even.distance - np.float32(self._chart.near_mm)
        columns = power, distance, normal
        return SeenCells(*(column.reshape(*grid.shape, *column.shape[1:]) for column in columns))

    def _put_view(
        self, cells: SeenCells, picture: Picture, normal: Picture, seen: PixelSurvey
    ) -> None:
        """Put what the picture shows into the cells that lie in it."""
        view, shape = self._in_view, self._rays.size_px[::-1]
        distance = np.minimum(np.array(seen.hit.t).reshape(shape)[1:-1, 1:-1], FARTHEST_MM)
        power = picture * (distance + np.float32(self._chart.near_mm)) ** 2
        power = np.asarray(cv2.blur(power, view.box_px), np.float32)
        cells.power[view.inside] = view.read(power)
        cells.distance[view.inside] = view.read(distance, interpolation=cv2.INTER_NEAREST)
        cells.normal[view.inside] = view.read(normal, STEP)

    def _finer(self, grid: ChartGrid) -> int:
        """Samples down a cell of a grid that the line crosses."""
        return round(FINER_ROWS * grid.cell / self._chart.inner.cell)

    def _uneven(self, direct: Picture, seen: PixelSurvey, fine: Ints) -> Ints:
        """The pixels near the line and where surfaces end or are bent, but for fine ones."""
        near = _dilate(direct > 0, ABOUT_LINE) | _dilate(seen.bent, STEP)
        near.ravel()[fine] = False
        return np.flatnonzero(near)

    def _within(self, pixels: Ints, counts: Ints) -> Picture:
        """(N, 6) starts and directions of so many rays in pixels, linear between neighbours'."""
        own, each = np.repeat(pixels, counts), np.repeat(counts, counts)
        number = np.arange(own.size) - np.repeat(np.cumsum(counts) - counts, counts) + 0.5
        offsets = number / each - 0.5, GOLDEN * number % 1 - 0.5  # down, and to the right
        here = self._pixel_rays[own]
        rays = here.copy()
        for offset, step in zip(offsets, (self._rays.size_px[0], 1), strict=True):
            other, share = own + np.where(offset < 0, -step, step), np.abs(np.float32(offset))
            rays += (self._pixel_rays[other] - here) * share[:, np.newaxis]
        rays[:, 3:] /= np.linalg.norm(rays[:, 3:], axis=1, keepdims=True)
        return rays

    def _world_rays(self, head: Pose, directions: Floats, others: Picture) -> mi.Ray3f:
        """Rays in the world from the chart's middle, and others, all given in the head's frame.

        directions: (3, N).  others: (M, 6) starts and directions.
        """
        frame = HeadFrame(head)
        middle = np.repeat(self._chart.inner.pivot[:, np.newaxis], directions.shape[1], axis=1)
        start, way = np.hstack([np.vstack([middle, directions]), others.T]).reshape(2, 3, -1)
        point = frame.point(mi.Point3f(vectors(start)))
        return mi.Ray3f(point, frame.direction(mi.Vector3f(vectors(way))))

    def _seen_along(
        self, ray: mi.Ray3f, hit: mi.PreliminaryIntersection3f, head: Pose, lit: LitSurfaces
    ) -> Seen:
        """What rays see of light that surfaces send on; hit: what they meet."""
        si = hit.compute_surface_interaction(ray, mi.RayFlags.All)
        met = si.is_valid()
        light, shares = self._reflections.irradiance(lit, si)
        normal, point, sends = mi.Normal3f(facing(si)), si.p, reflectance(si) / dr.pi
        distance = dr.select(met, si.t, FARTHEST_MM)
        sends = dr.select(met, sends, 0.0)
        axes = [opaque_vector(column) for column in head.rotation.T]
        seen = mi.Vector3f(*(dr.select(met, dr.dot(axis, normal), 0.0) for axis in axes))
        # A kernel of its own for the glow: one of both takes half as long again.
        dr.eval(light, shares, normal, point, sends, distance, seen)
        for glow, share in zip(self._glows, shares, strict=True):
            light += share * glow.irradiance(point, normal)
        radiance = light * sends
        dr.eval(radiance)
        # One by one: to interleave them takes a kernel, compiled anew for each number of rays.
        columns = np.stack([np.array(part) for part in seen], axis=-1)
        return Seen(np.array(distance), columns, np.array(radiance))

    def _line_in_view(self, head: Pose) -> tuple[Floats, Floats, Floats]:
        """Points of the line, mm, its surface's normals, and what they show the camera.

        Points and normals are (3, N) in the head's frame; what is shown is radiance times area as
        the camera sees it, (N,) mW/sr.
        """
        line = lit_points(self._scene, self._integrator.sheets, self._integrator.extinction)
        pivot = self._chart.inner.pivot
        start = mi.Point3f(opaque_vector(head.rotation @ pivot + head.origin_mm))
        way = line.point - start
        far = dr.norm(way)
        ray = mi.Ray3f(start, way / far)
        ray.maxt = far * (1 - 1e-4)
        facing = dr.maximum(-dr.dot(line.normal, way) / far, 0)
        power = dr.select(self._scene.ray_test(ray), 0.0, line.power * facing)
        dr.eval(power, line.point, line.normal)
        point, normal, power = (np.array(v, dtype=float) for v in (line.point, line.normal, power))
        point -= head.origin_mm[:, np.newaxis]
        return head.rotation.T @ point, head.rotation.T @ normal, power


def _joined(*sides: _Traced) -> _Traced:
    """Rays and what they meet, those of one side behind those of another."""
    counts = [dr.width(hit) for _, hit in sides]
    kinds = mi.Point3f, mi.Vector3f, mi.PreliminaryIntersection3f
    start, way, met = (dr.zeros(kind, sum(counts)) for kind in kinds)
    for (ray, hit), count, end in zip(sides, counts, np.cumsum(counts), strict=True):
        # As a constant the first place would have each picture's kernel compiled anew.
        place = dr.opaque(mi.UInt32, int(end) - count) + dr.arange(mi.UInt32, count)
        for whole, part in ((start, ray.o), (way, ray.d), (met, hit)):
            dr.scatter(whole, part, place)
    dr.eval(start, way, met)
    return mi.Ray3f(start, way), met


def _mean_normal(scene: mi.Scene, rays: HeadRays, places: Sequence[Pose]) -> Floats | None:
    """(3,) of what the camera sees from some places, head frame; None where that is nothing."""
    width, height = rays.size_px
    pixels = np.arange(width * height).reshape(height, width)[::APART, ::APART].ravel()
    some, _ = rays.some(pixels)
    total = np.zeros(3)
    for head in places:
        si = scene.ray_intersect(some.seen_from(head))
        normal = dr.select(si.is_valid(), facing(si), 0.0)
        total += np.array(normal, dtype=float).sum(axis=1) @ head.rotation
    length = np.linalg.norm(total)
    return total / length if length > 0 else None


def _splat(grid: ChartGrid, chart: Chart, point: Floats, normal: Floats, power: Floats) -> Shining:
    """What points shine with, shared out among four cells each, such that their centre stays."""
    rows, columns = grid.shape
    column, row = chart.place(grid, point)
    inside = (column >= 0) & (column < columns - 1) & (row >= 0) & (row < rows - 1)
    column, row = column[inside], row[inside]
    left, top = column.astype(int), row.astype(int)
    right, down = column - left, row - top
    first = top * columns + left
    cells = np.concatenate([first, first + 1, first + columns, first + columns + 1])
    shares = [(1 - right) * (1 - down), right * (1 - down), (1 - right) * down, right * down]
    distance = np.linalg.norm(point - grid.pivot[:, np.newaxis], axis=0) - chart.near_mm
    distance = np.maximum(distance, NEAREST_MM)
    sums = power * np.vstack([np.ones_like(power), np.log(distance), normal])
    shared = np.concatenate(shares) * np.tile(sums[:, inside], 4)
    columns_of = [np.bincount(cells, each, rows * columns).astype(np.float32) for each in shared]
    shone, depth, *tilt = (column.reshape(rows, columns) for column in columns_of)
    return Shining(shone, depth, np.stack(tilt, axis=-1))


def _cut_pixels(direct: Picture, bent: Mask) -> tuple[Ints, Ints]:
    """The line's pixels, and those near it where surfaces end, and how many samples each gets."""
    bright = (direct > FAINT * direct.max(axis=0)) & (direct > 0)
    rows = -(-LINE_ROWS // np.maximum(bright.sum(axis=0), 1))
    samples = np.where(bright, rows, EDGE_SAMPLES * (bent & _dilate(direct > 0, ABOUT_EDGES)))
    pixels = np.flatnonzero(samples)
    return pixels, samples.ravel()[pixels]


def _dilate(mask: Mask, pixels: int) -> Mask:
    """A mask grown by so many pixels each way."""
    size = 2 * pixels + 1
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((size, size), np.uint8)) > 0)


def _upsample(coarse: Picture, height: int, width: int) -> Picture:
    """A picture known at every STEP-th pixel from the first on, by cubics between them.

    Where these swing below zero, at an edge, there is no light.
    """
    matrix = np.array([[STEP, 0, 0], [0, STEP, 0]], dtype=np.float32)
    size, border = (width, height), cv2.BORDER_REPLICATE
    picture = cv2.warpAffine(coarse, matrix, size, flags=cv2.INTER_CUBIC, borderMode=border)
    return np.maximum(picture, np.float32(0))
