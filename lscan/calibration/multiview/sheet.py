"""The laser's plane from the line seen on boards whose poses are known.

Each line point is the place where its pixel's ray meets the board.  A plane cuts a board in a
straight line, so that a view gives two numbers: how far its line lies off
the sheet, and how it leans against it.  Errors of the board's pose and of the camera, which
all points of a view share, are counted with those two numbers, not with each point.
"""

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from lscan.calibration.multiview.equations import PlaneEquations, undetermined
from lscan.calibration.multiview.lines import FEWEST_POINTS, distance_mm, line_ends, straight
from lscan.calibration.multiview.views import LinePoints
from lscan.camera.boards import PosedBoards
from lscan.camera.fit import CameraFit
from lscan.errors import MeasurementError
from lscan.records import Floats, Mask, select

WRONG = 6.0  # sigmas: beyond them a view's line is an outlier
MEDIAN_CHI_SQUARE = 2 * np.log(2)  # of two degrees of freedom
LEAST_ANGLE_DEG = 10.0  # between board and sheet; the line's place on the board is unsure below
MOST_TILT_DEG = 1.0  # standard uncertainty of the sheet's tilt beyond which it is not known


@dataclass(frozen=True)
class LaserPlane:
    """The laser's plane q . X = 1 in the camera frame.

    Attributes
    ----------
    q_per_mm : (3,) array, 1/mm, its normal over its distance from the pinhole
    root : (14 + 3, P) array, root @ root.T is the covariance of the camera's theta and of q
        together
    good : dict of mask, by board, of the line points it rests on
    faults : dict of str, by board, why a line was left out
    distances_mm : dict of array, mm, by board, of its line points from the plane
    """

    q_per_mm: Floats
    root: Floats
    good: dict[int, Mask]
    faults: dict[int, str]
    distances_mm: dict[int, Floats]


def find_plane(fit: CameraFit, free: Mask, lines: dict[int, LinePoints]) -> LaserPlane:
    """The plane of generalised least squares through the lines of all views but outliers.

    A view is an outlier where its two numbers lie more than WRONG standard uncertainties (or of
    their usual size, where all are larger) from the plane of the others.  The covariance is
    scaled up by chi squared per degree of freedom of those two numbers where above 1.

    Parameters
    ----------
    fit : CameraFit, camera and poses
    free : (14,) mask, of the camera's parameters that were found
    lines : dict of LinePoints, px, by number of the board

    Raises
    ------
    MeasurementError
        Where fewer than two lines are left or where they do not determine the plane: all in one
        line, or on boards nearly parallel to the sheet.
    """
    boards = fit.boards
    masks = {board: straight(boards, line, board) for board, line in lines.items()}
    faults = {
        board: f"only {int(mask.sum())} points of the line lie in one line"
        for board, mask in masks.items()
        if mask.sum() < FEWEST_POINTS
    }
    usable = {board: select(lines[board], masks[board]) for board in lines if board not in faults}
    _require_two(usable, faults)
    q = _agreed_plane(boards, usable)
    for board in list(usable):
        cosine = abs(boards.axes[board][:, 1] @ q) / np.linalg.norm(q)
        angle = np.degrees(np.arccos(min(cosine, 1.0)))
        if angle < LEAST_ANGLE_DEG:
            faults[board] = f"the board lies {angle:.1f} deg from the sheet: too near it"
            del usable[board]
    while True:
        _require_two(usable, faults)
        equations = PlaneEquations(fit, free, usable)
        q, takes = equations.solve(q)
        whole, chi = equations.chi_squares(q, takes)
        usual = max(1.0, float(np.median(chi)) / MEDIAN_CHI_SQUARE)
        worst = int(chi.argmax())
        if len(usable) < 3 or chi[worst] <= WRONG**2 * usual:
            break
        board = list(usable)[worst]
        off = distance_mm(boards.on_board(usable[board].image_px, board), q)
        rms = np.sqrt(np.mean(off**2))
        faults[board] = f"its line lies {rms:.3f} mm rms off the sheet of the other views"
        del usable[board]
    own = equations.own_root(q, takes) * np.sqrt(max(1.0, whole / (2 * len(usable) - 3)))
    _require_sure(q, own)
    return LaserPlane(
        q_per_mm=q,
        root=equations.joint_root(q, takes, own),
        good={board: mask & (board not in faults) for board, mask in masks.items()},
        faults=faults,
        distances_mm={
            board: distance_mm(boards.on_board(line.image_px, board), q)
            for board, line in lines.items()
        },
    )


def _agreed_plane(boards: PosedBoards, lines: dict[int, LinePoints]) -> Floats:
    """(3,) q of the plane through two views' lines that the median view lies nearest to."""
    ends = np.stack(
        [line_ends(boards.on_board(line.image_px, board)) for board, line in lines.items()]
    )  # (V, 2, 3)
    best, least = None, np.inf
    for i, j in combinations(range(len(ends)), 2):
        four = ends[[i, j]].reshape(4, 3)
        normal = np.linalg.svd(four - four.mean(axis=0))[2][2]
        height = float(four.mean(axis=0) @ normal)
        off = np.sqrt((((ends @ normal) - height) ** 2).mean(axis=1))
        score = float(np.median(off))
        if score < least and abs(height) > 1e-6:
            best, least = normal / height, score
    if best is None:
        raise MeasurementError("the laser lines lie in no plane before the camera")
    return best


def _require_two(usable: dict[int, LinePoints], faults: dict[int, str]) -> None:
    if len(usable) < 2:
        reasons = "; ".join(sorted(set(faults.values())))
        raise MeasurementError(
            f"the laser's plane needs its line on two boards, usable {len(usable)}"
            + (f" ({reasons})" if reasons else "")
        )


def _require_sure(q: Floats, root: Floats) -> None:
    """Refuse a plane whose normal is known to no better than MOST_TILT_DEG."""
    length = np.linalg.norm(q)
    unit = q / length
    turning = (np.eye(3) - np.outer(unit, unit)) @ root / length
    if not np.linalg.norm(turning, 2) <= np.radians(MOST_TILT_DEG):
        raise undetermined()
