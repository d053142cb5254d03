"""How rays and projections change with the camera and with the poses of the boards.

All follows from the derivatives of a pixel's ray, which have a closed form.  A point X is seen at
a pixel p whose ray runs from o along d and reaches it after a distance s: X = o(p) + s d(p).  Its
differential,

    dX = (o_p + s d_p) dp + d ds + (o_c + s d_c) dc,

gives dp where the point is given, by its own change dX and that of the camera, dc.  The boards'
rotations alone are derived by central differences.
"""

from dataclasses import dataclass

import numpy as np

from lscan.camera.boards import FACING, MM_PER_PX, POSE, SEEN, TURN, PosedBoards, rotation, towards
from lscan.camera.lens import undistort, undistort_derivatives
from lscan.camera.model import CameraModel
from lscan.camera.parameters import COUNT, LENS, WATER
from lscan.camera.port import leave_port_derivatives
from lscan.camera.projection import project, rays, rays_of
from lscan.records import Floats, Ints

PIXEL = [COUNT, COUNT + 1]  # columns of a ray's derivatives by its own pixel
OWN = COUNT + len(POSE)  # parameters that a mark depends on: the camera's, its own board's

TURN_STEP = 1e-5  # rad, of central differences: far above rounding, far below any curvature


@dataclass(frozen=True)
class RayDerivatives:
    """Derivatives of N rays by the camera and by the pixels they belong to.

    Attributes
    ----------
    origin_mm : (N, 3, 16) array, mm per unit of the parameters of CAMERA, then of u and v
    direction : (N, 3, 16) array, by the same
    """

    origin_mm: Floats
    direction: Floats

    def after(self, distance_mm: Floats) -> Floats:
        """(N, 3, 16) derivatives of the points that the rays reach after given distances.

        Parameters
        ----------
        distance_mm : (N,) array, mm, from where each ray enters the water
        """
        return self.origin_mm + distance_mm[:, None, None] * self.direction


def ray_derivatives(camera: CameraModel, image_px: Floats) -> RayDerivatives:
    """Derivatives of the rays in the water on which a camera sees pixels; NaN where it has none.

    Parameters
    ----------
    camera : CameraModel, in air or behind a port
    image_px : (N, 2) array, px, of (u, v)
    """
    distorted = (image_px - np.array(camera.centre_px)) / camera.focal_px
    return _derived(camera, distorted, undistort(camera, distorted))


def _derived(camera: CameraModel, distorted: Floats, tangents: Floats) -> RayDerivatives:
    """``ray_derivatives`` of pixels whose tangents, distorted and not, are known."""
    by_distorted, by_coefficients = undistort_derivatives(camera, tangents)
    by_lens = np.zeros((len(tangents), 2, COUNT + 2))
    by_lens[:, :, 0] = (by_distorted @ -distorted[:, :, None])[:, :, 0] / camera.focal_px
    by_lens[:, :, 1:3] = -by_distorted / camera.focal_px
    by_lens[:, :, 3 : len(LENS)] = by_coefficients
    by_lens[:, :, PIXEL] = by_distorted / camera.focal_px
    ahead = np.column_stack([tangents, np.ones(len(tangents))])
    length = np.linalg.norm(ahead, axis=1)[:, None]
    air = ahead / length
    by_tangents = (np.eye(3)[:, :2] - air[:, :, None] * air[:, None, :2]) / length[:, None]
    if camera.port is None:
        direction = by_tangents @ by_lens
        return RayDerivatives(np.zeros_like(direction), direction)
    parts = []
    for by_ray in leave_port_derivatives(camera.port, air, by_tangents):
        parts.append(by_ray[:, :, :2] @ by_lens)
        parts[-1][:, :, len(LENS) : COUNT] = by_ray[:, :, 2:]
    return RayDerivatives(*parts)


def frame_derivatives(boards: PosedBoards) -> tuple[Floats, Floats]:
    """Derivatives of the boards' axes and places by the camera and by each board's own pose.

    Parameters
    ----------
    boards : PosedBoards, V of them

    Returns
    -------
    tuple of array
        (V, 3, 3, 20) of PosedBoards.axes, (V, 3, 20) of places_mm.
    """
    seen, sight = boards.poses[:, SEEN], boards.lines_of_sight
    by_ray = ray_derivatives(boards.camera, seen)
    of_pose = np.arange(COUNT, OWN)
    columns = [*range(COUNT), *of_pose[SEEN]]
    distance = boards.poses[:, MM_PER_PX] * boards.apparent_focal_px
    places = np.zeros((len(seen), 3, OWN))
    places[:, :, columns] = by_ray.after(distance)
    apart = sight.direction * distance[:, None]
    places[:, :, 0] += apart / boards.camera.focal_px
    if boards.camera.port is not None:
        places[:, :, WATER] += apart / boards.camera.port.water_index
    places[:, :, of_pose[MM_PER_PX]] = sight.direction * boards.apparent_focal_px

    turn, direction = boards.poses[:, None, TURN], sight.direction[:, None, :]
    steps = TURN_STEP * np.array([np.eye(3), -np.eye(3)])[:, None]  # (2, 1, 3, 3)
    turned, faced = rotation(turn), towards(sight.direction)[:, None]
    by_direction, by_turn = (
        (after - before) / (2 * TURN_STEP)
        for after, before in (
            towards((direction + steps).reshape(-1, 3)).reshape(2, -1, 3, 3, 3) @ turned @ FACING,
            faced @ rotation(turn + steps) @ FACING,
        )
    )
    axes = np.zeros((len(seen), 3, 3, OWN))
    axes[..., columns] = np.einsum("vkij,vkc->vijc", by_direction, by_ray.direction)
    axes[..., of_pose[TURN]] = np.moveaxis(by_turn, 1, 3)
    return axes, places


def image_derivatives(boards: PosedBoards, board_mm: Floats, board: Ints) -> Floats:
    """(N, 2, 20) derivatives of the pixels at which points of the boards are seen.

    By the camera and by the pose of each point's own board; NaN where there is no image.

    Parameters
    ----------
    boards : PosedBoards, V of them
    board_mm : (N, 2) array, mm, (x, z) on the board
    board : (N,) array, number of each point's board
    """
    axes, places = frame_derivatives(boards)
    x, z = (board_mm - boards.centre_mm).T[:, :, None, None]
    moved = (x * axes[:, :, 0][board] + z * axes[:, :, 2][board]) + places[board]
    camera, points = boards.camera, boards.in_camera(board_mm, board)
    distorted = (project(camera, points) - np.array(camera.centre_px)) / camera.focal_px
    tangents = undistort(camera, distorted)
    seen = rays_of(camera, tangents)
    distance = np.linalg.norm(points - seen.origin_mm, axis=1)
    by_ray = _derived(camera, distorted, tangents).after(distance)
    moved[:, :, :COUNT] -= by_ray[:, :, :COUNT]
    found = np.full((len(points), 2, OWN), np.nan)
    good = np.isfinite(by_ray).all(axis=(1, 2))
    spanned = np.concatenate([by_ray[:, :, PIXEL], seen.direction[:, :, None]], axis=2)
    found[good] = np.linalg.solve(spanned[good], moved[good])[:, :2]
    return found


def on_board_derivatives(boards: PosedBoards, image_px: Floats, board: int) -> Floats:
    """(K, 3, 20) derivatives of PosedBoards.on_board, by the camera and by the board's pose.

    Parameters
    ----------
    boards : PosedBoards, V of them
    image_px : (K, 2) array, px, of (u, v)
    board : int, number of the board
    """
    axes, places = (each[board] for each in frame_derivatives(boards))
    normal, by_normal = boards.axes[board][:, 1], axes[:, 1]
    points, seen = boards.on_board(image_px, board), rays(boards.camera, image_px)
    distance = np.linalg.norm(points - seen.origin_mm, axis=1)
    found = np.zeros((len(points), 3, OWN))
    found[:, :, :COUNT] = ray_derivatives(boards.camera, image_px).after(distance)[:, :, :COUNT]
    off = normal @ (places - found) - (points - boards.places_mm[board]) @ by_normal
    return found + seen.direction[:, :, None] * (off / (seen.direction @ normal)[:, None])[:, None]
