"""Frames of a scene and the rigid motions between them.

Frames: camera (x right, y down, z along the axis), sheet (x across the fan, y the sheet's
normal, z against the fan's axis), target, head, world (lscan.records).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from math import cos, radians, sin

import numpy as np
from scipy.spatial.transform import Rotation

from lscan.records import Floats
from sim.scene.instrument import Head, Laser, LaserLine, TrueShaft

TRACK = np.array([0.0, 1.0, 0.0])  # along which a track moves the head, world frame


def rotation(axes: str, angles_deg: float | Sequence[float] | Floats) -> Floats:
    """Rotation matrices about one axis or several, counter-clockwise; (3, 3), or (N, 3, 3).

    Parameters
    ----------
    axes : str, in the order in which their matrices are multiplied: "ZX" is Rz @ Rx
    angles_deg : float for one axis, else (K,) or (N, K) array, degrees

    Examples
    --------
    >>> rotation("Z", 90.0).round(12)[:, 0].tolist()
    [0.0, 1.0, 0.0]
    """
    if isinstance(angles_deg, np.ndarray) and angles_deg.ndim == 2:
        return Rotation.from_euler(axes, angles_deg, degrees=True).as_matrix()
    angles = (angles_deg,) if isinstance(angles_deg, float | int) else angles_deg
    turns = [_turn(axis, float(angle)) for axis, angle in zip(axes, angles, strict=True)]
    return reduce(np.matmul, turns)


def _turn(axis: str, angle_deg: float) -> Floats:
    """(3, 3) rotation matrix about one axis: a scene is posed thousands of times in a study."""
    c, s = cos(radians(angle_deg)), sin(radians(angle_deg))
    match axis:
        case "X":
            return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
        case "Y":
            return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Pose:
    """A rigid motion: P_outer = rotation @ P_inner + origin_mm.

    Attributes
    ----------
    rotation : (3, 3) array, inner to outer frame
    origin_mm : (3,) array, mm, the inner frame's origin in the outer frame
    """

    rotation: Floats
    origin_mm: Floats

    def apply(self, points: Floats) -> Floats:
        """Points of the inner frame in the outer one; same shape, mm.

        Parameters
        ----------
        points : (..., 3) array, mm, inner frame
        """
        return points @ self.rotation.T + self.origin_mm

    def invert(self, points: Floats) -> Floats:
        """Points of the outer frame in the inner one; same shape, mm.

        Parameters
        ----------
        points : (..., 3) array, mm, outer frame
        """
        return (points - self.origin_mm) @ self.rotation

    def __matmul__(self, inner: "Pose") -> "Pose":
        return Pose(self.rotation @ inner.rotation, self.apply(inner.origin_mm))


def camera_pose(head: Head) -> Pose:
    """Camera frame (x right, y down, z along the axis) to head frame.

    Parameters
    ----------
    head : Head, its camera's place and angles
    """
    angles = (head.heading_deg, -90 - head.depression_deg, head.roll_deg)
    return Pose(rotation("ZXZ", angles), np.array(head.camera_mm))


def head_pose(head: Head, position_mm: float) -> Pose:
    """Head frame to world frame.

    Parameters
    ----------
    head : Head, its yaw, how it is turned and shifted, and the shaft it turns about, if any
    position_mm : float, mm along the track, or along the arc about the shaft
    """
    pose = track_pose(head, position_mm) @ seat_pose(head)
    return Pose(pose.rotation, pose.origin_mm + head.shift_mm)


def seat_pose(head: Head) -> Pose:
    """How the head is turned in its place: head frame to that of a head that is not turned.

    Parameters
    ----------
    head : Head, its turn and the point it is turned about
    """
    turn, pivot = rotation("ZYX", head.turn_deg[::-1]), np.array(head.pivot_mm)
    return Pose(turn, pivot - turn @ pivot)


def track_pose(head: Head, position_mm: float) -> Pose:
    """Where the track ought to hold the head: its frame, neither turned nor shifted, to world.

    Parameters
    ----------
    head : Head, its yaw, and the shaft it turns about, if any
    position_mm : float, mm along the track, or along the arc about the shaft
    """
    level = rotation("Z", head.yaw_deg)
    if head.shaft is None:
        return Pose(level, position_mm * TRACK)
    point = np.array(head.shaft.point_mm)
    turn = _about(head.shaft, np.array([position_mm])).as_matrix()[0]
    return Pose(level, np.zeros(3)) @ Pose(turn, point - turn @ point)


def into_world(head: Head, points_head: Floats, position_mm: Floats | float) -> Floats:
    """Points of the head frame in the world; (N, 3), mm.

    Parameters
    ----------
    head : Head, its yaw, how it is turned and shifted, and the shaft it turns about, if any
    points_head : (N, 3) array, mm, head frame
    position_mm : array or float, mm along the track or arc; one for all points, or (N,)
    """
    position, level = np.broadcast_to(position_mm, len(points_head)), track_pose(head, 0.0)
    points, shift = seat_pose(head).apply(points_head), np.array(head.shift_mm)
    if head.shaft is None:
        return level.apply(points) + np.outer(position, TRACK) + shift
    point = np.array(head.shaft.point_mm)
    return level.apply(_about(head.shaft, position).apply(points - point) + point) + shift


def into_head(head: Head, points_world: Floats, position_mm: Floats | float) -> Floats:
    """Points of the world in the head frame; (N, 3), mm.

    Parameters
    ----------
    head : Head, its yaw, how it is turned and shifted, and the shaft it turns about, if any
    points_world : (N, 3) array, mm, world frame
    position_mm : array or float, mm along the track or arc; one for all points, or (N,)
    """
    position, level = np.broadcast_to(position_mm, len(points_world)), track_pose(head, 0.0)
    points, seat = points_world - head.shift_mm, seat_pose(head)
    if head.shaft is None:
        return seat.invert(level.invert(points - np.outer(position, TRACK)))
    point, turn = np.array(head.shaft.point_mm), _about(head.shaft, position)
    return seat.invert(point + turn.apply(level.invert(points) - point, inverse=True))


def _about(shaft: TrueShaft, position_mm: Floats) -> Rotation:
    """N rotations of the head at positions (N,) on its shaft."""
    assert shaft.arc_radius_mm is not None  # sim.scene.file has set it
    direction = np.array(shaft.direction) / np.linalg.norm(shaft.direction)
    return Rotation.from_rotvec(np.outer(position_mm / shaft.arc_radius_mm, direction))


def sheet_pose(laser: Laser, line: LaserLine) -> Pose:
    """Sheet frame of one of the laser's lines to head frame; its origin is the apex.

    Parameters
    ----------
    laser : Laser, its apex and angles
    line : LaserLine, one of ``laser.sheets``

    References
    ----------
    docs/explanation/physics.md, section 4.
    """
    angles = (laser.skew_deg, laser.tilt_deg + line.tilt_deg, -laser.aim_deg)
    return Pose(rotation("ZXY", angles), np.array(laser.apex_mm))
