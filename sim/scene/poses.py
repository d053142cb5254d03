"""Frames of a scene and the rigid motions between them.

Frames: camera (x right, y down, z along the axis), sheet (x across the fan, y the sheet's
normal, z against the fan's axis), target, head, world (lscan.records).
"""

from dataclasses import dataclass

import numpy as np

from lscan.records import Floats
from sim.scene.instrument import Head, Laser, LaserLine, TrueShaft


def rotation_z(angle_deg: float) -> Floats:
    """(3, 3) rotation about z, counter-clockwise seen from above.

    Parameters
    ----------
    angle_deg : float, degrees
    """
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


def rotation_x(angle_deg: float) -> Floats:
    """(3, 3) rotation about x, y towards z.

    Parameters
    ----------
    angle_deg : float, degrees
    """
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    return np.array([[1.0, 0, 0], [0, c, -s], [0, s, c]])


def rotation_y(angle_deg: float) -> Floats:
    """(3, 3) rotation about y, z towards x.

    Parameters
    ----------
    angle_deg : float, degrees
    """
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    return np.array([[c, 0, s], [0, 1.0, 0], [-s, 0, c]])


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
    level = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])  # looking along the head's y
    rotation = (
        rotation_z(head.heading_deg)
        @ level
        @ rotation_x(-head.depression_deg)
        @ rotation_z(head.roll_deg)
    )
    return Pose(rotation, np.array(head.camera_mm))


def head_pose(head: Head, position_mm: float) -> Pose:
    """Head frame to world frame.

    Parameters
    ----------
    head : Head, its yaw, and the shaft it turns about, if any
    position_mm : float, mm along the track, or along the arc about the shaft
    """
    level = rotation_z(head.yaw_deg)
    if head.shaft is None:
        return Pose(level, position_mm * track_direction(head))
    point = np.array(head.shaft.point_mm)
    turn = _about(head.shaft, np.array([position_mm]))[0]
    return Pose(level, np.zeros(3)) @ Pose(turn, point - turn @ point)


def into_world(head: Head, points_head: Floats, position_mm: Floats | float) -> Floats:
    """Points of the head frame in the world; (N, 3), mm.

    Parameters
    ----------
    head : Head, its yaw, and the shaft it turns about, if any
    points_head : (N, 3) array, mm, head frame
    position_mm : array or float, mm along the track or arc; one for all points, or (N,)
    """
    position = np.broadcast_to(position_mm, len(points_head))
    if head.shaft is None:
        return head_pose(head, 0.0).apply(points_head) + np.outer(position, track_direction(head))
    offset = points_head - np.array(head.shaft.point_mm)
    turned = np.einsum("nij,nj->ni", _about(head.shaft, position), offset)
    return head_pose(head, 0.0).apply(turned + np.array(head.shaft.point_mm))


def into_head(head: Head, points_world: Floats, position_mm: Floats | float) -> Floats:
    """Points of the world in the head frame; (N, 3), mm.

    Parameters
    ----------
    head : Head, its yaw, and the shaft it turns about, if any
    points_world : (N, 3) array, mm, world frame
    position_mm : array or float, mm along the track or arc; one for all points, or (N,)
    """
    position = np.broadcast_to(position_mm, len(points_world))
    if head.shaft is None:
        moved = np.outer(position, track_direction(head))
        return head_pose(head, 0.0).invert(points_world - moved)
    offset = head_pose(head, 0.0).invert(points_world) - np.array(head.shaft.point_mm)
    turned = np.einsum("nji,nj->ni", _about(head.shaft, position), offset)
    return turned + np.array(head.shaft.point_mm)


def _about(shaft: TrueShaft, position_mm: Floats) -> Floats:
    """(N, 3, 3) rotations of the head at positions (N,) on its shaft: from quaternions."""
    assert shaft.arc_radius_mm is not None  # sim.scene.file has set it
    half = position_mm / shaft.arc_radius_mm / 2
    direction = np.array(shaft.direction) / np.linalg.norm(shaft.direction)
    w, (x, y, z) = np.cos(half), np.sin(half) * direction[:, np.newaxis]
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


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
    turned = (
        rotation_z(laser.skew_deg)
        @ rotation_x(laser.tilt_deg + line.tilt_deg)
        @ rotation_y(-laser.aim_deg)
    )
    return Pose(turned, np.array(laser.apex_mm))


def track_direction(head: Head) -> Floats:
    """(3,) unit vector along which a track moves the head, world frame.

    Parameters
    ----------
    head : Head, any; the track is the world's y axis
    """
    return np.array([0.0, 1.0, 0.0])
