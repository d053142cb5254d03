"""Light of surfaces that the water scatters on its way to the camera: pictures of Gaussians.

What surfaces shine with is summed in the cells of a chart around the view, then convolved with the
kernel's Gaussians, each on a grid about as coarse as it is wide.  Gaussians narrower than a cell
act on the picture's own pixels: of direct light as they are, of smoother light as if they had no
width at all.  Grids are halved and doubled by the same weights, those of a quadratic spline, of
which a Gaussian's width is relieved: OpenCV's cubics shift light by up to .05 of a cell.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from math import ceil, log2, pi, tan

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, LinearNDInterpolator

from lscan.records import Floats, Mask
from sim.render.firstorder import HeadRays
from sim.render.plugins.arrays import floats
from sim.scene import Head, camera_pose
from sim.water.spread import LogAxis, Spread

# A map of the camera's view in the water and around it: a stereographic chart of directions.
#
# The chart is conformal: the angle q between two directions, at z1 and z2 on the chart, is
# 2 sin(q / 2) = |z1 - z2| c1 c2, with c the cosine of half their angle from the middle.  All its
# rays start at one place, the point that the camera's rays pass nearest to; behind a flat port they
# miss it by less than a millimetre.  Around the picture, from where only light that spreads widely
# gets into it, the chart's cells are COARSER.


# What the water scatters of a surface's light into a camera's pixel: a sum of Gaussians.
#
# By reciprocity a pixel receives from an element of a surface what a pencil beam along the pixel's
# ray would bring to it (sim.water.spread).  The element lies on a plane, tilted against the line of
# sight, on which the beam ends too.  About the element that light is a function of the angle q
# between ray and element and of the azimuth chi of the tilt, R0(q) + R1(q) cos chi; what is left,
# of cos 2 chi, is 1 % of R0 within 10 degrees and 4 % within 60.  Both are fitted by Gaussians
# whose widths double from one to the next: a power law is a sum of such to 0.2 %, and a picture
# convolved with a Gaussian costs the less the wider it is.


RANGE_AXIS = LogAxis(100.0, 3000.0, 14)
COSINE_AXIS = LogAxis(0.1, 1.0, 8)  # of incidence; flatter surfaces count as the last
HARMONICS, AZIMUTHS = 2, 8
WIDEST_GAUSSIAN_RAD = 0.6  # the widest Gaussian: as wide as a camera's view
# The sum is fitted within FARTHEST of the widest deviations: beyond, it only falls off, and what
# lies nearer would suffer.  ANGLES_A_LEVEL, to each doubling.
FARTHEST = 1.5
ANGLES_A_LEVEL = 6
RIDGE = 1e-4  # of a coefficient's own size, as the fit's prior
SHIFT = 1.1  # of all angles, by which the steepness is found


@dataclass(frozen=True)
class ScatterKernel:
    """Coefficients of the Gaussians.

    Attributes
    ----------
    sigmas : (L,) standard deviations, rad, each twice the one before
    weights : (R, C, L, HARMONICS), 1/mm2, at the nodes of RANGE_AXIS and COSINE_AXIS, of
        exp(-x2 / 2) and x exp(-x2 / 2) cos chi, with x = q / sigma
    steepness : (L,) the power of a change of scale that the first weights go with
    """

    sigmas: Floats
    weights: Floats
    steepness: Floats


@lru_cache(maxsize=4)
def scatter_kernel(spread: Spread, extinction_per_mm: float, smallest_rad: float) -> ScatterKernel:
    """The coefficients for a water.

    Parameters
    ----------
    spread : Spread, of the water
    extinction_per_mm : float, its attenuation
    smallest_rad : float, which the least standard deviation is no larger than
    """
    levels = int(np.ceil(np.log2(WIDEST_GAUSSIAN_RAD / smallest_rad))) + 1
    sigmas = WIDEST_GAUSSIAN_RAD / np.exp2(np.arange(levels, dtype=float))[::-1]
    angle = np.geomspace(sigmas[0], FARTHEST * WIDEST_GAUSSIAN_RAD, ANGLES_A_LEVEL * levels)
    light = _irradiance(spread, extinction_per_mm, angle)
    moved = _irradiance(spread, extinction_per_mm, angle * SHIFT)
    weights, other = (_coefficients(angle, sigmas, light), _coefficients(angle, sigmas, moved))
    ratio = np.median(other[..., 0] / weights[..., 0], axis=(0, 1))
    return ScatterKernel(sigmas, weights, np.log(np.maximum(ratio, 1e-3)) / np.log(SHIFT))


def _irradiance(spread: Spread, extinction: float, angle: Floats) -> Floats:
    """(R, C, Q, HARMONICS) irradiance of planes by a beam of unit power, 1/mm2."""
    azimuth = np.pi * (np.arange(AZIMUTHS) + 0.5) / AZIMUTHS
    ranges, cosine, theta, chi = np.meshgrid(
        RANGE_AXIS.nodes(), COSINE_AXIS.nodes(), angle, azimuth, indexing="ij", sparse=True
    )
    aside = np.sqrt(1 - cosine**2) * np.cos(chi)
    towards = cosine * np.cos(theta) + aside * np.sin(theta)
    end = ranges * np.where(towards > 0, cosine / np.maximum(towards, 1e-2), 100.0)
    light = extinction**2 * spread.irradiance(
        theta, extinction * ranges, cosine, aside, extinction * end
    )
    return np.stack([light.mean(axis=-1), 2 * (light * np.cos(chi)).mean(axis=-1)], axis=-1)


def _coefficients(angle: Floats, sigmas: Floats, light: Floats) -> Floats:
    """(R, C, L, HARMONICS) coefficients; errors count relative to the light's mean."""
    x = angle[:, np.newaxis] / sigmas
    weights = []
    for harmonic in range(HARMONICS):
        basis = x**harmonic * np.exp(-0.5 * x**2)  # (Q, L)
        design = basis / light[..., 0, np.newaxis]
        # A Gaussian's own size is that of the light where it is highest.
        size = np.sqrt((design**2).sum(axis=-2))
        scaled = design / size[..., np.newaxis, :]
        matrix = np.swapaxes(scaled, -1, -2) @ scaled
        matrix += RIDGE**2 * np.eye(len(sigmas))
        right = np.einsum("...ql,...q->...l", scaled, light[..., harmonic] / light[..., 0])
        weights.append(np.linalg.solve(matrix, right[..., np.newaxis])[..., 0] / size)
    return np.stack(weights, axis=-1)


# A map of the camera's view in the water and around it: a stereographic chart of directions.


Picture = NDArray[np.float32]
# Of the picture's size on either side: of the fine cells, and of the coarse ones, for in turbid
# water light comes from there too (at 5 NTU, with half of it, 5 to 15 % are missing in corners).
BESIDE, BEYOND = 0.06, 1.0
WIDEST_RAD = 1.3  # off the middle
CELLS = 144  # fine ones, along the wider side
COARSER = 4
SPARSE = 8  # pixels between those whose places on the chart are inverted


@dataclass(frozen=True)
class ChartGrid:
    """Square cells on the chart, row by row; vectors in the head's frame.

    Attributes
    ----------
    shape : (rows, columns)
    cell : float, a cell's side on the chart, which is rad in its middle
    corner : (2,) x and y on the chart of the first cell's middle
    pivot : (3,) mm, where the rays start
    directions, right, down : (3, N) unit vectors: of the rays, and across them along the chart
    half_cosine : (rows, columns) c
    """

    shape: tuple[int, int]
    cell: float
    corner: Floats
    pivot: Floats
    directions: Floats
    right: Floats
    down: Floats
    half_cosine: Picture

    @property
    def solid_angle(self) -> Picture:
        """(rows, columns) of the cells, sr."""
        return np.float32(self.cell**2) * self.half_cosine**4


@dataclass(frozen=True)
class Chart:
    """The view in fine cells, and all around it in coarse ones.

    Attributes
    ----------
    inner, outer : ChartGrid
    block : slices of the rows and of the columns of ``outer`` that ``inner`` takes the place of
    axes : (3, 3) the camera's in the head's frame, as columns
    pixels : (2, H, W) columns and rows of ``inner``, in cells, at which the pixels' rays lie
    near_mm : float, from the pivot to where the rays start, on average
    pixel_rad : (H, W) the square root of a pixel's solid angle
    """

    inner: ChartGrid
    outer: ChartGrid
    block: tuple[slice, slice]
    axes: Floats
    pixels: Picture
    near_mm: float
    pixel_rad: Picture

    def place(self, grid: ChartGrid, point: Floats) -> Floats:
        """(2, N) columns and rows of a grid, in cells, of (3, N) points in the head's frame."""
        offset = point - grid.pivot[:, np.newaxis]
        way = offset / np.linalg.norm(offset, axis=0)
        return (_chart_places(way, self.axes) - grid.corner[:, np.newaxis]) / grid.cell

    def between(self, grid: ChartGrid, place: Floats) -> Floats:
        """(3, N) directions at (2, N) columns and rows of a grid, in cells, head frame."""
        x, y = grid.corner[:, np.newaxis] + grid.cell * place
        return np.asarray(self.axes @ _directions(x, y)[0])

    def tilt(self, normal: Picture, direction: Picture) -> Picture:
        """(N, 2) how surfaces are tilted to the picture's right and down against lines of sight.

        The tangents of the angles between a normal and the way back to the camera.

        Parameters
        ----------
        normal : (N, 3) unit vectors, head frame; 0 where there is no surface
        direction : (3, N) unit vectors of the rays, head frame
        """
        axes = self.axes[:, :2].astype(np.float32)
        back = -np.einsum("nk,kn->n", normal, direction)[:, np.newaxis]
        across = normal @ axes + back * (direction.T @ axes)
        return np.asarray(across / np.maximum(back, COSINE_AXIS.low), dtype=np.float32)


@dataclass(frozen=True)
class CellsInPicture:
    """Where cells of the view lie in the picture.

    Attributes
    ----------
    inside : (rows, columns) the cells whose middles the picture shows
    column, row : (rows, columns) of the picture at those middles, px
    box_px : a cell's sides, px, odd
    """

    inside: Mask
    column: Picture
    row: Picture
    box_px: tuple[int, int]

    def read(
        self, picture: Picture, step: int = 1, interpolation: int = cv2.INTER_LINEAR
    ) -> Picture:
        """(N, ...) a picture, or every so many pixels of it, at the middles of cells inside."""
        places, border = (self.column / step, self.row / step), cv2.BORDER_REPLICATE
        there = cv2.remap(picture, *places, interpolation, borderMode=border)
        return np.asarray(there, dtype=np.float32)[self.inside]


def cells_in_picture(chart: Chart) -> CellsInPicture:
    """Where the fine cells of a chart lie in the picture."""
    x, y = chart.pixels
    height, width = x.shape
    row, column = (
        np.unique(np.append(np.arange(0, side, SPARSE), side - 1)) for side in (height, width)
    )
    rows, columns = np.meshgrid(row, column, indexing="ij")
    known = np.stack([x[rows, columns], y[rows, columns]], axis=-1).reshape(-1, 2)
    place = LinearNDInterpolator(known, np.stack([columns, rows], axis=-1).reshape(-1, 2))
    rows, columns = np.indices(chart.inner.shape, dtype=float)
    column, row = np.moveaxis(place(columns, rows), -1, 0).astype(np.float32)
    side = np.sqrt((width - 1) * (height - 1) / (np.ptp(x) * np.ptp(y)))
    box = 2 * round((side - 1) / 2) + 1
    inside = ~np.isnan(column)
    return CellsInPicture(inside, np.nan_to_num(column), np.nan_to_num(row), (box, box))


def make_chart(rays: HeadRays, head: Head) -> Chart:
    """The chart of a camera's view.

    Parameters
    ----------
    rays : HeadRays, of its pixels and of those around the picture
    head : Head, on which the camera is
    """
    axes, shape = camera_pose(head).rotation, rays.size_px[::-1]
    origin, way = np.array(rays.origin, dtype=float), np.array(rays.direction, dtype=float)
    pivot = nearest_point(origin, way)
    places = _chart_places(way, axes)
    low, size = places.min(axis=1), np.ptp(places, axis=1)
    cell = float(size.max() * (1 + 2 * BESIDE) / CELLS)
    counts = [8 * ceil(side * (1 + 2 * BESIDE) / cell / 8) for side in size]
    corner = low + size / 2 - cell * (np.array(counts) - 1) / 2
    reach = 2 * tan(WIDEST_RAD / 2)
    more = [ceil(min(BEYOND * side, max(reach - side / 2, 0)) / (COARSER * cell)) for side in size]
    inside = [count // COARSER for count in counts]
    # An even number of all: the grid is halved once and again.
    more = [
        count + (-(middle + 2 * count) % 8) // 2 for count, middle in zip(more, inside, strict=True)
    ]
    wide = [middle + 2 * count for middle, count in zip(inside, more, strict=True)]
    outer_corner = corner + cell * (COARSER - 1) / 2 - COARSER * cell * np.array(more)
    places = places.reshape(2, *shape)
    (ux, vx), (uy, vy) = ((z[1:-1, 2:] - z[1:-1, :-2], z[2:, 1:-1] - z[:-2, 1:-1]) for z in places)
    area = np.abs(ux * vy - vx * uy) / 4
    seen = places[:, 1:-1, 1:-1]
    return Chart(
        inner=_grid(axes, pivot, corner, cell, counts),
        outer=_grid(axes, pivot, outer_corner, COARSER * cell, wide),
        block=(slice(more[1], more[1] + inside[1]), slice(more[0], more[0] + inside[0])),
        axes=axes,
        pixels=((seen - corner[:, np.newaxis, np.newaxis]) / cell).astype(np.float32),
        near_mm=float(((origin - pivot[:, np.newaxis]) * way).sum(axis=0).mean()),
        pixel_rad=(np.sqrt(area) / (1 + (seen**2).sum(axis=0) / 4)).astype(np.float32),
    )


def _grid(axes: Floats, pivot: Floats, corner: Floats, cell: float, counts: list[int]) -> ChartGrid:
    columns, rows = counts
    x, y = np.meshgrid(corner[0] + cell * np.arange(columns), corner[1] + cell * np.arange(rows))
    directions, right, down, scale = _directions(x.ravel(), y.ravel())
    return ChartGrid(
        shape=(rows, columns),
        cell=cell,
        corner=corner,
        pivot=pivot,
        directions=axes @ directions,
        right=axes @ right,
        down=axes @ down,
        half_cosine=np.sqrt(scale).reshape(rows, columns).astype(np.float32),
    )


def nearest_point(origin: Floats, way: Floats) -> Floats:
    """(3,) the point whose squared distances from lines add up to the least.

    Parameters
    ----------
    origin, way : (3, N) arrays, places on the lines and unit vectors along them
    """
    across = np.eye(3) * way.shape[1] - way @ way.T
    along = (origin * way).sum(axis=0)
    return np.linalg.solve(across, (origin - along * way).sum(axis=1))


def _chart_places(way: Floats, axes: Floats) -> Floats:
    """(2, N) places of (3, N) unit vectors of the head's frame."""
    seen = axes.T @ way
    return np.asarray(2 * seen[:2] / (1 + seen[2]))


def _directions(x: Floats, y: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """(3, N) directions at places of the chart, camera frame, the axes there, and (N,) c2."""
    scale = 1 / (1 + (x**2 + y**2) / 4)
    half, cross = scale / 2, -x * y * scale / 2
    direction = np.stack([x * scale, y * scale, 2 * scale - 1])
    right = np.stack([1 - x**2 * half, cross, -x * scale])
    down = np.stack([cross, 1 - y**2 * half, -y * scale])
    return direction, right, down, scale


# Light of surfaces that the water scatters on its way to the camera: pictures of Gaussians.


FINEST = 1 / 16  # of a pixel: the narrowest Gaussian
POINT = 0.3  # of a pixel: what is narrower has no width
NARROWEST = 1.3  # cells: the narrowest Gaussian on a grid
FEWEST = 24  # cells a side of the coarsest grid, or up to twice as many
HALVED = np.array([1, 3, 3, 1]) / 4
# Rows of the picture with no more than this part of the brightest pixel's light are smooth, and so
# far from others, in standard deviations of the widest of the narrow Gaussians.
PEAKED, REACH = 0.02, 3.0
# Cosine of incidence of narrow Gaussians.  It hardly matters to the first harmonic over the tangent
# of incidence either: -.017 to -.018 of the even light a pixel away, from .2 to .7.
FACING = 0.6
FINER = 8  # nodes of the kernel's tables, to each of its own


@dataclass(frozen=True)
class Shining:
    """What the surfaces in the chart's cells shine with, summed over each cell.

    Attributes
    ----------
    power : (rows, columns) radiance times area of surface as the camera sees it, mW/sr
    depth : (rows, columns) of power, times the logarithm of the distance from the camera in mm
    tilt : (rows, columns, 3) of power, times the surface's normal, head frame
    """

    power: Picture
    depth: Picture
    tilt: Picture

    def __add__(self, other: "Shining") -> "Shining":
        """Both together."""
        return Shining(self.power + other.power, self.depth + other.depth, self.tilt + other.tilt)


def summed_in_cells(power: Picture, distance: Picture, normal: Picture) -> Shining:
    """What surfaces shine with that are at one distance and have one normal in each cell.

    Parameters
    ----------
    power : (rows, columns) mW/sr
    distance : (rows, columns) mm, from the camera
    normal : (rows, columns, 3) unit vectors, head frame; 0 where there is no surface
    """
    return Shining(power, power * np.log(distance), power[..., np.newaxis] * normal)


@dataclass(frozen=True)
class LevelGrid:
    """The grid of one Gaussian.

    Attributes
    ----------
    level : int, the Gaussian's number
    cell : float, a cell's side on the chart
    vectors : (rows, columns, 3, 3) unit vectors right, down and back to the camera
    scale : (rows, columns) what weights change by where the chart is not to scale
    spread : float, variance by which light is spread already, and will be, in cells squared
    is_pooled : bool, whether the next grid has cells twice as wide
    is_first_coarse : bool, whether it is the first that reaches beyond the picture
    """

    level: int
    cell: float
    vectors: Picture
    scale: Picture
    spread: float
    is_pooled: bool
    is_first_coarse: bool


class CameraLeg:
    """The camera's leg in one water."""

    def __init__(self, chart: Chart, spread: Spread, extinction_per_mm: float) -> None:
        """Fit the kernel.

        Parameters
        ----------
        chart : Chart, of the camera's view
        spread : Spread, of the water
        extinction_per_mm : float, its attenuation
        """
        self._chart = chart
        height, width = chart.pixel_rad.shape
        self._pixel_rad = float(chart.pixel_rad[height // 2, width // 2])
        finest = FINEST * self._pixel_rad
        kernel = scatter_kernel(spread, extinction_per_mm, finest)
        # Elements are seen from the rays' starts, but lie on the chart as from its pivot.
        nearer = 1 + chart.near_mm / RANGE_AXIS.nodes()
        self._steepness, self._sigmas = kernel.steepness, kernel.sigmas
        weights = (
            kernel.weights
            * nearer[:, np.newaxis, np.newaxis, np.newaxis] ** (kernel.steepness[:, np.newaxis])
        )
        self._first = int(np.searchsorted(kernel.sigmas, NARROWEST * chart.inner.cell))
        self._tables = [_finer(weights[:, :, level]) for level in range(len(kernel.sigmas))]
        self._near, self._near_tilted = self._near_weights(weights, nearer)
        # Narrow Gaussians go with about one power of a pixel's size.
        mean = np.average(kernel.steepness[: self._first], weights=self._near.mean(axis=0))
        power = np.float32(2 + mean)
        self._near *= self._pixel_rad**-power
        self._scale = chart.pixel_rad**power
        self._gain_scale = floats(self._scale)
        gains = self._near.sum(axis=1, keepdims=True).astype(np.float32)
        self._gains = mi.Texture1f(mi.TensorXf(gains), use_accel=False)
        self._grids = list(self._level_grids())

    def halo(self, inner: Shining, outer: Shining) -> Picture:
        """(rows, columns) radiance at the chart's inner cells, mW/(mm2 sr).

        It is that by the Gaussians that are wider than a cell.  inner, outer: of the two grids.
        """
        sources, lights = _stack(inner), []
        for grid in self._grids:
            if grid.is_first_coarse:
                wide = _stack(outer)
                wide[self._chart.block] = sources
                sources = wide
            lights.append(self._level(sources, grid))
            if grid.is_pooled:
                # Shared out among the nearest cells of half as many each way, centres kept.
                border = cv2.BORDER_CONSTANT
                sums = cv2.sepFilter2D(
                    sources, -1, HALVED, HALVED, anchor=(1, 1), borderType=border
                )
                sources = _picture(sums[::2, ::2])
        fine = int(log2(COARSER))
        return _sum_levels([*lights[:fine], _sum_levels(lights[fine:])[self._chart.block]])

    def _level_grids(self) -> Iterator[LevelGrid]:
        """The grids of the Gaussians, as coarse as their widths allow."""
        chart, fine = self._chart, int(log2(COARSER))
        cell, vectors = chart.inner.cell, _vectors(chart.inner)
        # Light is shared out among cells at first, and its picture read by cubic splines at last.
        before, after = 1 / 6, 1 / 3
        for number, level in enumerate(range(self._first, len(self._sigmas))):
            if number == fine:
                vectors = _vectors(chart.outer)
            sides = vectors.shape[:2]
            is_even = not any(side % 2 for side in sides)
            is_pooled = number < fine or (is_even and min(sides) > FEWEST)
            scale = vectors[..., 9] ** np.float32(2 * self._steepness[level])
            yield LevelGrid(
                level=level,
                cell=cell,
                vectors=vectors[..., :9].reshape(*sides, 3, 3),
                scale=scale,
                spread=before + after,
                is_pooled=is_pooled,
                is_first_coarse=number == fine,
            )
            if is_pooled:
                size = sides[1] // 2, sides[0] // 2
                vectors = _picture(cv2.resize(vectors, size, interpolation=cv2.INTER_AREA))
                cell *= 2
                before, after = before / 4 + 3 / 16, after / 4 + 3 / 16

    def near_gain(self, distance: mi.Float) -> mi.Float:
        """What narrower Gaussians make of an even radiance of one, at all pixels, row by row.

        distance : Float, of the surfaces along the pixels' rays, mm
        """
        place = (dr.log(distance) - RANGE_AXIS.start) * RANGE_AXIS.scale
        (gain,) = self._gains.eval(mi.Float((place + 0.5) / RANGE_AXIS.count))
        return gain * self._gain_scale

    def near_peaked(self, radiance: Picture, distance: Picture, tilt: Picture) -> Picture:
        """(H, W) what ``near_gain`` times the radiance is to be corrected by where it is peaked.

        Parameters
        ----------
        radiance : (H, W) of the surfaces, mW/(mm2 sr), with no loss on the way to the camera
        distance : (H, W) of the surfaces along the pixels' rays, mm
        tilt : (H, W, 2) of the surfaces, as of ``Chart.tilt``; 0 where the radiance is not peaked
        """
        change = np.zeros_like(radiance)
        brightest = radiance.max(axis=1)
        rows = np.flatnonzero(brightest > PEAKED * brightest.max())
        if not rows.size:
            return change
        sigmas = self._sigmas[: self._first] / self._pixel_rad
        reach = ceil(REACH * sigmas[-1])
        band = slice(max(rows[0] - reach, 0), rows[-1] + reach + 1)
        place = RANGE_AXIS.place(np.clip(distance[band], RANGE_AXIS.low, RANGE_AXIS.high))
        low = np.minimum(place.astype(np.intp), RANGE_AXIS.count - 2)
        part = (place - low).astype(np.float32)
        scaled = radiance[band] * self._scale[band]
        moved = _divergence(scaled[..., np.newaxis] * tilt[band])
        for level in range(int(np.searchsorted(sigmas, POINT)), self._first):
            sigma, gain = sigmas[level], self._near[:, level].astype(np.float32)
            gain = gain[low] + part * np.diff(gain)[low]
            light = gain * (scaled + np.float32(sigma * self._near_tilted[level]) * moved)
            blurred = cv2.GaussianBlur(light, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
            change[band] += blurred - gain * scaled
        return change

    def _near_weights(self, weights: Floats, nearer: Floats) -> tuple[Floats, Floats]:
        """Of the Gaussians narrower than a cell: (R, L) what an even picture of one gives.

        And (L,) the first harmonic over that and the tangent of incidence: it is the same at all
        distances, to 4 %.
        """
        middle = np.searchsorted(COSINE_AXIS.nodes(), FACING)
        cosine = COSINE_AXIS.nodes()[middle]
        even, first = np.moveaxis(weights[:, middle, : self._first] / cosine, -1, 0)
        area = (RANGE_AXIS.nodes() * nearer)[:, np.newaxis] ** 2
        tilted = np.median(first / even, axis=0) * cosine / np.sqrt(1 - cosine**2)
        return even * area * 2 * pi * self._sigmas[: self._first] ** 2, tilted

    def _level(self, sources: Picture, grid: LevelGrid) -> Picture:
        """One Gaussian's light, on its grid.

        Light of a tilted surface is that of an even one and some of its slope (the derivative of a
        Gaussian is x exp(-x2 / 2), the first harmonic).
        """
        sigma = self._sigmas[grid.level] / grid.cell
        x, y, back = np.einsum("rck,rcjk->jrc", sources[..., 2:], grid.vectors)
        aside = np.maximum(np.hypot(x, y), np.finfo(np.float32).tiny)
        cosine = _picture(np.maximum(back / np.hypot(aside, back), COSINE_AXIS.low))
        power, logarithm = sources[..., 0], sources[..., 1]
        log_distance = _picture(logarithm / np.maximum(power, np.finfo(np.float32).tiny))
        weights = self._weights(grid.level, log_distance, cosine)
        power = power * grid.scale / cosine
        even, first = (power * weights[..., k] for k in range(HARMONICS))
        first /= aside
        shared = even + sigma * _divergence(np.dstack([first * x, first * y]))
        blur = np.sqrt(sigma**2 - grid.spread)
        blurred = cv2.GaussianBlur(shared, (0, 0), blur, borderType=cv2.BORDER_CONSTANT)
        return _picture(2 * pi * sigma**2 * blurred)

    def _weights(self, number: int, log_distance: Picture, cosine: Picture) -> Picture:
        """(..., HARMONICS) of one Gaussian, 1/mm2."""
        row = (log_distance - RANGE_AXIS.start) * RANGE_AXIS.scale * FINER
        column = (np.log(cosine) - COSINE_AXIS.start) * COSINE_AXIS.scale * FINER
        table, places = self._tables[number], (_picture(column), _picture(row))
        return _picture(
            cv2.remap(table, *places, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        )


def _picture(values: npt.ArrayLike) -> Picture:
    return np.asarray(values, dtype=np.float32)


def _finer(table: Floats) -> Picture:
    """A table with more nodes, for look-ups that round places to a 32nd between them."""
    for axis in (0, 1):
        count = table.shape[axis]
        places = np.arange((count - 1) * FINER + 1) / FINER
        table = CubicSpline(np.arange(count), table, axis=axis)(places)
    return _picture(np.ascontiguousarray(table))


def _stack(shining: Shining) -> Picture:
    """(rows, columns, 5) all that is summed over cells."""
    return np.dstack([shining.power, shining.depth, shining.tilt])


def _vectors(grid: ChartGrid) -> Picture:
    """(rows, columns, 10) unit vectors right, down and back to the camera; c."""
    vectors = np.vstack([grid.right, grid.down, -grid.directions]).T.reshape(*grid.shape, 9)
    return np.dstack([vectors, grid.half_cosine]).astype(np.float32)


def _sum_levels(pictures: list[Picture]) -> Picture:
    """Pictures on coarser and coarser grids, on the first one's."""
    total = pictures[-1]
    for finer in pictures[-2::-1]:
        rows, columns = finer.shape
        if total.shape != finer.shape:
            total = _picture(cv2.resize(total, (columns, rows)))
        total = finer + total
    return total


def _divergence(across: Picture) -> Picture:
    """How what is tilted to the right and down, (rows, columns, 2), changes that way, per cell."""
    right, down = cv2.split(across)
    slopes = [
        cv2.Sobel(part, cv2.CV_32F, *way, ksize=1, scale=0.5, borderType=cv2.BORDER_CONSTANT)
        for part, way in ((right, (1, 0)), (down, (0, 1)))
    ]
    return _picture(slopes[0] + slopes[1])
