"""Frames of a scene and the rigid motions between them.

Frames: camera (x right, y down, z along the axis), sheet (x across the fan, y the sheet's
normal, z against the fan's axis), target, head, world (lscan.records).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lscan.records import Floats
from sim.scene.instrument import Head, Laser, Line


def rotation_z(angle_deg: float) -> Floats:
    """(3, 3) rotation about z, counter-clockwise seen from above."""
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


def rotation_x(angle_deg: float) -> Floats:
    """(3, 3) rotation about x, y towards z."""
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    return np.array([[1.0, 0, 0], [0, c, -s], [0, s, c]])


def rotation_y(angle_deg: float) -> Floats:
    """(3, 3) rotation about y, z towards x."""
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    return np.array([[c, 0, s], [0, 1.0, 0], [-s, 0, c]])


@dataclass(frozen=True)
class Pose:
    """A rigid motion: P_outer = rotation @ P_inner + origin_mm."""

    rotation: Floats
    origin_mm: Floats

    def apply(self, points: Floats) -> Floats:
        """(..., 3) points of the inner frame in the outer one, mm."""
        return points @ self.rotation.T + self.origin_mm

    def invert(self, points: Floats) -> Floats:
        """(..., 3) points of the outer frame in the inner one, mm."""
        return (points - self.origin_mm) @ self.rotation

    def __matmul__(self, inner: Pose) -> Pose:
        return Pose(self.rotation @ inner.rotation, self.apply(inner.origin_mm))


def camera_pose(head: Head) -> Pose:
    """Camera frame (x right, y down, z along the axis) to head frame."""
    level = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])  # looking along the head's y
    rotation = (
        rotation_z(head.heading_deg)
        @ level
        @ rotation_x(-head.depression_deg)
        @ rotation_z(head.roll_deg)
    )
    return Pose(rotation, np.array(head.camera_mm))


def head_pose(head: Head, position_mm: float) -> Pose:
    """Head frame to world frame with the head at a track position in mm."""
    return Pose(rotation_z(head.yaw_deg), np.array([0.0, position_mm, 0.0]))


def sheet_pose(laser: Laser, line: Line) -> Pose:
    """Sheet frame of one of the laser's lines to head frame; its origin is the apex."""
    turned = (
        rotation_z(laser.skew_deg)
        @ rotation_x(laser.tilt_deg + line.tilt_deg)
        @ rotation_y(-laser.aim_deg)
    )
    return Pose(turned, np.array(laser.apex_mm))


def track_direction(head: Head) -> Floats:
    """(3,) unit vector along which the track moves the head, world frame."""
    return np.array([0.0, 1.0, 0.0])
