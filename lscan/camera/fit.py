"""Camera, port and the poses of boards from marks seen in pictures: one solver for one and many.

Least squares over all parameters at once (Zhang, "A flexible new technique for camera
calibration", IEEE PAMI 22 (2000), Sec. 3.2), with the flat port traced ray by ray.  The sum of
squares is that of the marks' residuals in the picture over their standard uncertainties, and of
the camera's departures from its priors over theirs.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.optimize import least_squares

from lscan.camera.boards import POSE, PosedBoards
from lscan.camera.covariance import covariance_root
from lscan.camera.derivatives import image_derivatives
from lscan.camera.parameters import COUNT, GREATEST, LEAST, CameraPriors
from lscan.records import Floats, Ints, Mask, select

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
    root : (14 + 6 V, P) array, the covariance of boards.theta is root @ root.T
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
        """(14 + 6 V,) mask of the parameters to be found."""
        poses = np.ones(len(self.boards.theta) - COUNT, dtype=bool)
        return np.concatenate([self.priors.free, poses])

    def at(self, some: Floats) -> PosedBoards:
        """Camera and boards with these free parameters."""
        theta = self.boards.theta.copy()
        theta[self.free] = some
        return replace(self.boards, theta=theta)

    def residuals(self, some: Floats) -> Floats:
        """(2 N + priors,) departures from marks and priors over their uncertainties."""
        boards, known = self.at(some), self.priors.informed
        picture = self.marks.missed_px(boards) / self.marks.sigma_px[:, None]
        departure = (boards.theta[:COUNT] - self.priors.mean)[known] / self.priors.sigma[known]
        return np.concatenate([picture.ravel(), departure])

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
        return np.vstack([picture, departure])[:, self.free]


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
    if 2 * len(marks.board) + priors.informed.sum() < problem.free.sum():
        return fit_within_limits(start, marks, priors, tolerance)  # which needs no equation each
    answer = least_squares(
        problem.residuals,
        start.theta[problem.free],
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
    low, high = np.full(len(start.theta), -np.inf), np.full(len(start.theta), np.inf)
    low[:COUNT], high[:COUNT] = LEAST, GREATEST
    answer = least_squares(
        problem.residuals,
        np.clip(start.theta, low, high)[problem.free],
        jac=problem.jacobian,
        bounds=(low[problem.free], high[problem.free]),
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
    return float((problem.residuals(boards.theta[problem.free]) ** 2).sum())


def with_covariance(
    boards: PosedBoards, marks: BoardMarks, priors: CameraPriors, good: Mask
) -> CameraFit:
    """The solution for some of the marks, with its covariance.

    The covariance is that of the normal equations, scaled up by chi squared per degree of
    freedom where that is above 1.

    Parameters
    ----------
    boards : PosedBoards, the solution
    marks : BoardMarks, all N marks
    priors : CameraPriors, what is known of the camera beforehand
    good : (N,) mask, of the marks that the solution rests on
    """
    used = select(marks, good)
    problem = _Problem(boards, used, priors)
    design = problem.jacobian(boards.theta[problem.free])
    root = np.zeros((len(boards.theta), design.shape[1]))
    root[problem.free] = covariance_root(design, chi_square(boards, used, priors))
    return CameraFit(boards, root, marks, good)
