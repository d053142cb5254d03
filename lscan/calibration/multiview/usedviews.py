"""Camera and poses from the views of a board, and which of the views they rest on."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lscan.calibration.multiview.squareness import oblong_pixels
from lscan.calibration.multiview.views import CalibrationView, FittedView
from lscan.calibration.readings import found_on
from lscan.camera.posedboards import COUNT, CameraPriors, PosedBoards
from lscan.camera.resection import (
    MEDIAN,
    BoardMarks,
    CameraFit,
    best_start,
    chi_square,
    fit_boards,
    sound_marks,
    with_covariance,
)
from lscan.config.rig import OpticsSection
from lscan.errors import MeasurementError
from lscan.records import select

FEWEST_VIEWS = 3  # Zhang 2000, Sec. 3.1: two give a camera without skew, a third checks it
FEWEST_MARKS = 6  # of a view; its pose needs four
WRONG_VIEW = 4.0  # times the median over the views of each one's median residual
DOUBTFUL_VIEW = 2.0  # times the median over the views of each one's rms, from which it is named
MOST_WRONG = 0.25  # of a view's marks; beyond it the view is an outlier
LEAST_FOCAL = 0.05  # relative uncertainty of the focal length beyond which it is not known
ROUNDS = 10
TOLERANCE = 1e-12  # relative change of the sum of squares
SETTLED = 1e-3  # relative change of chi squared
MOST_NAMED = 12  # views that a message names
TILTED = "hold it at different tilts, 20 to 45 deg, to different sides"


class UnsolvedViews(MeasurementError):
    """Views that give no calibration.

    Attributes
    ----------
    views : tuple of FittedView, as far as it is known what is wrong with each
    """

    def __init__(self, message: str, views: Sequence[FittedView]) -> None:
        """Add to the message what is wrong with each view.

        Parameters
        ----------
        message : str, why there is no calibration
        views : sequence of FittedView, all of them
        """
        named = [f"{view.name}: {view.reason}" for view in views if view.reason]
        rest = [f"{len(named) - MOST_NAMED} more"] if len(named) > MOST_NAMED else []
        listed = "; ".join([*named[:MOST_NAMED], *rest])
        super().__init__(f"{message} ({listed})" if listed else message)
        self.views = tuple(views)


@dataclass(frozen=True)
class UsedViews:
    """The solution from those views that are no outliers.

    Attributes
    ----------
    fit : CameraFit, camera and poses
    numbers : tuple of int, of the views used
    faults : dict of str, by number, why others are not among them
    """

    fit: CameraFit
    numbers: tuple[int, ...]
    faults: dict[int, str]


def fit_views(
    views: Sequence[CalibrationView],
    optics: OpticsSection,
    priors: CameraPriors,
    image_size: tuple[int, int],
) -> UsedViews:
    """Camera and poses from all views but outliers.

    The worst view is left out, one at a time, while its residuals are WRONG_VIEW times as large
    as the median view's; within views, single marks that are outliers (fit.sound_marks).

    Parameters
    ----------
    views : sequence of CalibrationView, px and mm
    optics : OpticsSection, its port counts
    priors : CameraPriors, what is known of the camera beforehand
    image_size : tuple of int, (width, height) of the pictures, px

    Raises
    ------
    UnsolvedViews
        Where fewer than three views are usable, no camera explains them, their poses do not
        determine the focal length, or the pixels are not square.

    References
    ----------
    Z. Zhang, "A flexible new technique for camera calibration", IEEE PAMI 22 (2000).
    """
    faults = {number: reason for number, view in enumerate(views) if (reason := _unusable(view))}
    numbers = [number for number in range(len(views)) if number not in faults]
    while True:
        if len(numbers) < FEWEST_VIEWS:
            wanted = f"{FEWEST_VIEWS} views of the board, usable {len(numbers)}"
            raise UnsolvedViews(f"the metric route needs {wanted}", _unfitted(views, faults))
        found = [seen for number in numbers if (seen := views[number].marks) is not None]
        marks = found_on(found, range(len(numbers)))
        start = best_start(marks, priors, optics.port, image_size[0])
        if start is None:
            message = "no camera explains the views of the board"
            raise UnsolvedViews(message, _unfitted(views, faults))
        fit = _fit(start, marks, priors)
        wrong = _worst_view(fit, marks)
        if wrong is None:
            break
        index, faults[numbers[index]] = wrong
        del numbers[index]
    used = UsedViews(fit, tuple(numbers), faults)
    message = oblong_pixels(fit, image_size, marks.sigma_px) or _open_focal(fit, priors)
    if message:
        raise UnsolvedViews(message, fitted_views(views, used))
    return used


def fitted_views(views: Sequence[CalibrationView], used: UsedViews) -> list[FittedView]:
    """What became of each view's marks.

    A view whose marks lie DOUBTFUL_VIEW times as far off as those of the median view, and farther
    than they say of themselves, counts, and says so in its reason: the board moved, or it bends.

    Parameters
    ----------
    views : sequence of CalibrationView, as ``fit_views`` took them
    used : UsedViews, as it gave them
    """
    fit = used.fit
    miss = fit.marks.missed_px(fit.boards)
    fitted = _unfitted(views, used.faults)
    for board, number in enumerate(used.numbers):
        mine = (fit.marks.board == board) & fit.good
        fitted[number] = replace(
            fitted[number],
            used=True,
            marks_used=int(mine.sum()),
            rms_px=float(np.sqrt((miss[mine] ** 2).sum(axis=1).mean())),
            reason=views[number].fault,
        )
    usual = float(np.median([fitted[number].rms_px for number in used.numbers]))
    for number in used.numbers:
        view = fitted[number]
        assert view.marks is not None  # it is used
        stated = np.sqrt(2) * float(np.median(view.marks.sigma_px[view.marks.found]))
        if view.rms_px > DOUBTFUL_VIEW * max(usual, stated) and not view.reason:
            ratio = view.rms_px / usual
            reason = f"its marks lie {view.rms_px:.2f} px rms off, {ratio:.1f} times the usual"
            fitted[number] = replace(view, reason=reason)
    return fitted


def _unfitted(views: Sequence[CalibrationView], faults: dict[int, str]) -> list[FittedView]:
    """The views as read, with the faults of some by number."""
    return [
        FittedView(view.name, view.marks, view.line, view.fault, reason=faults.get(number, ""))
        for number, view in enumerate(views)
    ]


def _fit(start: PosedBoards, marks: BoardMarks, priors: CameraPriors) -> CameraFit:
    """The fit to the sound marks, with the marks' uncertainties as it shows them.

    What is left beyond the marks' own uncertainties (compression, an uneven board) is taken to
    displace all marks alike, and is added to each one's: a few marks of little noise must not
    decide alone.
    """
    good = np.ones(len(marks.board), dtype=bool)
    own = marks.sigma_px
    boards = fit_boards(start, marks, priors, TOLERANCE)
    chi = chi_square(boards, marks, priors)
    free = int(priors.free.sum()) + len(boards.theta) - COUNT
    for _ in range(ROUNDS):
        miss = marks.missed_px(boards)[good]
        excess = (miss**2).sum() / max(miss.size - free, 1) - np.mean(own[good] ** 2)
        marks = replace(marks, sigma_px=np.hypot(own, np.sqrt(max(0.0, excess))))
        before, good = good, sound_marks(marks.lengths(boards))
        boards = fit_boards(boards, select(marks, good), priors, TOLERANCE)
        chi_before, chi = chi, chi_square(boards, select(marks, good), priors)
        if np.isclose(chi, chi_before, rtol=SETTLED) and (good == before).all():
            break
    return with_covariance(boards, marks, priors, good)


def _unusable(view: CalibrationView) -> str:
    """Why a view has no marks to use; "" where it has."""
    if view.marks is None:
        return view.fault or "the board was not found"
    if view.marks_found < FEWEST_MARKS:
        return f"only {view.marks_found} marks found, {FEWEST_MARKS} are needed"
    places = view.marks.board_mm[view.marks.found]
    if np.linalg.matrix_rank(places - places.mean(axis=0)) < 2:
        return f"the {view.marks_found} marks found lie in one line of the board"
    return ""


def _worst_view(fit: CameraFit, marks: BoardMarks) -> tuple[int, str] | None:
    """The index and the fault of the view that disagrees most with the others, if one does.

    marks: as read, with the uncertainties that they state of themselves.
    """
    lengths = np.hypot(*fit.marks.missed_px(fit.boards).T)
    each = [fit.marks.board == index for index in range(int(marks.board.max()) + 1)]
    rms = np.array([np.sqrt(np.mean(lengths[mask] ** 2)) for mask in each])
    level = np.array([np.median(lengths[mask]) for mask in each])
    lost = np.array([np.mean(~fit.good[mask]) for mask in each])
    worst = int(level.argmax())
    usual = max(float(np.median(level)), MEDIAN * float(np.median(marks.sigma_px)))
    if level[worst] > WRONG_VIEW * usual:
        return worst, f"its marks lie {rms[worst]:.2f} px rms off what the other views say"
    worst = int(lost.argmax())
    if lost[worst] > MOST_WRONG:
        return worst, f"{100 * lost[worst]:.0f} % of its marks do not fit the board"
    return None


def _open_focal(fit: CameraFit, priors: CameraPriors) -> str:
    """What is wrong with poses that leave the focal length open, or "".

    Boards that all face the camera do.
    """
    if priors.sigma[0] == 0:
        return ""
    focal, sigma = float(fit.boards.theta[0]), float(np.linalg.norm(fit.root[0]))
    if sigma <= LEAST_FOCAL * focal:
        return ""
    return (
        f"the views do not determine the focal length ({focal:.0f} px, standard uncertainty "
        f"{sigma:.0f} px): the board faces the camera alike in all of them; {TILTED}"
    )
