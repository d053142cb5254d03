"""Camera, port and the boards' poses from the marks of all views: bundle adjustment.

Least squares over all parameters at once (Zhang, "A flexible new technique for camera
calibration", IEEE PAMI 22 (2000), Sec. 3.2), with the flat port traced ray by ray: what is
minimised is the sum of squares of the marks' residuals in the picture over their standard
uncertainties, and of the camera's departures from what was known of it over theirs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import cv2
import numpy as np

from lscan.calibration.boardview import LENS, PORT
from lscan.calibration.multiview.views import View
from lscan.camera import Camera, FlatPort, project
from lscan.records import Floats, Ints, Mask

NAMES = (*LENS, "k3", *PORT)
COUNT = len(NAMES)
POSE = 6  # of a view: a small turn (rad) and a shift (mm), both in the camera frame
FAR_PX = 1e4  # stands for the residual of a mark that has no image at all
LEAST_SIGMA_PX = 0.002  # no mark of an 8-bit picture is known better; as planemap's; ours
MOST_STEPS = 200
CONVERGED = 1e-12  # relative change of the sum of squares; twice in a row
MOST_DAMPING = 1e12  # beyond it no step is small enough to help

# For central differences: each moves the picture by 1e-3 to 0.1 px.
STEPS = np.array(
    [
        *(0.05, 0.05, 0.05),  # focal length and centre, px
        *(1e-4, 1e-4, 1e-5, 1e-5, 1e-4),  # distortion
        *(0.01, 0.01, 1e-4, 1e-4, 1e-3, 1e-3),  # port: lengths, mm; indices; tilts, degrees
    ]
)
STEP_MM = 0.01


@dataclass(frozen=True)
class Prior:
    """What is known of the camera beforehand: (14,) each; sigma 0: held, infinite: unknown."""

    mean: Floats
    sigma: Floats

    @cached_property
    def free(self) -> Ints:
        """Indices into NAMES of the parameters to be found."""
        return np.flatnonzero(self.sigma > 0)

    @cached_property
    def informed(self) -> Mask:
        """Mask, over the free ones, of those of which something is known."""
        return np.isfinite(self.sigma[self.free])


@dataclass(frozen=True)
class Observations:
    """Marks of all views, stacked.

    board_mm: (N, 3) in the board's frame: x right, y down, z into the board, its origin in
        the middle of the marks.  image_px: (N, 2).  sigma_px: (N,).  view: (N,) index of each.
    """

    board_mm: Floats
    image_px: Floats
    sigma_px: Floats
    view: Ints

    def only(self, wanted: Mask) -> Observations:
        """Those of a mask (N,)."""
        return Observations(
            self.board_mm[wanted], self.image_px[wanted], self.sigma_px[wanted], self.view[wanted]
        )

    def of_views(self, kept: Ints) -> Observations:
        """The marks of some views, which are numbered anew in that order."""
        number = np.full(int(self.view.max(initial=0)) + 1, -1)
        number[kept] = np.arange(len(kept))
        some = self.only(number[self.view] >= 0)
        return replace(some, view=number[some.view])


@dataclass(frozen=True)
class Bundle:
    """A camera and V boards before it.

    theta: (14,) in the order of NAMES.  port: "none" for a camera in air.
    rotation: (V, 3, 3), place_mm: (V, 3): board frame to camera frame.
    """

    theta: Floats
    port: Literal["flat", "none"]
    rotation: Floats
    place_mm: Floats

    @property
    def camera(self) -> Camera:
        """The camera alone."""
        return camera_of(self.theta, self.port)

    def in_camera(self, marks: Observations) -> Floats:
        """(N, 3) the marks in the camera frame, mm."""
        turned = np.einsum("nij,nj->ni", self.rotation[marks.view], marks.board_mm)
        return turned + self.place_mm[marks.view]

    def misses_px(self, marks: Observations) -> Floats:
        """(N, 2) px from each mark's place in the picture to where the bundle puts it."""
        seen = project(self.camera, self.in_camera(marks))
        return np.nan_to_num(seen - marks.image_px, nan=FAR_PX)

    def moved(self, step: Floats, prior: Prior) -> Bundle:
        """The bundle after a step (free parameters + 6 V,)."""
        theta = self.theta.copy()
        theta[prior.free] += step[: len(prior.free)]
        poses = step[len(prior.free) :].reshape(-1, POSE)
        turns = np.array([cv2.Rodrigues(turn)[0] for turn in poses[:, :3]])
        return replace(
            self,
            theta=theta,
            rotation=turns @ self.rotation,
            place_mm=self.place_mm + poses[:, 3:],
        )


@dataclass(frozen=True)
class Adjusted:
    """bundle: the solution.  root: (free + 6 V, P), the covariance of a step is root @ root.T.

    good: (N,) mask of the marks it rests on.  chi_square: over degrees_of_freedom.
    """

    bundle: Bundle
    root: Floats
    good: Mask
    chi_square: float
    degrees_of_freedom: int


def camera_of(theta: Floats, port: Literal["flat", "none"]) -> Camera:
    """The camera of parameters (14,)."""
    focal, u, v, k1, k2, p1, p2, k3 = theta[:8].tolist()
    window = FlatPort(*theta[8:].tolist()) if port == "flat" else None
    return Camera(focal, (u, v), k1, k2, p1, p2, k3, window)


def observations(views: list[View]) -> Observations:
    """The marks that were found in views, all of which have some."""
    marks = [view.marks for view in views if view.marks is not None]
    middle = np.vstack([m.board_mm[m.found] for m in marks]).mean(axis=0)
    plane = np.vstack([m.board_mm[m.found] for m in marks]) - middle
    return Observations(
        board_mm=np.column_stack([plane[:, 0], -plane[:, 1], np.zeros(len(plane))]),
        image_px=np.vstack([m.image_px[m.found] for m in marks]),
        sigma_px=np.maximum(np.concatenate([m.sigma_px[m.found] for m in marks]), LEAST_SIGMA_PX),
        view=np.repeat(np.arange(len(marks)), [int(m.found.sum()) for m in marks]),
    )


def adjust(start: Bundle, marks: Observations, prior: Prior, good: Mask) -> Adjusted:
    """The bundle of least squares from ``start`` on, with the marks of the mask ``good`` (N,).

    Levenberg and Marquardt's method (Marquardt, SIAM J. 11 (1963) 431), the parameters scaled
    by the lengths of their columns.  The covariance is scaled up by chi squared per degree of
    freedom where that is above 1.
    """
    used = marks.only(good)
    bundle, damping, settled = start, 1e-3, 0
    size = _size(bundle, used, prior)
    for _ in range(MOST_STEPS):
        design, left = _equations(bundle, used, prior)
        scale = np.maximum(np.linalg.norm(design, axis=0), 1e-300)
        while damping < MOST_DAMPING:
            tried = bundle.moved(_damped(design / scale, left, damping) / scale, prior)
            after = _size(tried, used, prior)
            if after <= size:
                break
            damping *= 10
        else:
            break
        settled = settled + 1 if size - after <= CONVERGED * size else 0
        bundle, size, damping = tried, after, max(damping / 10, 1e-15)
        if settled == 2:
            break
    design, left = _equations(bundle, used, prior)
    freedom = max(len(left) - design.shape[1], 1)
    root = _root(design) * np.sqrt(max(1.0, size / freedom))
    return Adjusted(bundle, root, good, size, freedom)


def _damped(design: Floats, left: Floats, damping: float) -> Floats:
    """The step that makes up for ``left``, each scaled parameter held back by ``damping``."""
    count = design.shape[1]
    held = np.vstack([design, np.sqrt(damping) * np.eye(count)])
    step: Floats = np.linalg.lstsq(held, -np.concatenate([left, np.zeros(count)]), rcond=None)[0]
    return step


def _root(design: Floats) -> Floats:
    """Square root of the inverse of design.T @ design; no variance where nothing is known."""
    scale = np.maximum(np.linalg.norm(design, axis=0), 1e-300)
    _, sizes, directions = np.linalg.svd(design / scale, full_matrices=False)
    return (directions.T / np.maximum(sizes, 1e-12)) / scale[:, None]


def _residuals(bundle: Bundle, marks: Observations, prior: Prior) -> Floats:
    picture = bundle.misses_px(marks) / marks.sigma_px[:, None]
    known = prior.free[prior.informed]
    departure = (bundle.theta - prior.mean)[known] / prior.sigma[known]
    return np.concatenate([picture.ravel(), departure])


def _size(bundle: Bundle, marks: Observations, prior: Prior) -> float:
    """Sum of squares, infinite where the camera is none."""
    focal, gap, thick, glass, water = bundle.theta[[0, 8, 9, 10, 11]]
    if focal <= 0 or gap < 0 or thick < 0 or min(glass, water) < 1:
        return np.inf
    return float((_residuals(bundle, marks, prior) ** 2).sum())


def _equations(bundle: Bundle, marks: Observations, prior: Prior) -> tuple[Floats, Floats]:
    """Derivatives of all residuals by a step, and the residuals."""
    points, count = bundle.in_camera(marks), len(marks.view)
    columns = [_by_theta(bundle, points, index) for index in prior.free]
    by_point = np.stack([_by_place(bundle, points, axis) for axis in range(3)], axis=2)
    lever = points - bundle.place_mm[marks.view]
    by_turn = np.cross(lever[:, None], by_point)  # (turn x lever) . g is turn . (lever x g)
    by_pose = np.concatenate([by_turn, by_point], axis=2)  # (N, 2, 6)
    design = np.zeros((count, 2, len(prior.free) + POSE * len(bundle.place_mm)))
    design[:, :, : len(prior.free)] = np.stack(columns, axis=2) if columns else 0.0
    place = len(prior.free) + POSE * marks.view[:, None] + np.arange(POSE)
    design[np.arange(count)[:, None], :, place] = by_pose.transpose(0, 2, 1)
    rows = np.nan_to_num(design / marks.sigma_px[:, None, None]).reshape(2 * count, -1)
    known = np.eye(len(prior.free), rows.shape[1])[prior.informed]
    known = known / prior.sigma[prior.free[prior.informed], None]
    return np.vstack([rows, known]), _residuals(bundle, marks, prior)


def _by_theta(bundle: Bundle, points: Floats, index: int) -> Floats:
    """(N, 2) change in px of points (N, 3) per unit of the parameter NAMES[index]."""
    step = np.zeros(COUNT)
    step[index] = STEPS[index]
    after, before = (
        project(camera_of(bundle.theta + way * step, bundle.port), points) for way in (1, -1)
    )
    return (after - before) / (2 * STEPS[index])


def _by_place(bundle: Bundle, points: Floats, axis: int) -> Floats:
    """(N, 2) change in px per mm that points (N, 3) move along an axis of the camera."""
    step = STEP_MM * np.eye(3)[axis]
    after, before = (project(bundle.camera, points + way * step) for way in (1, -1))
    return (after - before) / (2 * STEP_MM)
