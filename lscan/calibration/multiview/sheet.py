"""The laser's plane from the line seen on boards whose poses are known.

Each line point is the place where its pixel's ray meets the board.  A plane cuts a board in a
straight line, so that a view gives two numbers: how far its line lies off
the sheet, and how it leans against it.  Errors of the board's pose and of the camera, which
all points of a view share, are counted with those two numbers, not with each point.

The plane that the most lines agree on (consensus.py) is the start.  From it on, lines are
judged by their own uncertainties, and by how well those hold among the lines that agree.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lscan.calibration.multiview.consensus import FEWEST_AGREEING, Agreement, agreed_plane
from lscan.calibration.multiview.equations import PlaneEquations, undetermined
from lscan.calibration.multiview.lines import FEWEST_POINTS, distance_mm, line_ends, straight
from lscan.calibration.multiview.views import LinePoints
from lscan.camera.posedboards import PosedBoards
from lscan.camera.resection import CameraFit
from lscan.errors import MeasurementError
from lscan.records import Floats, Mask, select

WRONG = 6.0  # sigmas: beyond them a view's line is an outlier
MEDIAN_CHI_SQUARE = 2 * np.log(2)  # of two degrees of freedom
MOST_USUAL = 10.0  # sigmas, the usual size beyond which lines do not lie in one plane at all
BY_CHANCE = 1e-3  # agreements as good among lines at random, above which lines do not agree
ROUNDS = 20  # of deciding which lines agree; two or three suffice
LEAST_ANGLE_DEG = 10.0  # between board and sheet; the line's place on the board is unsure below
MOST_TILT_DEG = 1.0  # standard uncertainty of the sheet's tilt beyond which it is not known
TOO_FEW_LINES = "the laser's plane needs its line on two boards, usable {}"
TOO_FEW_AGREE = "too few of the {} laser lines agree on one plane"
TOO_FAR = "the laser lines lie {:.0f} times as far off one plane as their uncertainties allow"


class NoLaserPlane(MeasurementError):
    """Lines that give no plane.

    Attributes
    ----------
    faults : dict of str, by board, what is wrong with a line, as far as that is known
    """

    def __init__(self, message: str, faults: Mapping[int, str]) -> None:
        """Take the message without the faults, which name boards by number.

        Parameters
        ----------
        message : str, why there is no plane
        faults : mapping of int to str, by board
        """
        super().__init__(message)
        self.faults = dict(faults)


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

    Half of the lines and more may be wrong: at least three, or both of two, must agree.  A view is
    an outlier where its two numbers lie more than WRONG standard uncertainties (or of
    their usual size, where all that agree are larger) from the plane of those that agree.  The
    covariance is scaled up by chi squared per degree of freedom of those two numbers where above 1.

    Parameters
    ----------
    fit : CameraFit, camera and poses
    free : (14,) mask, of the camera's parameters that were found
    lines : dict of LinePoints, px, by number of the board

    Raises
    ------
    NoLaserPlane
        Where fewer than two lines are left, where too few of them agree on a plane, or where they
        do not determine it: all in one line, or on boards nearly parallel to the sheet.
    """
    boards = fit.boards
    masks = {board: straight(boards, line, board) for board, line in lines.items()}
    faults = {
        board: f"only {int(mask.sum())} points of the line lie in one line"
        for board, mask in masks.items()
        if mask.sum() < FEWEST_POINTS
    }
    usable = {board: select(lines[board], masks[board]) for board in lines if board not in faults}
    start = _start(boards, usable, faults)
    agreeing = dict(zip(usable, start.agree, strict=True))
    faults |= _near_the_sheet(boards, usable, start.q_per_mm)
    usable = {board: line for board, line in usable.items() if board not in faults}
    agree = np.array([agreeing[board] for board in usable])
    _require_agreement(agree, faults)
    equations = PlaneEquations(fit, free, usable)
    found = _gated(equations, start.q_per_mm, agree)
    faults |= _off_the_sheet(boards, usable, found)
    _require_agreement(found.agree, faults, found.usual)
    own = equations.own_root(found.q_per_mm, found.takes)
    own = own * np.sqrt(max(1.0, found.chi_per_freedom))
    _require_sure(found.q_per_mm, own)
    return LaserPlane(
        q_per_mm=found.q_per_mm,
        root=equations.joint_root(found.q_per_mm, found.takes, own),
        good={board: mask & (board not in faults) for board, mask in masks.items()},
        faults=faults,
        distances_mm={
            board: distance_mm(boards.on_board(line.image_px, board), found.q_per_mm)
            for board, line in lines.items()
        },
    )


def _start(boards: PosedBoards, lines: dict[int, LinePoints], faults: dict[int, str]) -> Agreement:
    """The plane that the most lines agree on; NoLaserPlane where they might by chance."""
    if len(lines) < 2:
        raise NoLaserPlane(TOO_FEW_LINES.format(len(lines)), faults)
    ends = np.stack(
        [line_ends(boards.on_board(line.image_px, board)) for board, line in lines.items()]
    )
    start = agreed_plane(ends)
    if len(lines) >= FEWEST_AGREEING and start.by_chance > BY_CHANCE:
        off = {
            board: f"its line lies {mm:.1f} mm off the plane that the most lie near to"
            for board, mm in zip(lines, start.off_mm, strict=True)
        }
        raise NoLaserPlane(TOO_FEW_AGREE.format(len(lines)), faults | off)
    return start


def _near_the_sheet(boards: PosedBoards, lines: dict[int, LinePoints], q: Floats) -> dict[int, str]:
    """The faults of the boards that lie nearly in the plane q . X = 1."""
    faults = {}
    for board in lines:
        cosine = abs(boards.axes[board][:, 1] @ q) / np.linalg.norm(q)
        angle = np.degrees(np.arccos(min(cosine, 1.0)))
        if angle < LEAST_ANGLE_DEG:
            faults[board] = f"the board lies {angle:.1f} deg from the sheet: too near it"
    return faults


@dataclass(frozen=True)
class _GatedPlane:
    """A plane of least squares and the lines that it rests on.

    takes: (3, 2 V) as PlaneEquations.solve gives it.  agree: (V,) mask, of the lines.
    chi_per_freedom: of all their numbers.  usual: median of their chi squared over that of
    two numbers of unit variance, at least 1.
    """

    q_per_mm: Floats
    takes: Floats
    agree: Mask
    chi_per_freedom: float
    usual: float


def _gated(equations: PlaneEquations, q: Floats, agree: Mask) -> _GatedPlane:
    """The plane of the lines that agree with it, until they are the lines that it was solved from.

    q: (3,) 1/mm, the start.  agree: (V,) mask, of the lines that agree on it.
    """
    for _ in range(ROUNDS):
        q, takes = equations.solve(q, agree)
        per_freedom, chi = equations.chi_squares(q, takes, agree)
        usual = max(1.0, float(np.median(chi[agree])) / MEDIAN_CHI_SQUARE)
        found = _GatedPlane(q, takes, agree, per_freedom, usual)
        agree = chi <= WRONG**2 * usual
        if (agree == found.agree).all():
            break
    return found


def _off_the_sheet(
    boards: PosedBoards, lines: dict[int, LinePoints], found: _GatedPlane
) -> dict[int, str]:
    """The faults of the lines that do not agree with the plane; of all where none truly do."""
    faults = {}
    for (board, line), agrees in zip(lines.items(), found.agree, strict=True):
        if not agrees or found.usual > MOST_USUAL**2:
            off = distance_mm(boards.on_board(line.image_px, board), found.q_per_mm)
            rms = np.sqrt(np.mean(off**2))
            faults[board] = f"its line lies {rms:.3f} mm rms off the sheet of the other views"
    return faults


def _require_agreement(agree: Mask, faults: dict[int, str], usual: float = 1.0) -> None:
    """Refuse fewer than three lines, or than both of two, and lines that lie too far off.

    agree: (V,) mask, of the lines.  usual: as of _GatedPlane.
    """
    if len(agree) < 2:
        raise NoLaserPlane(TOO_FEW_LINES.format(len(agree)), faults)
    if agree.sum() < min(FEWEST_AGREEING, len(agree)):
        raise NoLaserPlane(TOO_FEW_AGREE.format(len(agree)), faults)
    if usual > MOST_USUAL**2:
        raise NoLaserPlane(TOO_FAR.format(np.sqrt(usual)), faults)


def _require_sure(q: Floats, root: Floats) -> None:
    """Refuse a plane whose normal is known to no better than MOST_TILT_DEG."""
    length = np.linalg.norm(q)
    unit = q / length
    turning = (np.eye(3) - np.outer(unit, unit)) @ root / length
    if not np.linalg.norm(turning, 2) <= np.radians(MOST_TILT_DEG):
        raise undetermined()
