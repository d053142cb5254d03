"""A map of the camera's view in the water and around it: a stereographic chart of directions.

The chart is conformal: the angle q between two directions, at z1 and z2 on the chart, is
2 sin(q / 2) = |z1 - z2| c1 c2, with c the cosine of half their angle from the middle.  All its
rays start at one place, the point that the camera's rays pass nearest to; behind a flat port they
miss it by less than a millimetre.  Around the picture, from where only light that spreads widely
gets into it, the chart's cells are COARSER.
"""

from dataclasses import dataclass
from functools import lru_cache
from math import ceil, tan

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator

from lscan.records import Floats, Mask
from sim.render.firstorder import HeadRays
from sim.scene import Head, camera_pose
from sim.water.planes import LogAxis
from sim.water.spread import Spread

# What the water scatters of a surface's light into a camera's pixel: a sum of Gaussians.
#
# By reciprocity a pixel receives from an element of a surface what a pencil beam along the pixel's
# ray would bring to it (sim.water.spread).  The element lies on a plane, tilted against the line
# of
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
    light = _received(spread, extinction_per_mm, angle)
    moved = _received(spread, extinction_per_mm, angle * SHIFT)
    weights, other = _fitted(angle, sigmas, light), _fitted(angle, sigmas, moved)
    ratio = np.median(other[..., 0] / weights[..., 0], axis=(0, 1))
    return ScatterKernel(sigmas, weights, np.log(np.maximum(ratio, 1e-3)) / np.log(SHIFT))


def _received(spread: Spread, extinction: float, angle: Floats) -> Floats:
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


def _fitted(angle: Floats, sigmas: Floats, light: Floats) -> Floats:
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
        return (_on_chart(way, self.axes) - grid.corner[:, np.newaxis]) / grid.cell

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
    places = _on_chart(way, axes)
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


def _on_chart(way: Floats, axes: Floats) -> Floats:
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
