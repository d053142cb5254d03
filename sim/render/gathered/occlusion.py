"""How much of the line's halo the tank's surfaces leave, against what planes in their place would.

The Gaussians of ``camera`` take each place of the line for a plane, tilted as the surface is there,
on which the camera's rays end too; light of parts of the line that the camera does not see is left
out.  Here the light that the water scatters once between the line and the camera is summed with the
surfaces as they are, and with such planes: their ratio differs little from 1.
"""

from dataclasses import dataclass
from itertools import pairwise, product
from math import pi, sqrt

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np

from lscan.records import Floats
from sim.render.ambient import reflectance
from sim.render.firstorder import HeadFrame
from sim.render.gathered.chart import Chart, Picture
from sim.render.gathered.line import facing
from sim.render.gathered.veilphotons import COLUMNS, PLACES, ROWS, FieldOfView
from sim.render.plugins.arrays import floats, indices, opaque_vector, vectors
from sim.render.plugins.sheet import LaserSheet
from sim.render.sampled.integrator import SheetIntegrator
from sim.scene import Pose

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
        self,
        scene: mi.Scene,
        eye: mi.Point3f,
        way: mi.Vector3f,
        end: mi.Float,
        line: LinePlaces,
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
        left = dr.block_sum(dr.select(free & ~hidden, power * share, 0.0), PARTS)
        whole = dr.block_sum(seen * share, PARTS)
        dr.eval(left, whole)
        return left, whole


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
            light = dr.zeros(mi.Float, ROWS * COLUMNS)
            dr.scatter_reduce(dr.ReduceOp.Add, light, self._share, self._cell, counts)
            sums.append(light)
        dr.eval(sums)
        left, whole = (
            cv2.GaussianBlur(np.array(light).reshape(ROWS, COLUMNS), (0, 0), SMOOTH)
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
