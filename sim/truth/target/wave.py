"""The sandwave block: a height field over a square, its rims, wedges and sides."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize.elementwise import find_root

from lscan.config.targets import Sandwave
from lscan.errors import InputError
from lscan.records import Floats, Mask
from sim.scene import Pose
from sim.truth.bow import Bow
from sim.truth.target.surfaces import SELF_MM, Polygon, TankSurface, between, extrusion, stretch

SAMPLE_MM = 0.05  # of the section: its chords stay within 1e-4 mm of eq. (4)
MARCH_MM = 0.25  # along lines of sight: a crest they cut by less than 3 um may be missed


@dataclass(frozen=True)
class Wave:
    """The surface of eq. (4) over its square.  pose: workpiece frame to world frame."""

    shape: Sandwave
    pose: Pose

    def cut(self, sheet: Pose, bow: Bow | None = None) -> Floats:
        """(M, 2, 2) chords of the section, each at most 0.05 mm wide in x.

        Raises InputError where block or sheet are tilted so far that the sheet may cut the
        surface more than once in the same x.

        Parameters
        ----------
        sheet : Pose, frame of the sheet's plane to world frame
        bow : Bow or None, how far the sheet lies off the plane
        """
        inner = Pose(self.pose.rotation.T @ sheet.rotation, self.pose.invert(sheet.origin_mm))

        def place(z: Floats, x: Floats) -> Floats:
            """(N, 3) points of the sheet in the workpiece frame."""
            y = np.zeros_like(x) if bow is None else bow.offset_mm(x, z)
            return inner.apply(np.column_stack([x, y, z]))

        def clearance(z: Floats, x: Floats) -> Floats:
            at = place(z, x)
            return at[:, 2] - self.shape.height_mm(at[:, 0], at[:, 1])

        x = self._reach(sheet)
        level = -place(np.zeros_like(x), x)[:, 2] / inner.rotation[2, 2]
        up = (place(level + 1, x) - place(level - 1, x)) / 2  # tangents of lines of one x
        self._check_mild(up)
        # Beyond the square eq. (4) may run higher; twice the amplitude still brackets it
        # wherever the result is used, which is over the square.
        span = (2 * self._amplitude() + 2 * np.abs(place(level, x)[:, 2])) / up[:, 2]
        z = find_root(clearance, (level - span, level + span), args=(x,)).x
        points, at = np.column_stack([x, z]), place(z, x)
        low, high = np.array([0, 0, -np.inf]), np.array([self.shape.side_mm] * 2 + [np.inf])
        parts = stretch(at[:-1], at[1:], low, high, short_mm=0.0)
        over = parts[0] < parts[1]
        ends = [between(points[:-1][over], points[1:][over], part[over]) for part in parts]
        return np.stack(ends, axis=1)

    def blocks(self, start: Floats, end: Floats) -> Mask:
        """(N,) whether the surface comes between starts and ends.

        A point of the surface that faces away is blocked exactly; a cast shadow is found by
        marching.  Lines that would pass through the square's vertical walls count as well.

        Parameters
        ----------
        start, end : (N, 3) array, mm, world frame
        """
        here, there = self.pose.invert(start), self.pose.invert(end)
        blocked = self._faces_away(here, there)
        rays = np.flatnonzero(~blocked)
        top, side = self._amplitude(), self.shape.side_mm
        low, high = np.array([0, 0, -top]), np.array([side, side, top])
        first, last = stretch(here[rays], there[rays], low, high)
        length = np.linalg.norm(there[rays] - here[rays], axis=1) * (last - first)
        rays, first, last = rays[length > 0], first[length > 0], last[length > 0]
        steps = int(np.ceil(length.max(initial=0.0) / MARCH_MM)) + 1
        for part in np.linspace(0, 1, steps):
            open_ = ~blocked[rays]
            rays, first, last = rays[open_], first[open_], last[open_]
            at = (first + part * (last - first))[:, np.newaxis]
            place = here[rays] + at * (there[rays] - here[rays])
            height = self.shape.height_mm(place[:, 0], place[:, 1])
            blocked[rays] = place[:, 2] < height - SELF_MM
        return blocked

    def normals(self, places: Floats) -> Floats:
        """(N, 3) unit normals of eq. (4), upwards, world frame.

        Parameters
        ----------
        places : (N, 3) array, mm, of the surface, world frame
        """
        x, y, _ = self.pose.invert(places).T
        return self.shape.normals(x, y) @ self.pose.rotation.T

    def _reach(self, sheet: Pose) -> Floats:
        """Samples of the sheet's x that hold the whole square."""
        side, top = self.shape.side_mm, self._amplitude()
        box = np.array([(x, y, z) for x in (0, side) for y in (0, side) for z in (-top, top)])
        x = sheet.invert(self.pose.apply(box))[:, 0]
        return np.linspace(x.min(), x.max(), int(np.ceil(np.ptp(x) / SAMPLE_MM)) + 1)

    def _amplitude(self) -> float:
        return self.shape.a_mm + self.shape.b * self.shape.side_mm

    def _check_mild(self, up: Floats) -> None:
        """Refuse a tilt for which a line up the sheet could meet the surface twice.

        up: (N, 3) tangents of such lines.
        """
        s, highest = self.shape, self._amplitude()
        steepest_y = s.b + highest * abs(s.d_rad * s.e_per_mm)
        lean = highest * s.c_per_mm * np.abs(up[:, 0]) + steepest_y * np.abs(up[:, 1])
        if np.any((up[:, 2] <= 0) | (lean >= up[:, 2] / 2)):
            upright = (up[:, 2] / np.linalg.norm(up, axis=1)).min()
            raise InputError(
                "target: the sandwave is tilted too far against the sheet for its slopes",
                value=f"{np.degrees(np.arccos(np.clip(upright, -1, 1))):.1f} degrees",
                allowed="tilt times slope below one half",
            )

    def _faces_away(self, here: Floats, there: Floats) -> Mask:
        """(N,) whether ``there`` is a point of the surface seen from its underside."""
        x, y, z = there.T
        over = np.all((there[:, :2] >= 0) & (there[:, :2] <= self.shape.side_mm), axis=1)
        on = over & (np.abs(z - self.shape.height_mm(x, y)) < SELF_MM)
        return on & (np.einsum("ij,ij->i", self.shape.normals(x, y), here - there) <= 0)


def sandwave_surfaces(shape: Sandwave, pose: Pose) -> list[TankSurface]:
    """The block's surfaces: wave, rim, sides and underside, the wave's walls, the wedges."""
    outer = square(-shape.rim_mm, shape.side_mm + shape.rim_mm)
    inner = square(0.0, shape.side_mm)
    rim = np.vstack([outer, outer[:1], inner, inner[:1]])  # a slit joins hole and outline
    underside, _, *sides = extrusion(outer - [0, 0, shape.body_mm], np.array([0, 0, shape.body_mm]))
    wedges = [
        face
        for plan in shape.wedge_plans_mm()
        for face in extrusion(
            np.column_stack([plan, np.zeros(3)]), np.array([0, 0, shape.wedge.height_mm])
        )
    ]
    faces = [rim, underside, *sides, *wedges]
    return [
        Wave(shape, pose),
        *(Polygon(pose.apply(face)) for face in faces),
        *(Polygon(pose.apply(wall), opaque=False) for wall in walls(shape)),
    ]


def square(low: float, high: float) -> Floats:
    """(4, 3) corners of a level square at z = 0, counter-clockwise."""
    return np.array([[low, low, 0], [high, low, 0], [high, high, 0], [low, high, 0.0]])


def walls(shape: Sandwave) -> list[Floats]:
    """The four vertical faces between the wave's border and the rim, each (K, 3) corners.

    Wave.blocks already stops lines of sight at them: it samples where they enter and leave
    the square.
    """
    corners = square(0.0, shape.side_mm)
    part = np.linspace(0, 1, int(np.ceil(shape.side_mm / SAMPLE_MM)) + 1)[:, np.newaxis]
    found = []
    for here, there in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        foot = here + part * (there - here)
        border = foot + 0.0
        border[:, 2] = shape.height_mm(foot[:, 0], foot[:, 1])
        found.append(np.vstack([here, border, there]))
    return found
