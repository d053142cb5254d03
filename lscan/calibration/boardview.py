"""A camera and the board in front of it, as one vector of parameters."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, get_args

import cv2
import numpy as np

from lscan.camera import Camera, FlatPort, Rays, project, rays
from lscan.records import Floats

LensName = Literal["focal_px", "centre_u_px", "centre_v_px", "k1", "k2", "p1", "p2"]
PortName = Literal[
    "gap_mm", "thickness_mm", "glass_index", "water_index", "tilt_x_deg", "tilt_y_deg"
]
PoseName = Literal["turn_x", "turn_y", "turn_z", "seen_u_px", "seen_v_px", "mm_per_px"]
LENS: tuple[str, ...] = get_args(LensName)
PORT: tuple[str, ...] = get_args(PortName)
POSE: tuple[str, ...] = get_args(PoseName)
NAMES = LENS + PORT + POSE
COUNT = len(NAMES)

# Board axes (x right, y away, z up) of a board that squarely faces the camera, in its frame.
FACING = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


@dataclass(frozen=True)
class BoardView:
    """Where a camera stands before the board, and how it sees.

    theta: (19,) in the order of NAMES: lens and port as in lscan.camera, then the pose.
        ``turn`` is the rotation vector (radians) by which the board is turned from facing the
        ray on which ``centre_mm`` is seen; ``seen`` the pixel where it is seen; mm_per_px
        how far on it lies along that ray, over the apparent focal length.  These change
        little when the lens does and the picture does not, which keeps least squares quick.
    centre_mm: (2,) the point (x, z) of the board about which it is turned.
    port: "none" for a camera in air, whose port parameters mean nothing.
    """

    theta: Floats
    centre_mm: Floats
    port: Literal["flat", "none"] = "flat"

    @cached_property
    def camera(self) -> Camera:
        """The camera alone."""
        focal, u, v, k1, k2, p1, p2 = self.theta[: len(LENS)].tolist()
        window = None
        if self.port == "flat":
            window = FlatPort(*self.theta[len(LENS) : len(LENS) + len(PORT)].tolist())
        return Camera(focal, (u, v), k1, k2, p1, p2, port=window)

    @cached_property
    def apparent_focal_px(self) -> float:
        """Focal length of the pinhole that sees the water like this camera near its axis."""
        port = self.camera.port
        return self.camera.focal_px * (port.water_index if port else 1.0)

    @cached_property
    def line_of_sight(self) -> Rays:
        """The one ray on which ``centre_mm`` is seen, camera frame."""
        return rays(self.camera, self.theta[None, -3:-1])

    @cached_property
    def axes(self) -> Floats:
        """(3, 3) the board's axes x, y, z as columns, camera frame."""
        return towards(self.line_of_sight.direction[0]) @ rotation(self.theta[-6:-3]) @ FACING

    @cached_property
    def place_mm(self) -> Floats:
        """(3,) where ``centre_mm`` is, camera frame."""
        sight, distance = self.line_of_sight, self.theta[-1] * self.apparent_focal_px
        return sight.origin_mm[0] + distance * sight.direction[0]

    def project(self, board_mm: Floats) -> Floats:
        """(N, 2) px of board points (N, 2) of (x, z) mm; NaN where there is no image."""
        return project(self.camera, self.in_camera(board_mm))

    def in_camera(self, board_mm: Floats) -> Floats:
        """(N, 3) mm, camera frame, of board points (N, 2) of (x, z) mm."""
        return (board_mm - self.centre_mm) @ self.axes[:, [0, 2]].T + self.place_mm

    def sight(self, image_px: Floats) -> Rays:
        """The rays in the water of pixels (N, 2), in the board's frame (x, y, z), mm."""
        seen = rays(self.camera, image_px)
        centre = np.array([self.centre_mm[0], 0.0, self.centre_mm[1]])
        origin = (seen.origin_mm - self.place_mm) @ self.axes + centre
        return Rays(origin, seen.direction @ self.axes)

    def locate(self, image_px: Floats) -> Floats:
        """(N, 2) of (x, z) mm where the rays of pixels (N, 2) meet the board's plane y = 0.

        NaN where a pixel has no ray or its ray does not go towards the plane.
        """
        seen = self.sight(image_px)
        towards = -seen.origin_mm[:, 1] * seen.direction[:, 1] > 0
        along = np.where(towards, seen.direction[:, 1], np.nan)
        hit = seen.origin_mm - seen.direction * (seen.origin_mm[:, 1] / along)[:, None]
        return hit[:, [0, 2]]


def towards(direction: Floats) -> Floats:
    """(3, 3) the smallest rotation that takes the camera's axis to a unit direction (3,)."""
    across = np.array([-direction[1], direction[0], 0.0])
    sine = np.linalg.norm(across)
    angle = np.arctan2(sine, direction[2])
    return rotation(across * (angle / sine if sine > 0 else 1.0))


def rotation(vector: Floats) -> Floats:
    """(3, 3) rotation about a vector (3,) by its length in radians (Rodrigues)."""
    return np.asarray(cv2.Rodrigues(vector)[0], dtype=np.float64)
