"""How much of the veil the tank's surfaces leave, against what planes in their place would.

The table of ``veil`` takes each surface for a plane through the place where a ray ends.  Some of
its photons' paths, which stand still against the head, are held against both that plane and the
surfaces themselves: their ratio is smooth, and hardly any of the paths' own noise is left in it.
"""

from itertools import pairwise, product

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np

from lscan.records import Floats
from sim.render.gathered.chart import Picture
from sim.render.gathered.veilcounts import COLUMNS, PLACES, ROWS, FieldOfView
from sim.render.plugins.arrays import floats, indices, vectors
from sim.render.plugins.opaque import opaque_vector
from sim.render.plugins.sheet import LaserSheet
from sim.render.sparse.rays import HeadFrame
from sim.scene import Pose

SMOOTH = 0.5  # cells, standard deviation of the Gaussian over which paths are summed
LEAST_MM = 1e-6  # of a path's leg: shorter ones are none


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
            length = dr.maximum(dr.norm(leg), LEAST_MM)
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
