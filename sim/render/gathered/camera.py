"""Light of surfaces that the water scatters on its way to the camera: pictures of Gaussians.

What surfaces shine with is summed in the cells of a chart around the view, then convolved with the
kernel's Gaussians, each on a grid about as coarse as it is wide.  Gaussians narrower than a cell
act on the picture's own pixels: of direct light as they are, of smoother light as if they had no
width at all.  Grids are halved and doubled by the same weights, those of a quadratic spline, of
which a Gaussian's width is relieved: OpenCV's cubics shift light by up to .05 of a cell.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from math import ceil, log2, pi

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline

from lscan.records import Floats
from sim.render.gathered.chart import (
    COARSER,
    COSINE_AXIS,
    HARMONICS,
    RANGE_AXIS,
    Chart,
    ChartGrid,
    Picture,
    scatter_kernel,
)
from sim.render.plugins.arrays import floats
from sim.water.spread import Spread

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
        self._power = np.float32(2 + mean)
        self._near *= self._pixel_rad**-self._power
        self._gain_scale = floats(chart.pixel_rad**self._power)
        gains = self._near.sum(axis=1, keepdims=True).astype(np.float32)
        self._gains = mi.Texture1f(mi.TensorXf(gains), use_accel=False)
        self._grids = list(self._level_grids())

    def halo(self, inner: Shining, outer: Shining) -> Picture:
        """(rows, columns) radiance at the chart's inner cells, mW/(mm2 sr).

        It is that by the Gaussians that are wider than a cell.  inner, outer: of the two grids.
        """
        sources, lights = _stacked(inner), []
        for grid in self._grids:
            if grid.is_first_coarse:
                wide = _stacked(outer)
                wide[self._chart.block] = sources
                sources = wide
            lights.append(self._level(sources, grid))
            if grid.is_pooled:
                sources = _pooled(sources)
        fine = int(log2(COARSER))
        return _summed([*lights[:fine], _summed(lights[fine:])[self._chart.block]])

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
        scaled = radiance[band] * self._chart.pixel_rad[band] ** self._power
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


def _stacked(shining: Shining) -> Picture:
    """(rows, columns, 5) all that is summed over cells."""
    return np.dstack([shining.power, shining.depth, shining.tilt])


def _vectors(grid: ChartGrid) -> Picture:
    """(rows, columns, 10) unit vectors right, down and back to the camera; c."""
    vectors = np.vstack([grid.right, grid.down, -grid.directions]).T.reshape(*grid.shape, 9)
    return np.dstack([vectors, grid.half_cosine]).astype(np.float32)


def _pooled(shining: Picture) -> Picture:
    """On a grid of half as many cells each way.

    It is shared out among the nearest cells such that its centre stays where it is.
    """
    sums = cv2.sepFilter2D(
        shining, -1, HALVED, HALVED, anchor=(1, 1), borderType=cv2.BORDER_CONSTANT
    )
    return _picture(sums[::2, ::2])


def _summed(pictures: list[Picture]) -> Picture:
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
