"""The laser's plane from lines on boards: two numbers a view, and their covariance."""

from functools import partial

import numpy as np

from lscan.calibration.multiview.lines import across_mm, distance_mm
from lscan.calibration.multiview.views import LinePoints
from lscan.camera.posedboards import COUNT, POSE, on_board_derivatives
from lscan.camera.resection import CameraFit
from lscan.errors import MeasurementError
from lscan.records import Floats, Mask

MOST_STEPS = 20  # of Gauss and Newton; the plane's equation is nearly linear
SETTLED = 1e-12  # relative change of the plane: float64's rounding


class PlaneEquations:
    """The two numbers of each of V views, as they depend on the plane, camera and poses.

    Parameters
    ----------
    fit : CameraFit, camera and poses
    free : (14,) mask, of the camera's parameters that were found
    lines : dict of LinePoints, px, by number of the board
    """

    def __init__(self, fit: CameraFit, free: Mask, lines: dict[int, LinePoints]) -> None:
        self._root, self._lines = fit.root, lines
        # The errors, of those that the root's columns stand for, that move the camera: (P, C).
        self._of_camera: Floats = np.linalg.qr(self._root[np.flatnonzero(free)].T)[0]
        # The root of the covariance of camera and poses, less all that moves the camera.
        self._poses_root = self._root - self._root @ self._of_camera @ self._of_camera.T
        self._points, self._across, self._by_own = {}, {}, {}
        for board, line in lines.items():
            boards = fit.boards
            self._points[board] = boards.on_board(line.image_px, board)
            self._across[board] = across_mm(partial(boards.on_board, board=board), line)
            self._by_own[board] = on_board_derivatives(boards, line.image_px, board)

    def solve(self, q: Floats, used: Mask) -> tuple[Floats, Floats]:
        """(3,) the plane of some views, and (3, 2 V) that takes the numbers' errors to those of q.

        The numbers count by the covariance of the poses and of the line points' own noise, which
        is 1.  The camera is held at what was found: boards and sheet are both seen through it, and
        a sheet that made up for the camera's error would lie beside the very lines it is fitted
        to.  What the camera's error does to the sheet is in ``joint_root``.

        Parameters
        ----------
        q : (3,) array, 1/mm, camera frame, where the search begins
        used : (V,) mask, of the views that the plane is to rest on

        Raises
        ------
        MeasurementError
            Where the lines do not determine the plane.
        """
        takes, of_used = np.zeros((3, 2 * len(self._lines))), np.repeat(used, 2)
        for _ in range(MOST_STEPS):
            left, by_q, by_theta = (part[of_used] for part in self._system(q))
            carried = by_theta @ self._poses_root
            weight = np.linalg.inv(np.eye(len(left)) + carried @ carried.T)
            normal = by_q.T @ weight @ by_q
            scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
            scaled = normal / np.outer(scale, scale)
            if np.linalg.cond(scaled) > 1e15:
                raise undetermined()
            own = np.linalg.solve(scaled, (by_q.T @ weight) / scale[:, None]) / scale[:, None]
            takes[:, of_used], step = own, own @ left
            q = q - step
            if np.linalg.norm(step) <= SETTLED * np.linalg.norm(q):
                break
        return q, takes

    def chi_squares(self, q: Floats, takes: Floats, used: Mask) -> tuple[float, Floats]:
        """Of the used views' numbers together, over their degrees of freedom, and (V,) of each's.

        What the fit leaves is counted by its own covariance, camera and poses included; for a view
        that the plane does not rest on, that is the covariance of its distance from the plane.

        Parameters
        ----------
        q : (3,) array, 1/mm, the plane
        takes : (3, 2 V) array, as ``solve`` gave it
        used : (V,) mask, as ``solve`` took it
        """
        left, by_q, by_theta = self._system(q)
        carried = by_theta @ self._root
        leaves = np.eye(len(left)) - by_q @ takes
        covariance = leaves @ (np.eye(len(left)) + carried @ carried.T) @ leaves.T
        of_used = np.repeat(used, 2)
        freedom = int(of_used.sum()) - 3
        places = [slice(2 * k, 2 * k + 2) for k in range(len(used))]
        each = [
            _chi_square(left[at], covariance[at, at], min(2, freedom) if inside else 2)
            for at, inside in zip(places, used, strict=True)
        ]
        whole = _chi_square(left[of_used], covariance[np.ix_(of_used, of_used)], freedom)
        return whole / freedom, np.array(each)

    def own_root(self, q: Floats, takes: Floats) -> Floats:
        """(3, P) square root of the covariance of q for the camera as it is: poses and line.

        Parameters
        ----------
        q : (3,) array, 1/mm, the plane
        takes : (3, 2 V) array, as ``solve`` gave it
        """
        return takes @ np.hstack([self._system(q)[2] @ self._poses_root, np.eye(takes.shape[1])])

    def joint_root(self, q: Floats, takes: Floats, own: Floats) -> Floats:
        """(14 + 3, P) square root of the covariance of theta and q.

        Parameters
        ----------
        q : (3,) array, 1/mm, the plane
        takes : (3, 2 V) array, as ``solve`` gave it
        own : (3, P) array, as ``own_root`` gave it
        """
        by_camera = self._root @ self._of_camera
        through = -takes @ (self._system(q)[2] @ by_camera)
        theta = np.hstack([by_camera[:COUNT], np.zeros((COUNT, own.shape[1]))])
        return np.vstack([theta, np.hstack([through, own])])

    def _system(self, q: Floats) -> tuple[Floats, Floats, Floats]:
        """The numbers (2 V,), and their derivatives by q (2 V, 3) and by camera and poses."""
        rows, by_q = [], []
        by_theta = np.zeros((2 * len(self._lines), len(self._root)))
        unit = q / np.linalg.norm(q)
        for k, (board, line) in enumerate(self._lines.items()):
            points = self._points[board]
            sigma = np.abs(self._across[board] @ unit) * line.sigma_px
            along = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][0]
            reach = (points - points.mean(axis=0)) @ along
            basis = np.linalg.qr(np.column_stack([np.ones(len(reach)), reach]) / sigma[:, None])[0]
            weigh = (basis / sigma[:, None]).T  # (2, K): from distances to the two numbers
            rows.append(weigh @ distance_mm(points, q))
            feet = points - np.outer(distance_mm(points, q), unit)  # on the plane
            by_q.append(weigh @ feet / np.linalg.norm(q))
            by_own = weigh @ (unit @ self._by_own[board])
            pose = COUNT + len(POSE) * board
            by_theta[2 * k : 2 * k + 2, :COUNT] = by_own[:, :COUNT]
            by_theta[2 * k : 2 * k + 2, pose : pose + len(POSE)] = by_own[:, COUNT:]
        return np.concatenate(rows), np.vstack(by_q), by_theta


def _chi_square(left: Floats, covariance: Floats, rank: int) -> float:
    """Sum of squares of numbers (K,) over a covariance (K, K) of a known rank."""
    values, vectors = np.linalg.eigh(covariance)
    return float(((vectors[:, -rank:].T @ left) ** 2 / values[-rank:]).sum())


def undetermined() -> MeasurementError:
    """The error of lines that do not determine the plane."""
    return MeasurementError(
        "the laser's plane is not determined: its lines lie almost in one line of space; "
        "hold the boards nearer and farther, and at different tilts"
    )
