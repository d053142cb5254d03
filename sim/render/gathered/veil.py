"""The veil of higher orders, and how much of it and of the halo the tank's surfaces leave.

Camera and laser stand still against each other, so what a ray of the camera sees of it depends on
where surfaces end the water alone.  A surface is taken for a plane through the place where the ray
ends, as tilted as what the camera sees of the tank is in the mean: light counts whose deepest place
of scattering lies above.  Photons say once how much light that is, as a smooth function of the ray
and the depth; it is kept in the user's cache.  A picture is then read from a lattice of rays, and
corrected for what surfaces hide that are no such plane (``veilpaths``).
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise, product
from math import exp, pi, sqrt

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.linalg import solveh_banded
from scipy.sparse import csc_array, dia_array, diags_array, eye_array, kron

from lscan.files.cache import long_work
from lscan.records import Floats, Ints, Mask
from sim.render.ambient import reflectance
from sim.render.firstorder import HEAD, HeadFrame, HeadRays
from sim.render.gathered.halo import Chart, Picture, nearest_point
from sim.render.gathered.line import facing
from sim.render.gathered.veilphotons import (
    COLUMNS,
    DEPTHS,
    PLACES,
    ROWS,
    FieldOfView,
    crossing_within,
    veil_counts,
)
from sim.render.plugins.arrays import floats, indices, opaque_vector, vectors
from sim.render.plugins.sheet import LaserSheet
from sim.render.sampled.integrator import SheetIntegrator
from sim.render.spreads import PHOTONS
from sim.scene import Pose
from sim.water import Optics
from sim.water.spread import ANGLE_AXIS, between_nodes
from sim.water.tablecache import kept_arrays

# How much of the line's halo the tank's surfaces leave, against what planes in their place would.
#
# The Gaussians of ``camera`` take each place of the line for a plane, tilted as the surface is
# there, on which the camera's rays end too; light of parts of the line that the camera does not see
# is left out.  Here the light that the water scatters once between the line and the camera is
# summed with the surfaces as they are, and with such planes: their ratio differs little from 1.


BLOCK = 4  # fine cells of the chart, each way, that share a ray
# Rays of a sheet, and how many of them share a place of the line.
FAN, SHARED = 1024, 2
PARTS = FAN // SHARED
# From each such place light gets into a camera's ray by one place of that: so much farther on, of
# what the phase function alone lets in, than from the place before and into the ray before.  What
# is left is known to 0.4 %, to 0.2 % with twice the parts.
GOLDEN, SILVER = (sqrt(5) - 1) / 2, sqrt(2) - 1
START_MM = 0.02  # of rays, above surfaces: chords of a wave's facets lie within
LEAST_MM = 1e-3  # between the line and a camera's ray
MOST = 2.0  # where surfaces leave more, nearly all of the line is hidden from the camera


@dataclass(frozen=True)
class FanRays:
    """FAN rays of a sheet in the head's frame: starts, mm, directions and power, mW."""

    start: mi.Point3f
    way: mi.Vector3f
    power: mi.Float


@dataclass(frozen=True)
class LinePlaces:
    """PARTS of a line, in the world.

    point: mm, just above the surface.  normal: of the surface.  power: what it sends on, mW/sr.
    seen: how much of that is sent from where the camera sees it.
    """

    point: mi.Point3f
    normal: mi.Vector3f
    power: mi.Float
    seen: mi.Float


class HaloPaths:
    """Paths from the sheets' lines to the camera, which stand still in the head's frame."""

    def __init__(self, integrator: SheetIntegrator, chart: Chart) -> None:
        """Lay them out.

        Parameters
        ----------
        integrator : SheetIntegrator, its sheets placed in the head's frame
        chart : Chart, of the camera's view
        """
        # Kept, for the tank tunes its integrator to other wavelengths: pictures know no order.
        self._phase, self._extinction = integrator.phase, integrator.extinction
        self._grid = chart.inner
        self._fans = [_fan(sheet) for sheet in integrator.sheets]
        rows, columns = (side // BLOCK for side in chart.inner.shape)
        row, column = np.indices((rows, columns)).reshape(2, -1) * BLOCK + (BLOCK - 1) / 2
        ways = chart.between(chart.inner, np.stack([column, row]))
        self._shape, self._near = (rows, columns), chart.near_mm
        self._radius = BLOCK / 2 * chart.inner.cell
        self._way = mi.Vector3f(vectors(ways))
        self._pivot = mi.Point3f(vectors(chart.inner.pivot[:, np.newaxis]))
        dr.eval(self._way, self._pivot)

    def left(self, scene: mi.Scene, head: Pose) -> Picture:
        """Of the light at the chart's fine cells, what surfaces leave over what planes would.

        Parameters
        ----------
        scene : mi.Scene, the surfaces
        head : Pose, where the head stands
        """
        frame = HeadFrame(head)
        eye, way = frame.point(self._pivot), frame.direction(self._way)
        ray = mi.Ray3f(mi.Point3f(eye + way * self._near), way)
        end = self._near + scene.ray_intersect_preliminary(ray).t
        sums = np.zeros((2, *self._shape))
        for fan in self._fans:
            line = self._line(scene, frame, fan, eye)
            dr.eval(end, way, line)
            sums += [
                np.array(light).reshape(self._shape)
                for light in self._lights(scene, eye, way, end, line)
            ]
        left, whole = sums
        ratio = np.divide(left, whole, out=np.ones_like(left), where=whole > 0)
        size = self._grid.shape[::-1]
        return np.asarray(cv2.resize(np.minimum(ratio, MOST).astype(np.float32), size))

    def _line(self, scene: mi.Scene, frame: HeadFrame, fan: FanRays, eye: mi.Point3f) -> LinePlaces:
        """What a sheet lights."""
        si = scene.ray_intersect(mi.Ray3f(frame.point(fan.start), frame.direction(fan.way)))
        loss = dr.exp(-self._extinction * si.t)
        power = dr.select(si.is_valid(), fan.power * reflectance(si) * loss / pi, 0.0)
        normal = facing(si)
        point = mi.Point3f(dr.select(si.is_valid(), si.p + START_MM * normal, eye))
        out = eye - point
        far = dr.maximum(dr.norm(out), LEAST_MM)
        hidden = scene.ray_test(mi.Ray3f(point, out / far, far, 0.0, []), power > 0)
        seen = dr.select(hidden, 0.0, power)
        middle = SHARED * dr.arange(mi.UInt32, PARTS) + SHARED // 2
        is_there = dr.gather(mi.Float, power, middle) > 0
        return LinePlaces(
            dr.gather(mi.Point3f, point, middle),
            dr.gather(mi.Vector3f, normal, middle),
            *(dr.select(is_there, dr.block_sum(light, SHARED), 0.0) for light in (power, seen)),
        )

    def _lights(
        self, scene: mi.Scene, eye: mi.Point3f, way: mi.Vector3f, end: mi.Float, line: LinePlaces
    ) -> tuple[mi.Float, mi.Float]:
        """Light scattered once into the camera's rays, left by surfaces, and by planes."""
        phase, extinction = self._phase, self._extinction
        lane = dr.arange(mi.UInt32, dr.width(way) * PARTS)
        cell, source = lane // PARTS, lane % PARTS
        way, end = dr.gather(mi.Vector3f, way, cell), dr.gather(mi.Float, end, cell)
        point = dr.gather(mi.Point3f, line.point, source)
        normal = dr.gather(mi.Vector3f, line.normal, source)
        power, seen = (dr.gather(mi.Float, light, source) for light in (line.power, line.seen))
        offset = point - eye
        foot = dr.dot(offset, way)
        beside = dr.maximum(dr.norm(offset - way * foot), LEAST_MM)
        below = phase.line_integral(dr.atan2(beside, foot - self._near))
        above = phase.line_integral(mi.Float(pi))
        part = GOLDEN * mi.Float(source) + SILVER * mi.Float(cell)
        turned = phase.sample_line(below, above, part - dr.floor(part))
        along = dr.maximum(foot - beside / dr.tan(turned), self._near)
        leg = eye + way * along - point
        length = dr.maximum(dr.norm(leg), LEAST_MM)
        leg /= length
        share = dr.maximum(dr.dot(leg, normal), 0) * (above - below)
        share *= dr.exp(-extinction * (along + length)) / dr.hypot(beside, foot * self._radius)
        free = (power * share > 0) & (along < end)
        hidden = scene.ray_test(mi.Ray3f(point, leg, length, 0.0, []), free)
        left, whole = dr.select(free & ~hidden, power * share, 0.0), seen * share
        dr.eval(left, whole)  # once: each sum would work both out
        return dr.block_sum(left, PARTS), dr.block_sum(whole, PARTS)


def _fan(sheet: LaserSheet) -> FanRays:
    """Rays of a sheet at equal angles."""
    step = 2 * sheet.half_angle / FAN
    phi = step * (dr.arange(mi.Float, FAN) + 0.5) - sheet.half_angle
    way = dr.normalize(sheet.direction(phi))
    fan = FanRays(sheet.apex(mi.Float(0)), way, sheet.power_density(phi) * step)
    dr.eval(fan.start, fan.way, fan.power)
    return fan


# How much of the veil the tank's surfaces leave, against what planes in their place would.
#
# The table of ``veil`` takes each surface for a plane through the place where a ray ends.  Some of
# its photons' paths, which stand still against the head, are held against both that plane and the
# surfaces themselves: their ratio is smooth, and hardly any of the paths' own noise is left in it.


SMOOTH = 0.5  # cells, standard deviation of the Gaussian over which paths are summed
LEAST_LEG_MM = 1e-6  # of a path's leg: shorter ones are none


class VeilPaths:
    """Paths of one sheet's light in the head's frame."""

    def __init__(self, paths: Floats, sheet: LaserSheet, view: FieldOfView, level: Floats) -> None:
        """Lay them out.

        Parameters
        ----------
        paths : (N, 2 + 3 PLACES) array, of ``VeilCounts``
        sheet : LaserSheet, placed in the head's frame
        view : FieldOfView, whose cells the light is summed in
        level : (3,) array, the unit vector along which depth is measured
        """
        paths = paths[np.argsort(paths[:, 1])]  # those above all surfaces side by side
        places = paths[:, 2:].reshape(-1, PLACES, 3)
        seen = places[:, -1] - view.pinhole_mm
        far = np.linalg.norm(seen, axis=1)
        (right, down), span = view.tangents(seen), view.high - view.low
        column = np.clip((right - view.low[0]) / span[0] * COLUMNS, 0, COLUMNS - 1).astype(int)
        row = np.clip((down - view.low[1]) / span[1] * ROWS, 0, ROWS - 1).astype(int)
        self._cell = indices(row * COLUMNS + column)
        self._share, self._depth = floats(paths[:, 0]), floats(paths[:, 1])
        self._far, self._slope = floats(far), floats(seen @ level / far)
        self._way = mi.Vector3f(vectors((seen / far[:, np.newaxis]).T))
        self._places = [mi.Point3f(vectors(places[:, k].T)) for k in range(PLACES)]
        self._apex = np.array(sheet.apex(mi.Float(0)), dtype=float).ravel()
        self._view, self._level = view, level
        dr.eval(self._cell, self._share, self._depth, self._far, self._slope, self._way)
        dr.eval(self._places)

    def left(self, scene: mi.Scene, head: Pose) -> Picture:
        """(ROWS, COLUMNS) light that surfaces leave over what planes in their place would.

        Parameters
        ----------
        scene : mi.Scene, the surfaces
        head : Pose, where the head stands
        """
        frame = HeadFrame(head)
        near = self._depth <= np.float32(self._highest(scene, head))
        way, start = frame.direction(self._way), self._view.start_mm
        camera = frame.point(mi.Point3f(opaque_vector(self._view.pinhole_mm)))
        ray = mi.Ray3f(camera + way * start, way)
        end = start + scene.ray_intersect_preliminary(ray, active=~near).t
        plane = near | (self._depth <= end * self._slope)
        free = near | (self._far <= end)
        corners = [mi.Point3f(opaque_vector(self._apex)), *self._places]
        for here, there in pairwise(map(frame.point, corners)):
            leg = there - here
            length = dr.maximum(dr.norm(leg), LEAST_LEG_MM)
            free &= ~scene.ray_test(mi.Ray3f(here, leg / length, length, 0.0, []), free & ~near)
        sums = []
        for counts in (free, plane):
            # Exact enough that the order of the threads does not show.
            light, share = dr.zeros(mi.Float64, ROWS * COLUMNS), mi.Float64(self._share)
            dr.scatter_reduce(dr.ReduceOp.Add, light, share, self._cell, counts)
            sums.append(light)
        dr.eval(sums)
        left, whole = (
            cv2.GaussianBlur(np.array(light, np.float32).reshape(ROWS, COLUMNS), (0, 0), SMOOTH)
            for light in sums
        )
        # One path is added to both, where hardly any is.
        return np.asarray((left + 1) / (whole + 1), np.float32)

    def _highest(self, scene: mi.Scene, head: Pose) -> float:
        """The depth, mm, above which there is no surface."""
        box = scene.bbox()
        corners = np.array(list(product(*zip(box.min, box.max, strict=True))), dtype=float)
        seen = (corners - head.origin_mm) @ head.rotation - self._view.pinhole_mm
        return float((seen @ self._level).min())


# The veil of second and higher orders: laser light that met no surface, turned more than once.


# Smooth positive fields from counts in cells.
#
# The counts are quasi-Poisson, and second differences of the field's logarithm have a Gaussian
# prior (Whittaker 1923), as in ``sim.water.spread``.


# Standard deviation a priori of the logarithm's second difference over cells, and of one across an
# edge, beside which light falls by several times within a cell.
CURVATURE, BROKEN = 0.1, 3.0
RIDGE = 1e-4  # for the plane that the prior leaves free, where nothing was counted
ITERATIONS, FARTHEST, CLOSE = 30, 2.0, 1e-3  # of Newton's method, and its steps
FEWEST = 1e-6  # counts


def smooth_field(light: Floats, squared: Floats, lit: Mask) -> Floats:
    """The field in the cells; same shape as ``light``.

    Parameters
    ----------
    light : (H, W) array, sums in each cell
    squared : (H, W) array, sums of the squares of what was summed
    lit : (H, W) array of bool, on either side of an edge
    """
    if light.sum() <= 0:
        return np.zeros_like(light)
    unit = squared.sum() / light.sum()  # of counts that scatter as much as these sums
    counts = light.ravel() / unit
    prior = _prior(lit.tobytes(), lit.shape)
    mean = np.log(counts.mean())
    log_rate = np.zeros(counts.shape)  # above the mean
    for _ in range(ITERATIONS):
        rate = np.maximum(exp(mean) * np.exp(np.clip(log_rate, -50, 50)), FEWEST)
        wanted = log_rate + counts / rate - 1
        inverse = prior.copy()
        inverse[0] += rate
        step = solveh_banded(inverse, rate * wanted, overwrite_ab=True, lower=True) - log_rate
        log_rate += np.clip(step, -FARTHEST, FARTHEST)
        if np.abs(step).max() < CLOSE:
            break
    return np.reshape(unit * np.exp(mean + log_rate), light.shape)


@lru_cache(maxsize=4)  # the same for all layers of a table
def _prior(lit: bytes, shape: tuple[int, int]) -> Floats:
    """Inverse covariance a priori of the cells' logarithms: its diagonal and those beneath it."""
    cells = np.frombuffer(lit, dtype=bool)
    inverse = csc_array(RIDGE * eye_array(cells.size))
    second = [csc_array(np.diff(np.eye(size), 2, axis=0)) for size in shape]
    rows, columns = (eye_array(size) for size in shape)
    for difference in (csc_array(kron(second[0], columns)), csc_array(kron(rows, second[1]))):
        beside = abs(difference).sign() @ cells.astype(float)  # of the three cells
        spread = np.where((beside > 0) & (beside < 3), BROKEN, CURVATURE)
        inverse = csc_array(inverse + difference.T @ diags_array(spread**-2.0) @ difference)
    diagonals = dia_array(inverse)
    banded = np.zeros((1 - diagonals.offsets.min(), cells.size))
    for offset, values in zip(diagonals.offsets, diagonals.data, strict=True):
        if offset <= 0:
            banded[-offset, : values.size] = values
    return banded


# The veil of second and higher orders: laser light that met no surface, turned more than once.


FORMAT = 4  # of the kept files: raised where other numbers would be written
SHEET_PHOTONS = PHOTONS // 10  # of a sheet
SEED = 1
STEP = 3  # pixels between the rays of the lattice, odd: it has a pixel's centre
# Rays that go down less steeply than this do not end the water by their depth.
LEAST_SLOPE = 0.15
MARGIN = 0.02  # of the field of view's tangents, about the outermost rays
# The outermost cells of depth end here, mm.
SHALLOWEST, DEEPEST = -1600.0, 2400.0
INFINITE_MM = 1e6
# Within so many mm what is seen rises from nothing: the outermost cell is too wide to show it.
RISING_MM = 100.0
EDGES = np.concatenate([[SHALLOWEST], DEPTHS, [DEEPEST]])


class HigherVeil:
    """The veil of one water, rig and wavelength, in which nothing is fitted to other renderers.

    Against the judge in thirteen windows of 48 columns about the line, random rigs over a board, a
    block, a mesh and sandwaves, b d of 0.1 to 5, it is 1.8 % too dark to 1.9 % too bright in the
    whole; in fifths of their rows, at b d of 1 and more, 7 % too dark to 10 % too bright.
    """

    def __init__(
        self,
        water: Optics,
        sheets: Sequence[LaserSheet],
        rays: HeadRays,
        upright: Floats | None = None,
        photons: int = SHEET_PHOTONS,
        seed: int = SEED,
    ) -> None:
        """Count photons, unless the user's cache holds what they said.

        Parameters
        ----------
        water : Optics
        sheets : sequence of LaserSheet, which are left in the head's frame
        rays : HeadRays
        upright : (3,) array or None, mean normal of the surfaces, head frame; None: across the
            laser's axis
        photons : int, of each sheet, how many at least
        seed : int, of the random numbers
        """
        width, height = (size - 2 for size in rays.size_px)
        self._shape = height, width
        self._down, self._across = (
            np.minimum(np.arange(STEP // 2, size + STEP // 2, STEP), size - 1)
            for size in (height, width)
        )
        self._sheets: list[_SheetVeil] = []
        self._paths: list[VeilPaths] = []
        if water.scattering_per_mm <= 0:
            return
        lattice = np.add.outer((self._down + 1) * (width + 2), self._across + 1)
        view = field_of_view(rays)
        for sheet in sheets:
            sheet.place(HEAD)
            level = _level(sheet, rays, view, upright)
            kept = _kept_table(water, sheet, view, level, photons, seed)
            self._sheets.append(_SheetVeil.of(kept["above"], sheet, rays, view, level, lattice))
            self._paths.append(VeilPaths(kept["paths"], sheet, view, level))

    def left(self, scene: mi.Scene, head: Pose) -> list[Picture]:
        """Of each sheet, what surfaces leave over what planes would; ``VeilPaths.left``.

        Parameters
        ----------
        scene : mi.Scene, the surfaces
        head : Pose, where the head stands
        """
        return [paths.left(scene, head) for paths in self._paths]

    def picture(self, distance: Picture, left: Sequence[Picture] | None = None) -> Picture:
        """(H, W) radiance in the air, mW/(mm2 sr), the camera's weight included.

        Parameters
        ----------
        distance : (H, W) array, mm along each pixel's ray to the surface, infinite without one
        left : sequence of arrays, as ``left`` has them; of planes if None
        """
        ends = distance[self._down[:, np.newaxis], self._across]
        light = np.zeros_like(ends)
        for number, sheet in enumerate(self._sheets):
            light += sheet.before(ends) * (1 if left is None else sheet.read(left[number]))
        size = light.shape[1] * STEP, light.shape[0] * STEP
        height, width = self._shape
        return np.asarray(cv2.resize(light, size)[:height, :width])


@dataclass(frozen=True)
class _SheetVeil:
    """One sheet's veil along N rays of a lattice.

    crossing, slope: (h, w), of each ray: mm to the sheet, and depth per mm.  light: (N, E) what is
    seen of light above EDGES, mW/(mm2 sr) with the camera's weight.  column, row: (h, w) in cells.
    """

    crossing: Picture
    slope: Picture
    light: Picture
    column: Picture
    row: Picture

    @classmethod
    def of(
        cls,
        table: Floats,
        sheet: LaserSheet,
        rays: HeadRays,
        view: FieldOfView,
        level: Floats,
        lattice: Ints,
    ) -> "_SheetVeil":
        """Read a table of a sheet of 1 mW for the (h, w) rays of these numbers."""
        crossing = np.array(crossing_within(sheet, mi.Ray3f(rays.origin, rays.direction)))[lattice]
        origin, direction = (np.array(v).T[lattice] for v in (rays.origin, rays.direction))
        seen = (origin + direction * crossing[..., np.newaxis] - view.pinhole_mm).reshape(-1, 3)
        column, row = (
            (tangent - low) / (high - low) * count - 0.5
            for tangent, low, high, count in zip(
                view.tangents(seen), view.low, view.high, (COLUMNS, ROWS), strict=True
            )
        )
        above = [between_nodes(layer, row, column) for layer in table]
        weight = np.array(rays.weight)[lattice].ravel() * np.array(sheet.power)
        light = np.stack(above, axis=-1) * weight[:, np.newaxis]
        slope, column, row = (v.reshape(crossing.shape) for v in (direction @ level, column, row))
        columns = crossing, slope, light, column, row
        return cls(*(np.ascontiguousarray(v, np.float32) for v in columns))

    def read(self, cells: Picture) -> Picture:
        """(h, w) of the rays, between the middles of (ROWS, COLUMNS) cells."""
        border = cv2.BORDER_REPLICATE
        return np.asarray(cv2.remap(cells, self.column, self.row, cv2.INTER_LINEAR, None, border))

    def before(self, distance: Picture) -> Picture:
        """(h, w) light that reaches the camera where surfaces end its rays at (h, w) distances."""
        depth = (np.minimum(distance, np.float32(INFINITE_MM)) - self.crossing) * self.slope
        place = np.interp(depth.ravel(), EDGES, np.arange(len(EDGES)))
        cell = np.minimum(place.astype(np.intp), len(EDGES) - 2)
        part = (place - cell).astype(np.float32)
        cell += np.arange(len(cell)) * len(EDGES)
        flat = self.light.ravel()
        low = flat[cell]
        light = (low + (flat[cell + 1] - low) * part).reshape(distance.shape)
        return np.asarray(light * np.minimum(distance * np.float32(1 / RISING_MM), 1))


def field_of_view(rays: HeadRays) -> FieldOfView:
    """The pinhole in the water that the rays come nearest to, by least squares, and their cells.

    Parameters
    ----------
    rays : HeadRays
    """
    origin, direction = (np.array(v, dtype=float).T for v in (rays.origin, rays.direction))
    pinhole = nearest_point(origin.T, direction.T)
    ahead = direction.mean(axis=0)
    ahead /= np.linalg.norm(ahead)
    right = direction[rays.size_px[0] - 1] - direction[0]
    right -= ahead * (right @ ahead)
    right /= np.linalg.norm(right)
    start = float(np.mean(np.sum((origin - pinhole) * direction, axis=1)))
    axes = np.stack([right, np.cross(ahead, right), ahead])
    tangents = (direction @ axes[:2].T) / (direction @ ahead)[:, np.newaxis]
    low, high = tangents.min(axis=0) - MARGIN, tangents.max(axis=0) + MARGIN
    return FieldOfView(pinhole, axes, low, high, max(start, 0.0))


def _level(sheet: LaserSheet, rays: HeadRays, view: FieldOfView, upright: Floats | None) -> Floats:
    """The unit vector along which depth is measured: into the surfaces where all rays go down it.

    The fan's axis where there are none.  Else that between it and the camera's, or the camera's.
    """
    direction = np.array(rays.direction)
    axis = np.array(sheet.axis, dtype=float).ravel() if upright is None else -upright
    between = axis + view.axes[2]
    between /= max(float(np.linalg.norm(between)), 1e-9)
    for level in (axis, between):
        if (level @ direction).min() > LEAST_SLOPE:
            return level
    return view.axes[2]


def _within_fan(sheet: LaserSheet, view: FieldOfView) -> Mask:
    """(ROWS, COLUMNS) whether a cell's middle ray crosses the sheet within its fan."""
    column, row = ((np.arange(count) + 0.5) / count for count in (COLUMNS, ROWS))
    right, down = (
        low + (high - low) * place
        for low, high, place in zip(view.low, view.high, (column, row), strict=True)
    )
    tangents = np.stack([*np.meshgrid(right, down), np.ones((ROWS, COLUMNS))], axis=-1)
    towards = vectors((tangents @ view.axes).reshape(-1, 3).T)
    ray = mi.Ray3f(mi.Point3f(view.pinhole_mm), dr.normalize(towards))
    phi, _, _ = sheet.coordinates(ray(crossing_within(sheet, ray)), mi.Float(0))
    return np.reshape(np.array(dr.abs(phi) <= sheet.half_angle), (ROWS, COLUMNS))


def _kept_table(
    water: Optics, sheet: LaserSheet, view: FieldOfView, level: Floats, photons: int, seed: int
) -> dict[str, Floats]:
    """Light above EDGES of a sheet of 1 mW, mW/(mm2 sr) in the water, and some paths of it.

    above: (E, ROWS, COLUMNS).  paths: of ``VeilCounts``.
    """

    def made() -> dict[str, Floats]:
        with long_work("the veil of this water and rig") as progress:
            counts = veil_counts(sheet, water, view, level, photons, seed, progress)
        lit = _within_fan(sheet, view)
        above = np.zeros((len(EDGES), ROWS, COLUMNS))
        for kind in zip(counts.light, counts.squared, strict=True):
            layers = [smooth_field(*cells, lit) for cells in zip(*kind, strict=True)]
            above[1:] += np.cumsum(layers, axis=0)
        return {"above": above, "paths": counts.paths}

    coefficients = [water.absorption_per_mm, water.scattering_per_mm]
    sheets = (
        sheet.half_angle, sheet.fan_peak, sheet.fan_rise, sheet.waist, sheet.waist_distance,
        sheet.rayleigh, sheet.bow_table, sheet.rest, sheet.across, sheet.normal, sheet.axis,
    )  # fmt: skip
    geometry = view.pinhole_mm, view.axes, view.low, view.high, view.start_mm, level
    numbers = (
        [FORMAT, photons, seed, sheet.is_gaussian_fan, sheet.is_bowed, *coefficients],
        water.phase(ANGLE_AXIS.nodes()),
        *(np.array(values) for values in sheets),
        *geometry,
    )
    told = b"".join(np.asarray(values, dtype=float).tobytes() for values in numbers)
    return kept_arrays(f"veil-{hashlib.sha256(told).hexdigest()[:32]}", made)
