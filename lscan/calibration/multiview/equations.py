"""What the lines say of the laser's plane: two numbers a view, and how sure they are."""

from __future__ import annotations

import numpy as np

from lscan.calibration.multiview.bundle import NAMES, POSE, STEPS, Adjusted, Bundle, Prior
from lscan.calibration.multiview.lines import Sight, across_mm, distance_mm, locate, on_board
from lscan.camera import rays
from lscan.errors import MeasurementError
from lscan.records import Floats, Ints

TURNS = 20  # of Gauss and Newton, at most; the plane's equation is nearly linear
SETTLED = 1e-12  # relative change of the plane: float64's rounding


class SheetEquations:
    """The two numbers of each of V views, as they depend on the plane, camera and poses."""

    def __init__(self, adjusted: Adjusted, prior: Prior, sights: list[Sight]) -> None:
        self._adjusted, self._prior, self._sights = adjusted, prior, sights
        bundle = adjusted.bundle
        self._points = [on_board(bundle, s.image_px, s.view) for s in sights]
        self._across = [across_mm(bundle, s) @ bundle.rotation[s.view].T for s in sights]
        self._by_theta = [_by_theta(bundle, s, prior.free) for s in sights]
        self._by_pose = [_by_pose(bundle, s) for s in sights]

    def solve(self, q: Floats) -> tuple[Floats, Floats]:
        """(3,) the plane, and (3, 2 V) that takes the two numbers' errors to those of q."""
        takes = np.zeros((3, 2 * len(self._sights)))
        for _ in range(TURNS):
            left, by_q, _ = self._system(q)
            weight = np.linalg.inv(self._covariance(q))
            normal = by_q.T @ weight @ by_q
            scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
            scaled = normal / np.outer(scale, scale)
            if np.linalg.cond(scaled) > 1e15:
                raise undetermined()
            takes = np.linalg.solve(scaled, (by_q.T @ weight) / scale[:, None]) / scale[:, None]
            step = takes @ left
            q = q - step
            if np.linalg.norm(step) <= SETTLED * np.linalg.norm(q):
                break
        return q, takes

    def chi_squares(self, q: Floats, takes: Floats) -> tuple[float, Floats]:
        """Of all numbers together, over 2 V - 3 degrees of freedom, and (V,) of each view's two.

        What the fit leaves is counted by its own covariance, camera and poses included.
        """
        left, by_q, by_step = self._system(q)
        carried = by_step @ self._adjusted.root
        leaves = np.eye(len(left)) - by_q @ takes
        covariance = leaves @ (np.eye(len(left)) + carried @ carried.T) @ leaves.T
        each = [
            _chi_square(left[at], covariance[at, at], min(2, len(left) - 3))
            for at in (slice(2 * k, 2 * k + 2) for k in range(len(self._sights)))
        ]
        return _chi_square(left, covariance, len(left) - 3), np.array(each)

    def own_root(self, q: Floats, takes: Floats) -> Floats:
        """(3, P) square root of the covariance of q for the camera as it is: poses and line."""
        return takes @ np.hstack([self._system(q)[2] @ self._poses_root(), np.eye(takes.shape[1])])

    def joint_root(self, q: Floats, takes: Floats, own: Floats) -> Floats:
        """(14 + 3, P) square root of the covariance of theta and q; own: as ``own_root``'s."""
        free, root = self._prior.free, self._adjusted.root
        camera = self._camera_directions()
        through = -takes @ (self._system(q)[2] @ root @ camera)
        joint = np.zeros((len(NAMES) + 3, camera.shape[1] + own.shape[1]))
        joint[free, : camera.shape[1]] = root[: len(free)] @ camera
        joint[-3:] = np.hstack([through, own])
        return joint

    def _camera_directions(self) -> Floats:
        """(P, C) the errors, of those that the root's columns stand for, that move the camera."""
        directions: Floats = np.linalg.qr(self._adjusted.root[: len(self._prior.free)].T)[0]
        return directions

    def _poses_root(self) -> Floats:
        """The root of the covariance of camera and poses, less all that moves the camera."""
        root, camera = self._adjusted.root, self._camera_directions()
        return root - root @ camera @ camera.T

    def _covariance(self, q: Floats) -> Floats:
        """(2 V, 2 V) of the two numbers of all views; 1 for the line points' own noise.

        The camera is held at what was found: boards and sheet are both seen through it, and a
        sheet that made up for the camera's error would lie beside the very lines it is fitted
        to.  What the camera's error does to the sheet is in ``joint_root``.
        """
        carried = self._system(q)[2] @ self._poses_root()
        return np.eye(len(carried)) + carried @ carried.T

    def _system(self, q: Floats) -> tuple[Floats, Floats, Floats]:
        """The numbers (2 V,), and their derivatives by q (2 V, 3) and by the bundle's step."""
        free = self._prior.free
        rows, by_q = [], []
        by_step = np.zeros((2 * len(self._sights), self._adjusted.root.shape[0]))
        unit = q / np.linalg.norm(q)
        for k, sight in enumerate(self._sights):
            points = self._points[k]
            sigma = np.abs(self._across[k] @ unit) * sight.sigma_px
            along = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][0]
            reach = (points - points.mean(axis=0)) @ along
            basis = np.linalg.qr(np.column_stack([np.ones(len(reach)), reach]) / sigma[:, None])[0]
            weigh = (basis / sigma[:, None]).T  # (2, K): from distances to the two numbers
            rows.append(weigh @ distance_mm(points, q))
            turned = points - np.outer(distance_mm(points, q), unit)  # their feet on the plane
            by_q.append(weigh @ turned / np.linalg.norm(q))
            at = slice(2 * k, 2 * k + 2)
            by_step[at, : len(free)] = weigh @ (unit @ self._by_theta[k])
            pose = len(free) + POSE * sight.view
            by_step[at, pose : pose + POSE] = weigh @ (unit @ self._by_pose[k])
        return np.concatenate(rows), np.vstack(by_q), by_step


def _chi_square(left: Floats, covariance: Floats, rank: int) -> float:
    """Sum of squares of numbers (K,) over a covariance (K, K) of a known rank."""
    values, vectors = np.linalg.eigh(covariance)
    return float(((vectors[:, -rank:].T @ left) ** 2 / values[-rank:]).sum())


def _by_theta(bundle: Bundle, sight: Sight, free: Ints) -> Floats:
    """(K, 3, free) mm that the points move per unit of each free parameter of the camera."""
    normal, place = bundle.rotation[sight.view][:, 2], bundle.place_mm[sight.view]
    moved = np.zeros((len(sight.image_px), 3, len(free)))
    for column, index in enumerate(free):
        step = np.zeros(len(NAMES))
        step[index] = STEPS[index]
        after, before = (
            locate(bundle.theta + way * step, bundle.port, sight.image_px, normal, place)
            for way in (1, -1)
        )
        moved[:, :, column] = (after - before) / (2 * STEPS[index])
    return moved


def _by_pose(bundle: Bundle, sight: Sight) -> Floats:
    """(K, 3, 6) mm that the points move per unit of the board's turn and shift.

    A point P of a ray d that meets the plane of normal b: where the board's point there moves
    by m, the ray meets the board (b . m) / (b . d) further on.
    """
    normal, place = bundle.rotation[sight.view][:, 2], bundle.place_mm[sight.view]
    direction = rays(bundle.camera, sight.image_px).direction
    points = on_board(bundle, sight.image_px, sight.view)
    by_turn = np.cross(points - place, normal)  # (turn x lever) . b = turn . (lever x b)
    moves = np.hstack([by_turn, np.broadcast_to(normal, by_turn.shape)])
    along = direction / (direction @ normal)[:, None]
    return along[:, :, None] * moves[:, None, :]


def undetermined() -> MeasurementError:
    """The error of lines that do not tell the plane."""
    return MeasurementError(
        "the laser's plane is not determined: its lines lie almost in one line of space; "
        "hold the boards nearer and farther, and at different tilts"
    )
