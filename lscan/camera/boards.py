"""A camera and the boards in front of it, as one vector of parameters."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from lscan.camera.model import CameraModel
from lscan.camera.parameters import COUNT, WATER, PortKind, camera_of
from lscan.camera.projection import Rays, meet_plane, project, rays
from lscan.records import Floats, Ints

POSE = ("turn_x", "turn_y", "turn_z", "seen_u_px", "seen_v_px", "mm_per_px")
TURN, SEEN, MM_PER_PX = slice(0, 3), slice(3, 5), 5  # in the order of POSE

# Board axes (x right, y away, z up) of a board that squarely faces the camera, in its frame.
FACING = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


@dataclass(frozen=True)
class PosedBoards:
    """A camera and V boards before it.

    The frame of a board is x right, y away from the camera, z up; its marks lie in y = 0.

    Attributes
    ----------
    theta : (14 + 6 V,) array, the camera in the order of parameters.CAMERA, then each board's pose
        in that of POSE.  ``turn`` is the rotation vector (rad) by which the board is turned from
        facing the ray on which ``centre_mm`` is seen; ``seen`` the pixel where it is seen;
        mm_per_px how far on it lies along that ray, over the apparent focal length.  These change
        little when the lens does and the picture does not, which keeps least squares quick.
    centre_mm : (2,) array, mm, the point (x, z) of each board about which it is turned
    port : str, "flat", or "none" for a camera in air, whose port parameters mean nothing
    """

    theta: Floats
    centre_mm: Floats
    port: PortKind = "flat"

    @cached_property
    def camera(self) -> CameraModel:
        """The camera alone."""
        return camera_of(self.theta, self.port)

    @property
    def poses(self) -> Floats:
        """(V, 6) in the order of POSE."""
        return self.theta[COUNT:].reshape(-1, len(POSE))

    @cached_property
    def apparent_focal_px(self) -> float:
        """Focal length of the pinhole that sees the water like this camera near its axis."""
        port = self.camera.port
        return self.camera.focal_px * (port.water_index if port else 1.0)

    @cached_property
    def lines_of_sight(self) -> Rays:
        """The V rays on which ``centre_mm`` is seen, camera frame."""
        return rays(self.camera, self.poses[:, SEEN])

    @cached_property
    def axes(self) -> Floats:
        """(V, 3, 3) the boards' axes x, y, z as columns, camera frame."""
        turned: Floats = towards(self.lines_of_sight.direction) @ rotation(self.poses[:, TURN])
        return turned @ FACING

    @cached_property
    def places_mm(self) -> Floats:
        """(V, 3) where ``centre_mm`` of each board is, camera frame."""
        sight, distance = (
            self.lines_of_sight,
            self.poses[:, MM_PER_PX, None] * self.apparent_focal_px,
        )
        return sight.origin_mm + distance * sight.direction

    def in_water(self, index: float) -> "PosedBoards":
        """The same camera and boards, where they are in space, in water of another index.

        Parameters
        ----------
        index : float, of the water, relative to air
        """
        theta = self.theta.copy()
        theta[WATER] = index
        other = replace(self, theta=theta)
        seen = project(other.camera, self.places_mm)
        sight = rays(other.camera, seen)
        distance = np.linalg.norm(self.places_mm - sight.origin_mm, axis=1)
        turned = np.swapaxes(towards(sight.direction), 1, 2) @ self.axes @ FACING.T
        turn = Rotation.from_matrix(turned).as_rotvec()
        poses = np.column_stack([turn, seen, distance / other.apparent_focal_px])
        theta[COUNT:] = poses.ravel()
        return replace(self, theta=theta)

    def in_camera(self, board_mm: Floats, board: Ints | int = 0) -> Floats:
        """(N, 3) mm, points of the boards in the camera frame.

        Parameters
        ----------
        board_mm : (N, 2) array, mm, (x, z) on the board
        board : (N,) array or int, number of each point's board
        """
        of_each = np.broadcast_to(board, len(board_mm))
        across, up = self.axes[:, :, 0][of_each], self.axes[:, :, 2][of_each]
        x, z = (board_mm - self.centre_mm).T
        return x[:, None] * across + z[:, None] * up + self.places_mm[of_each]

    def project(self, board_mm: Floats, board: Ints | int = 0) -> Floats:
        """(N, 2) px, (u, v) at which points of the boards are seen; NaN where there is no image.

        Parameters
        ----------
        board_mm : (N, 2) array, mm, (x, z) on the board
        board : (N,) array or int, number of each point's board
        """
        return project(self.camera, self.in_camera(board_mm, board))

    def on_board(self, image_px: Floats, board: int = 0) -> Floats:
        """(K, 3) mm, camera frame, where the rays of pixels meet a board; NaN if they do not.

        Parameters
        ----------
        image_px : (K, 2) array, px, of (u, v)
        board : int, number of the board
        """
        normal, place = self.axes[board][:, 1], self.places_mm[board]
        return meet_plane(rays(self.camera, image_px), normal, place)

    def locate(self, image_px: Floats, board: int = 0) -> Floats:
        """(K, 2) mm, (x, z) on a board where the rays of pixels meet it; NaN if they do not.

        Parameters
        ----------
        image_px : (K, 2) array, px, of (u, v)
        board : int, number of the board
        """
        beside = self.on_board(image_px, board) - self.places_mm[board]
        return beside @ self.axes[board][:, [0, 2]] + self.centre_mm


def towards(direction: Floats) -> Floats:
    """(V, 3, 3) the smallest rotations that take the camera's axis to directions.

    Parameters
    ----------
    direction : (V, 3) array, unit vectors, camera frame
    """
    across = np.column_stack([-direction[:, 1], direction[:, 0], np.zeros(len(direction))])
    sine = np.linalg.norm(across, axis=1)
    angle = np.arctan2(sine, direction[:, 2])
    return rotation(across * (angle / np.where(sine > 0, sine, 1.0))[:, None])


def rotation(vector: Floats) -> Floats:
    """(..., 3, 3) rotation matrices of rotation vectors.

    Parameters
    ----------
    vector : (..., 3) array, rad, the axis times the angle

    Examples
    --------
    >>> rotation(np.array([0.0, 0.0, np.pi / 2])).round(6) @ np.array([1.0, 0.0, 0.0])
    array([0., 1., 0.])
    """
    x, y, z = vector[..., 0], vector[..., 1], vector[..., 2]
    cross = np.zeros((*vector.shape, 3))
    cross[..., 0, 1], cross[..., 0, 2], cross[..., 1, 2] = -z, y, -x
    cross[..., 1, 0], cross[..., 2, 0], cross[..., 2, 1] = z, -y, x
    half = np.sqrt(x * x + y * y + z * z)[..., None, None] / 2
    # sin(a) / a and (1 - cos(a)) / a^2, which are 1 and 1/2 at 0
    straight, square = np.sinc(2 * half / np.pi), np.sinc(half / np.pi) ** 2 / 2
    turns: Floats = np.eye(3) + straight * cross + square * (cross @ cross)
    return turns
