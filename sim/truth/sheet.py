"""Where a laser sheet truly lies.

A sheet has a plane of its own, its frame turned out of the head's by the laser's skew and
tilt: the apex has the same x and z in both, and a sheet without tilt, skew and offset lies
in the head's y = 0, where the two frames are one.  Points of the sheet are given by their
(x, z) in that plane; a bowed sheet lies off it in y.  The fan's rays are straight in
(x, z) whether the sheet is bowed or not: a cone's rays all pass through its apex.
"""

from dataclasses import dataclass

import numpy as np

from lscan.errors import InputError
from lscan.records import Floats, Ints
from sim.scene import Laser, LaserLine, Pose, Scene, rotation
from sim.water import water_index

# The bow of a sheet that leaves the laser through a tilted window, and how triangles are cut.
#
# In the air the fan's rays lie in a plane, with e1 across, e2 the plane's normal, e3 the fan's
# axis; the window's normal is N = cos(a) e3 + sin(a) e2, a the window's tilt.  In the water a
# ray at the angle f has the components sin(f)/n along e1, -cos(f) sin(b) along
# T = cos(a) e2 - sin(a) e3, where sin(b) = sin(a)/n (Snell), and the rest of its unit length
# along N.  With the angle f eliminated, all rays lie on a cone of the second degree,
#
#     (n2 - 1) r1^2 + cot(b)^2 rT^2 = rN^2,
#
# which in the sheet's own frame (X across, D along the refracted middle ray, Y normal to both)
# reads  Y^2 cos(2b) - D Y sin(2b) + (n2 - 1) X^2 sin(b)^2 = 0.


# Rays leave the window up to the limiting angle only; the bow is steep just before it.
GRAZING = 0.999
# Triangles are cut as if the bow were straight across one: it is off by its curvature times
# this squared over 8.  The curvature is (n2 - 1) tan(b) / distance: 4e-4 per mm for a window
# at 20 degrees and half a metre, hence 5e-5 mm.
FACET_MM = 1.0
STEEPEST = 1.5  # more than the distance to the sheet changes per mm


@dataclass(frozen=True)
class Bow:
    """How far a bowed sheet lies off its plane; frame of the plane as sim.truth.sheet.

    apex_mm: (x, z).  aim_rad: of the fan's axis.  leaning_rad: b, the angle in the water of
    the middle ray to the window's normal.  index: the water's.
    """

    apex_mm: tuple[float, float]
    aim_rad: float
    leaning_rad: float
    index: float

    def offset_mm(self, x: Floats, z: Floats) -> Floats:
        """(...,) y of the sheet at x and z, mm; 0 behind the laser."""
        across, ahead = self._within(x, z)
        b, k = self.leaning_rad, self.index**2 - 1
        share = across / ahead  # squares of tiny numbers would vanish
        root = ahead * np.sqrt(np.cos(b) ** 2 - np.cos(2 * b) * k * share**2)
        return k * across**2 * np.sin(b) / (ahead * np.cos(b) + root)

    def clearance_mm(self, points: Floats) -> Floats:
        """(...,) y of (..., 3) points above the sheet, mm."""
        return points[..., 1] - self.offset_mm(points[..., 0], points[..., 2])

    @property
    def widest(self) -> float:
        """Tangent of the fan's angle in the water beyond which no ray leaves the window."""
        return GRAZING / (np.sqrt(self.index**2 - 1) * np.cos(self.leaning_rad))

    def _within(self, x: Floats, z: Floats) -> tuple[Floats, Floats]:
        """Distances across and ahead of the apex; across is cut off at ``widest``."""
        c, s = np.cos(self.aim_rad), np.sin(self.aim_rad)
        right, up = x - self.apex_mm[0], z - self.apex_mm[1]
        ahead = np.maximum(right * s - up * c, np.finfo(float).tiny)
        reach = self.widest * ahead
        return np.clip(right * c + up * s, -reach, reach), ahead


def bow_of(laser: Laser, water_index: float) -> Bow | None:
    """The bow of the laser's sheets, None where its window is square to the fan.

    Raises InputError where the fan is wider than light can leave a flat window.
    """
    if laser.port_tilt_deg == 0:
        return None
    leaning = float(np.arcsin(np.sin(np.radians(laser.port_tilt_deg)) / water_index))
    apex = (laser.apex_mm[0], laser.apex_mm[2])
    bow = Bow(apex, float(np.radians(laser.aim_deg)), leaning, water_index)
    widest_deg = float(np.degrees(np.arctan(bow.widest)))
    if laser.fan_half_angle_deg > widest_deg:
        what = "laser.fan_half_angle_deg: no such ray leaves the tilted window"
        allowed = f"up to {widest_deg:.1f} degrees in the water"
        raise InputError(what, value=laser.fan_half_angle_deg, allowed=allowed)
    return bow


def bowed_pieces(vertices: Floats, faces: Ints, bow: Bow) -> Floats:
    """(M, 2, 3) pieces of the section of triangles by a bowed sheet; frame of its plane, mm.

    vertices: (V, 3); faces: (T, 3).  Triangles near the sheet are quartered until their
    edges are short, then cut as flat ones.
    """
    away = bow.clearance_mm(vertices)[faces]
    corners = vertices[faces[_near(vertices[faces], away)]] if len(faces) else np.empty((0, 3, 3))
    small = []
    while len(corners):
        short = _longest(corners) <= FACET_MM
        small.append(corners[short])
        corners = quarter(corners[~short])
        corners = corners[_near(corners, bow.clearance_mm(corners))]
    return _section_pieces(np.concatenate([np.empty((0, 3, 3)), *small]), bow)


def quarter(corners: Floats) -> Floats:
    """(4 T, 3, 3) the triangles (T, 3, 3) cut at the middles of their edges."""
    a, b, c = np.moveaxis(corners, 1, 0)
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return np.concatenate([np.stack(part, axis=1) for part in parts])


def _near(corners: Floats, away: Floats) -> np.ndarray:
    """(T,) whether triangles may touch the sheet, their corners ``away`` mm above it."""
    return np.abs(away).min(axis=1) <= STEEPEST * _longest(corners)


def _longest(corners: Floats) -> Floats:
    return np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2).max(axis=1)


def _section_pieces(corners: Floats, bow: Bow) -> Floats:
    """(M, 2, 3) where triangles with corners on both sides of the sheet cross it."""
    away = bow.clearance_mm(corners)
    following, beyond = np.roll(corners, -1, axis=1), np.roll(away, -1, axis=1)
    crosses = (away < 0) != (beyond < 0)  # two edges of a triangle or none
    part = away[crosses] / (away[crosses] - beyond[crosses])
    points = corners[crosses] + part[:, np.newaxis] * (following[crosses] - corners[crosses])
    return points.reshape(-1, 2, 3)


# Where a laser sheet truly lies.


@dataclass(frozen=True)
class TrueSheet:
    """One of the laser's sheets.  pose: frame of its plane to head frame.  bow: None if flat."""

    pose: Pose
    bow: Bow | None

    def in_head(self, xz_mm: Floats) -> Floats:
        """(N, 3) points of the sheet, mm, head frame.

        Parameters
        ----------
        xz_mm : (N, 2) array, mm, frame of the sheet's plane
        """
        x, z = xz_mm.T
        y = np.zeros(len(xz_mm)) if self.bow is None else self.bow.offset_mm(x, z)
        return self.pose.apply(np.column_stack([x, y, z]))

    def flatten(self, points_head: Floats) -> Floats:
        """(N, 2) points of the sheet beneath or above points, mm, frame of its plane.

        Parameters
        ----------
        points_head : (N, 3) array, mm, head frame
        """
        return self.pose.invert(points_head)[:, [0, 2]]

    def clearance_mm(self, points_head: Floats) -> Floats:
        """(N,) mm, how far points lie off the sheet, in y of its plane.

        Parameters
        ----------
        points_head : (N, 3) array, mm, head frame
        """
        local = self.pose.invert(points_head)
        return local[:, 1] if self.bow is None else self.bow.clearance_mm(local)


def sheet_of(scene: Scene, line: int = 0) -> TrueSheet:
    """The sheet of one of the laser's lines, head frame.

    Parameters
    ----------
    scene : Scene, its laser and its water
    line : int, index into ``laser.sheets``

    Raises
    ------
    InputError
        There is no such line.

    References
    ----------
    docs/explanation/physics.md, section 4.
    """
    laser = scene.tank.laser
    if not 0 <= line < len(laser.sheets):
        allowed = f"0 to {len(laser.sheets) - 1}"
        raise InputError("line of the laser", where=scene.source, value=line, allowed=allowed)
    index = water_index(scene.tank.water, laser.wavelength_nm)
    return TrueSheet(sheet_plane(laser, laser.sheets[line]), bow_of(laser, index))


def sheet_plane(laser: Laser, line: LaserLine) -> Pose:
    """Frame of the sheet's plane to head frame.

    Parameters
    ----------
    laser : Laser, its apex and angles
    line : LaserLine, one of ``laser.sheets``
    """
    turned = rotation("ZX", (laser.skew_deg, laser.tilt_deg + line.tilt_deg))
    apex = np.array(laser.apex_mm)
    return Pose(turned, apex - turned @ (apex * [1.0, 0.0, 1.0]))
