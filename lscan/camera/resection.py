"""Camera, port and poses of boards from marks in pictures: the start, the fit, its covariance."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.special import ndtri, stdtrit

from lscan.camera.optics import project, rays
from lscan.camera.posedboards import (
    CAMERA,
    COUNT,
    FACING,
    FISHEYE,
    GREATEST,
    LEAST,
    POSE,
    CameraPriors,
    PortKind,
    PosedBoards,
    bend_derivatives,
    image_derivatives,
    squares,
    towards,
)
from lscan.config.rig import BENDS
from lscan.records import Floats, Ints, Mask, select

# The covariance of fitted parameters, and the modes of error that it gives to a map.

KEPT = 0.9999  # of the variance that the modes in use must account for
UNSEEN_PX = 1e-3  # rms that the others together may amount to: where a large mode, of another water
# say, makes most of the variance, a small one still bends what is flat
MODE_STEP = 0.01  # sigmas, for differences along a mode: rounding is 1e-9, curvature less
PIXEL_STEP = 0.01  # px, for differences of a map by the pixel

Locate = Callable[[Floats], Floats]
"""A map: (N, 2) mm of (x, z) in the sheet of pixels (N, 2); (N, 3) in space where said."""


def covariance_root(design: Floats, chi_square: float) -> Floats:
    """(P, P) square root of the covariance of P parameters.

    The design's columns are brought to one length first, for parameters of all units.  The
    covariance is scaled up by chi squared per degree of freedom where that is above 1.

    Parameters
    ----------
    design : (N, P) array, derivatives of the weighted residuals
    chi_square : float, sum of squares of the weighted residuals
    """
    scale = np.maximum(np.linalg.norm(design, axis=0), 1e-300)
    _, sizes, directions = np.linalg.svd(design / scale, full_matrices=False)
    freedom = max(design.shape[0] - design.shape[1], 1)
    root = (directions.T / np.maximum(sizes, 1e-12)) / scale[:, None]
    return root * np.sqrt(max(1.0, chi_square / freedom))


def displacements(
    map_of: Callable[[Floats], Locate], theta: Floats, modes: Floats, image_px: Floats
) -> Floats:
    """(N, 2, M) mm by which one standard deviation of each mode moves the points of a map.

    Parameters
    ----------
    map_of : callable, the map of parameters (K,)
    theta : (K,) array, the parameters
    modes : (K, M) array, changes of theta, each one standard deviation large
    image_px : (N, 2) array, px, of (u, v)
    """
    moved = np.zeros((len(image_px), 2, modes.shape[1]))
    for index, mode in enumerate(MODE_STEP * modes.T):
        after, before = (map_of(theta + way)(image_px) for way in (mode, -mode))
        moved[:, :, index] = (after - before) / (2 * MODE_STEP)
    return moved


def compact_root(root: Floats) -> Floats:
    """(K, K) square root of a covariance, or (K, P) where P is less.

    Parameters
    ----------
    root : (K, P) array, root @ root.T is the covariance
    """
    sigma = np.linalg.norm(root, axis=1, keepdims=True)
    scaled = root / np.where(sigma > 0, sigma, 1.0)  # parameters of all units alike
    u, sizes, _ = np.linalg.svd(scaled, full_matrices=False)
    return np.asarray(sigma * (u * sizes))


def ordered_modes(
    map_of: Callable[[Floats], Locate], theta: Floats, root: Floats, image_px: Floats
) -> tuple[Floats, int]:
    """(K, P) square root of a covariance, what moves the map most first; how many columns do.

    The singular values of what the columns do to the points order them.  The last of them count
    for nothing there that leave KEPT of the variance and make less than UNSEEN_PX together; they
    do count wherever the parameters are put to another use, as in other water.

    Parameters
    ----------
    map_of : callable, the map of parameters (K,)
    theta : (K,) array, the parameters
    root : (K, P) array, root @ root.T is their covariance
    image_px : (N, 2) array, px, (u, v) where it counts
    """
    if not root.shape[1]:
        return root, 0
    moved = displacements(map_of, theta, root, image_px)
    seen = np.isfinite(moved).all(axis=(1, 2))
    by_pixel = pixel_derivatives(map_of(theta), image_px[seen])
    _, sizes, directions = np.linalg.svd(moved[seen].reshape(-1, root.shape[1]))
    rest = np.append(np.cumsum(sizes[::-1] ** 2)[::-1], 0.0)  # of the columns from each on
    most = min((1 - KEPT) * rest[0], UNSEEN_PX**2 * np.nansum(by_pixel**2) / 2)
    return root @ directions.T, max(1, int(np.argmax(rest <= most)))


def pixel_derivatives(locate: Locate, image_px: Floats) -> Floats:
    """(N, 2, 2) mm per px of a map, the last axis by u and by v.

    Parameters
    ----------
    locate : callable, the map: (N, 2) mm of (x, z) of pixels (N, 2)
    image_px : (N, 2) array, px, of (u, v)
    """
    steps = PIXEL_STEP * np.vstack([np.eye(2), -np.eye(2)])
    places = locate((image_px + steps[:, None]).reshape(-1, 2)).reshape(4, len(image_px), -1)
    return np.moveaxis(places[:2] - places[2:], 0, 2) / (2 * PIXEL_STEP)


# Camera, port and the poses of boards from marks seen in pictures: one solver for one and many.
#
# Least squares over all parameters at once (Zhang, "A flexible new technique for camera
# calibration", IEEE PAMI 22 (2000), Sec. 3.2), with the flat port traced ray by ray.  The sum of
# squares is that of the marks' residuals in the picture over their standard uncertainties, and of
# the camera's departures from its priors over theirs.


WRONG = 6.0  # sigmas: one good mark in 6e7 is as far off (Rayleigh)
MEDIAN = np.sqrt(2 * np.log(2))  # of the length of a residual of unit uncertainty (Rayleigh)
FAR_PX = 1e4  # px, the residual of a mark that has no image at all
MOST_EVALUATIONS = 500  # one view within 2 degrees of square to the board takes 20 to 440


@dataclass(frozen=True)
class BoardMarks:
    """N marks to fit, of all boards.

    Attributes
    ----------
    board_mm : (N, 2) array, mm, (x, z) on the board
    image_px : (N, 2) array, px, of (u, v)
    sigma_px : (N,) array, px, standard uncertainty of u and of v
    board : (N,) array, number of each mark's board
    """

    board_mm: Floats
    image_px: Floats
    sigma_px: Floats
    board: Ints

    def missed_px(self, boards: PosedBoards) -> Floats:
        """(N, 2) px from each mark's place in the picture to where ``boards`` has it.

        A mark without an image counts as FAR_PX off.

        Parameters
        ----------
        boards : PosedBoards, camera and poses
        """
        seen = boards.project(self.board_mm, self.board)
        return np.nan_to_num(seen - self.image_px, nan=FAR_PX)

    def lengths(self, boards: PosedBoards) -> Floats:
        """(N,) lengths of the residuals over their uncertainties.

        Parameters
        ----------
        boards : PosedBoards, camera and poses
        """
        return np.hypot(*self.missed_px(boards).T) / self.sigma_px


@dataclass(frozen=True)
class CameraFit:
    """A solution of least squares.

    Attributes
    ----------
    boards : PosedBoards, camera and poses
    root : (18 + 6 V, P) array, the covariance of boards.theta is root @ root.T
    marks : BoardMarks, all N marks
    good : (N,) mask, of those that the solution rests on
    """

    boards: PosedBoards
    root: Floats
    marks: BoardMarks
    good: Mask


def sound_marks(lengths: Floats) -> Mask:
    """(N,) mask of the marks that are no outliers.

    An outlier is off by more than WRONG sigmas or, where residuals are altogether larger than
    their uncertainties, by more than WRONG of their usual size.

    Parameters
    ----------
    lengths : (N,) array, the residuals' lengths over their uncertainties
    """
    usual = max(1.0, float(np.median(lengths)) / MEDIAN)
    return lengths <= WRONG * usual


@dataclass(frozen=True)
class _Problem:
    """Least squares over the free parameters; ``some`` are those, in order."""

    boards: PosedBoards
    marks: BoardMarks
    priors: CameraPriors

    @cached_property
    def free(self) -> Mask:
        """(18 + 6 V,) mask of the parameters to be found."""
        poses = np.ones(len(self.boards.theta) - COUNT, dtype=bool)
        return np.concatenate([self.priors.free, poses])

    @property
    def some(self) -> Floats:
        """(free,) the free parameters as they are, then the boards' bend where that is free."""
        bend = self.boards.bend_per_mm[: 3 if self.priors.bend_per_mm else 0]
        return np.concatenate([self.boards.theta[self.free], bend])

    def at(self, some: Floats) -> PosedBoards:
        """Camera and boards with these free parameters."""
        theta, count = self.boards.theta.copy(), int(self.free.sum())
        theta[self.free] = some[:count]
        bend = some[count:] if self.priors.bend_per_mm else self.boards.bend_per_mm
        return replace(self.boards, theta=theta, bend_per_mm=bend)

    def residuals(self, some: Floats) -> Floats:
        """(2 N + priors,) departures from marks and priors over their uncertainties."""
        boards, known = self.at(some), self.priors.informed
        picture = self.marks.missed_px(boards) / self.marks.sigma_px[:, None]
        departure = (boards.theta[:COUNT] - self.priors.mean)[known] / self.priors.sigma[known]
        parts = [picture.ravel(), departure]
        if self.priors.bend_per_mm:
            parts.append(boards.bend_per_mm / self.priors.bend_per_mm)
        return np.concatenate(parts)

    def jacobian(self, some: Floats) -> Floats:
        """(2 N + priors, free) derivatives of the residuals."""
        boards, marks, known = self.at(some), self.marks, self.priors.informed
        by_own = np.nan_to_num(image_derivatives(boards, marks.board_mm, marks.board))
        design = np.zeros((len(marks.board), 2, len(boards.theta)))
        design[:, :, :COUNT] = by_own[:, :, :COUNT]
        pose = COUNT + len(POSE) * marks.board[:, None] + np.arange(len(POSE))
        rows = np.arange(len(marks.board))[:, None]
        design[rows, :, pose] = by_own[:, :, COUNT:].transpose(0, 2, 1)
        picture = (design / marks.sigma_px[:, None, None]).reshape(-1, len(boards.theta))
        departure = np.eye(COUNT, len(boards.theta))[known] / self.priors.sigma[known, None]
        design = np.vstack([picture, departure])[:, self.free]
        if not self.priors.bend_per_mm:
            return design
        bent = np.nan_to_num(bend_derivatives(boards, marks.board_mm, marks.board))
        by_bend = (bent / marks.sigma_px[:, None, None]).reshape(-1, 3)
        by_bend = np.vstack([by_bend, np.zeros((len(departure), 3))])
        known_bend = np.eye(3, design.shape[1] + 3, design.shape[1]) / self.priors.bend_per_mm
        return np.vstack([np.hstack([design, by_bend]), known_bend])


def fit_boards(
    start: PosedBoards,
    marks: BoardMarks,
    priors: CameraPriors,
    tolerance: float,
    most: int = MOST_EVALUATIONS,
) -> PosedBoards:
    """Camera and poses of least squares, within the camera's LIMITS.

    The valley of nearly equal cameras is long, narrow and bent: Levenberg and Marquardt's
    method follows it best, but knows no limits; where it leaves them, the bounded method has
    the last word.

    Parameters
    ----------
    start : PosedBoards, where the search begins
    marks : BoardMarks, mm on the boards, px in the pictures
    priors : CameraPriors, what is known of the camera beforehand
    tolerance : float, relative change of the sum of squares at which it is done
    most : int, evaluations allowed

    References
    ----------
    Z. Zhang, IEEE PAMI 22 (2000), Sec. 3.2.
    """
    problem = _Problem(start, marks, priors)
    if len(problem.residuals(problem.some)) < len(problem.some):
        return fit_within_limits(start, marks, priors, tolerance)  # which needs no equation each
    answer = least_squares(
        problem.residuals,
        problem.some,
        jac=problem.jacobian,
        method="lm",
        x_scale="jac",
        max_nfev=most,
        ftol=tolerance,
    )
    found = problem.at(answer.x)
    camera = found.theta[:COUNT]
    if ((camera >= LEAST) & (camera <= GREATEST))[priors.free].all():
        return found
    return fit_within_limits(found, marks, priors, tolerance)


def fit_within_limits(
    start: PosedBoards,
    marks: BoardMarks,
    priors: CameraPriors,
    tolerance: float,
    robust: float = np.inf,
    most: int = MOST_EVALUATIONS,
) -> PosedBoards:
    """Camera and poses of least squares, each step of the search within the camera's LIMITS.

    Parameters
    ----------
    start : PosedBoards, where the search begins
    marks : BoardMarks, mm on the boards, px in the pictures
    priors : CameraPriors, what is known of the camera beforehand
    tolerance : float, relative change of the sum of squares at which it is done
    robust : float, size of residuals, in sigmas, beyond which they count linearly
    most : int, evaluations allowed
    """
    problem = _Problem(start, marks, priors)
    low, high = np.full(len(problem.some), -np.inf), np.full(len(problem.some), np.inf)
    count = int(priors.free.sum())
    low[:count], high[:count] = LEAST[priors.free], GREATEST[priors.free]
    answer = least_squares(
        problem.residuals,
        np.clip(problem.some, low, high),
        jac=problem.jacobian,
        bounds=(low, high),
        x_scale="jac",
        loss="soft_l1" if np.isfinite(robust) else "linear",
        f_scale=robust if np.isfinite(robust) else 1.0,
        max_nfev=most,
        ftol=tolerance,
    )
    return problem.at(answer.x)


def chi_square(boards: PosedBoards, marks: BoardMarks, priors: CameraPriors) -> float:
    """The sum of squares that is minimised, of marks and priors over their uncertainties.

    Parameters
    ----------
    boards : PosedBoards, camera and poses
    marks : BoardMarks, mm on the boards, px in the pictures
    priors : CameraPriors, what is known of the camera beforehand
    """
    problem = _Problem(boards, marks, priors)
    return float((problem.residuals(problem.some) ** 2).sum())


def with_covariance(
    boards: PosedBoards, marks: BoardMarks, priors: CameraPriors, good: Mask, common: bool = False
) -> CameraFit:
    """The solution for some of the marks, with its covariance.

    The covariance is that of the normal equations, scaled up by chi squared per degree of
    freedom where that is above 1, and of several views that of errors that the marks of a view
    share beside it.

    Parameters
    ----------
    boards : PosedBoards, the solution
    marks : BoardMarks, all N marks
    priors : CameraPriors, what is known of the camera beforehand
    good : (N,) mask, of the marks that the solution rests on
    common : bool, whether what the marks of a view share is the same in all views, of a lens say
        that is none of the model's: it does not average over them
    """
    used = select(marks, good)
    problem = _Problem(boards, used, priors)
    left, design = problem.residuals(problem.some), problem.jacobian(problem.some)
    some = covariance_root(design, float(left @ left))
    if len(boards.poses) > 1:
        times = np.sqrt(len(boards.poses)) if common else 1.0
        some = np.hstack([some, times * _shared_root(design, left, used)])
    root = np.zeros((len(boards.theta), some.shape[1]))
    root[problem.free] = some[: int(problem.free.sum())]
    return CameraFit(boards, root, marks, good)


def _shared_root(design: Floats, left: Floats, marks: BoardMarks) -> Floats:
    """(P, 12 V) what errors that the marks of a view share add to the root of the covariance.

    design: (N, P) derivatives of the weighted residuals.  left: (N,) the residuals.

    The error of a view's marks is taken to be noise and a field that varies over the board as a
    polynomial of second degree, in u and in v, of one standard uncertainty tau for each of the
    twelve coefficients (places over the board's half size).  With the design's projection H on
    what is left, S the fields and G = S' H S, the expectations

        E[e' e] = sigma^2 (N - P) + tau^2 tr G,  E[e' S S' e] = sigma^2 tr G + tau^2 tr G^2

    give both variances (analysis of variance; C. R. Rao, J. Multivar. Anal. 1 (1971) 257).  Few
    views determine tau badly: Student's factor stands in for 1.96, for Satterthwaite's degrees of
    freedom (Biometrics Bull. 2 (1946) 110) or, where they are fewer, for the views less one, as a
    view may hold one error only (A. C. Cameron and D. L. Miller, J. Hum. Resour. 50 (2015) 317).

    A sandwich of the views' scores with Bell and McCaffrey's correction (Surv. Methodol. 28 (2002)
    169) holds as well for one number, but its covariance has the rank of the views less one: fewer
    than a camera's parameters, and it leaves out the poses, whose scores are 0.
    """
    root = covariance_root(design, 0.0)
    to_fit = design @ root  # orthonormal
    places = (marks.board_mm - marks.board_mm.mean(axis=0)) / np.ptp(marks.board_mm, axis=0) * 2
    terms = np.column_stack([np.ones(len(places)), places, squares(places)])
    effects, moments, views = [], [], np.unique(marks.board)
    products = []
    for board in views:
        mine = np.flatnonzero(marks.board == board)
        field = np.kron(terms[mine] / marks.sigma_px[mine, None], np.eye(2))
        rows = (2 * mine[:, None] + [0, 1]).ravel()
        effects.append(to_fit[rows].T @ field)
        moments.append(field.T @ left[rows])
        products.append(field.T @ field)
    effect, moment = np.hstack(effects), np.concatenate(moments)
    gram = block_diag(*products) - effect.T @ effect
    trace, square, freedom = np.trace(gram), float((gram**2).sum()), max(len(left) - len(root), 1)
    shared = (moment @ moment * freedom - left @ left * trace) / (square * freedom - trace**2)
    if not shared > 0:
        return np.zeros((len(root), 0))
    noise = max((left @ left - shared * trace) / freedom, 0.0)
    spread = shared * gram @ gram + noise * gram
    few = np.trace(spread) ** 2 / float((spread**2).sum())
    return root @ effect * np.sqrt(shared) * student_factor(min(few, len(views) - 1))


def student_factor(freedom: float) -> float:
    """How much wider a 95 % interval is whose sigma was found with few degrees of freedom.

    Parameters
    ----------
    freedom : float, degrees of freedom, taken for 1 where they are fewer
    """
    return float(stdtrit(max(freedom, 1.0), 0.975) / ndtri(0.975))


# Where least squares begins: a pinhole in the water's stead.
#
# Behind a port, rays near the axis are those of a pinhole with water_index times the focal length.


START_WIDTHS = (1.2, 0.7, 2.0)  # focal lengths over the width to start from where none is known
FISHEYE_WIDTHS = (0.45, 0.33, 0.7)  # px a radian over the width: 127, 174 and 82 degrees across
FISHEYE_BENDS = (0.7778, 0.0677, 0.0, 0.0, 0.0, 1.1111, 0.2381, 0.0)
"""BENDS of a rational lens whose radius goes with the angle: Padé's approximation of the
arctangent, from its continued fraction (Abramowitz & Stegun 4.4.43)."""
START_PX = 10.0  # residuals above this count linearly while the start is sought
EVALUATIONS = 15
TOLERANCE = 1e-9  # relative change of the sum of squares


def best_start(
    marks: BoardMarks, priors: CameraPriors, port: PortKind, width: int
) -> PosedBoards | None:
    """Rough camera and poses; None where no board's marks are a picture of a plane.

    The best of several, one for each focal length that may be.  The first that explains the
    marks within their uncertainties is as good as any.

    Parameters
    ----------
    marks : BoardMarks, mm on the boards, px in the pictures
    priors : CameraPriors, what is known of the camera beforehand
    port : str, "flat", or "none" for a camera in air
    width : int, px, of the picture
    """
    robust = START_PX / float(np.median(marks.sigma_px))
    best, least = None, np.inf
    for theta in _starts(priors, width):
        if (posed := posed_boards(theta, port, marks)) is None:
            continue
        tried = fit_within_limits(posed, marks, priors, TOLERANCE, robust, EVALUATIONS)
        size = float(np.median(marks.lengths(tried)))
        if size < least:
            best, least = tried, size
        if least < WRONG:
            break
    return best


def _starts(priors: CameraPriors, width: int) -> list[Floats]:
    """(18,) each, the cameras to start from."""
    fisheye, rational = priors.mean[FISHEYE] > 0, priors.sigma[CAMERA.index("k5")] > 0
    widths = FISHEYE_WIDTHS if fisheye else START_WIDTHS
    focals = [priors.mean[0]] if priors.focal_given else [share * width for share in widths]
    starts = [np.array([focal, *priors.mean[1:]]) for focal in focals]
    if rational:
        focals = [priors.mean[0]] if priors.focal_given else [s * width for s in FISHEYE_WIDTHS]
        wide = [np.array([focal, *priors.mean[1:]]) for focal in focals]
        for theta in wide:
            theta[3 : 3 + len(BENDS)] = FISHEYE_BENDS
        starts += wide
    return starts


def posed_boards(theta: Floats, port: PortKind, marks: BoardMarks) -> PosedBoards | None:
    """The camera and the boards where a pinhole of its angle of view has them.

    Each board's homography gives its pose.  None where the marks of a board give none.

    Parameters
    ----------
    theta : (18 or more,) array, the camera in the order of parameters.CAMERA
    port : str, "flat", or "none" for a camera in air
    marks : BoardMarks, mm on the boards, px in the pictures

    References
    ----------
    Z. Zhang, "A flexible new technique for camera calibration", IEEE PAMI 22 (2000), Sec. 3.1.
    """
    alone = PosedBoards(theta[:COUNT], marks.board_mm.mean(axis=0), port)
    poses = []
    for number in range(int(marks.board.max()) + 1):
        if (pose := _pose(alone, select(marks, marks.board == number))) is None:
            return None
        poses.append(pose)
    return PosedBoards(np.concatenate([alone.theta, *poses]), alone.centre_mm, port)


def _pose(alone: PosedBoards, marks: BoardMarks) -> Floats | None:
    """(6,) the pose of one board before a camera alone."""
    centre_px, apparent = np.array(alone.camera.centre_px), alone.apparent_focal_px
    plane, pinhole = marks.board_mm - alone.centre_mm, (marks.image_px - centre_px) / apparent
    if wide := alone.camera.fisheye or alone.camera.k4 != 0:  # far from a pinhole
        direction = rays(alone.camera, marks.image_px).direction
        imaged = np.isfinite(direction).all(axis=1)
        plane, pinhole = plane[imaged], direction[imaged, :2] / direction[imaged, 2:]
    homography = cv2.findHomography(plane, pinhole)[0] if len(plane) >= 4 else None
    if homography is None:
        return None
    homography = homography / np.linalg.norm(homography[:, :2], axis=0).mean()
    homography *= np.sign(homography[2, 2])
    x, z, shift = homography.T
    u, _, vt = np.linalg.svd(np.column_stack([x, np.cross(z, x), z]))
    axes = u @ vt
    seen = centre_px + apparent * shift[:2] / shift[2]
    if wide:
        seen = project(alone.camera, shift[None])[0]
    sight = rays(alone.camera, seen[None]).direction
    if np.linalg.det(axes) < 0 or np.isnan(sight).any():
        return None
    turn = Rotation.from_matrix(towards(sight)[0].T @ axes @ FACING.T).as_rotvec()
    return np.array([*turn, *seen, np.linalg.norm(shift) / apparent])
