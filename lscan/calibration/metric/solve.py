"""From the views of a board to camera, laser sheet and map, and what became of each view."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from lscan.calibration.marks import found_on, region_around
from lscan.calibration.metric.planemap import Metric, SheetView, metric_map
from lscan.calibration.metric.sheet import LaserPlane, NoLaserPlane, find_plane
from lscan.calibration.metric.views import CalibrationView, FittedView, LinePoints
from lscan.calibration.planemap import with_medium
from lscan.camera.posedboards import (
    CAMERA,
    COUNT,
    GREATEST,
    LEAST,
    POSE,
    CameraPriors,
    PortKind,
    PosedBoards,
    priors_of,
)
from lscan.camera.resection import (
    MEDIAN,
    WRONG,
    BoardMarks,
    CameraFit,
    best_start,
    chi_square,
    fit_boards,
    posed_boards,
    sound_marks,
    with_covariance,
)
from lscan.config.rig import Known, LensChoice, LensKind, OpticsSection
from lscan.errors import MeasurementError
from lscan.records import Floats, select
from lscan.version import __version__

# Whether a camera's pixels are square, as the camera's model takes them to be.
#
# Pixels that are not, as of a picture squeezed to another format, make a camera of square pixels
# that fits badly and is wrong in silence: with pixels a third too wide the focal length was
# two and a half times too long.  What the marks themselves say of the pixels is seen by fitting a
# pinhole with distortion to them, once with square pixels and once with any.  A window that is
# tilted, or thicker than stated, squeezes pictures too, and more often: it is looked at first.


POOR = 1.2  # times the marks' own uncertainty, from which a misfit is looked into
BETTER = 1.1  # times less must be left with pixels of another shape
NEARLY_SQUARE = 0.005  # of a side: what a bent board may look like; costs 2 sigmas of focal length
ANY_PORT = {"gap_mm": 100.0, "thickness_mm": 100.0, "tilt_x_deg": 10.0, "tilt_y_deg": 10.0}
"""Standard uncertainties of a port of which next to nothing is known."""


def oblong_pixels(
    fit: CameraFit, priors: CameraPriors, image_size: tuple[int, int], own_px: Floats
) -> str:
    """Of what shape port or pixels are that the marks show not to be as stated; else "".

    Pixels are taken to be square, a port to be what [optics] says.

    Parameters
    ----------
    fit : CameraFit, camera and poses, with square pixels
    priors : CameraPriors, what is known of the camera beforehand
    image_size : tuple of int, (width, height) of the pictures, px
    own_px : (N,) array, px, standard uncertainty of each mark as it was read

    References
    ----------
    Z. Zhang, "A flexible new technique for camera calibration", IEEE PAMI 22 (2000).
    """
    before_px = left_px(fit)
    if before_px < POOR * float(np.median(own_px)):
        return ""
    square_px, _ = _pinhole(fit, image_size, cv2.CALIB_FIX_ASPECT_RATIO)
    shaped_px, pixel_height = _pinhole(fit, image_size, 0)
    if square_px < BETTER * shaped_px or abs(pixel_height - 1) < NEARLY_SQUARE:
        return ""
    if shaped_px > np.sqrt(2) * MISFIT * float(np.median(own_px)) and square_px < 2 * shaped_px:
        return ""  # which leaves most of the misfit: it has another cause
    if fit.boards.port == "flat":
        boards, square_px = _any_port(fit, priors, 1.0)
        shaped_px = _any_port(fit, priors, pixel_height)[1]
        if square_px < BETTER * shaped_px:
            if before_px < BETTER * square_px:
                return ""
            theta = dict(zip(CAMERA, boards.theta, strict=False))
            port = ", ".join(f"{name} = {theta[name]:.3g}" for name in ANY_PORT)
            return (
                f"the port is not as [optics] states it: the marks fit to {before_px:.2f} px rms, "
                f"and to {square_px:.2f} px with about {port}; measure it, and state what you find "
                "with its uncertainty"
            )
    width, height = image_size
    return (
        f"the camera's pixels are not square: {pixel_height:.4f} times as high as wide, the marks "
        f"fit to {shaped_px:.2f} px rms, as squares to {square_px:.2f} px; use a format of "
        f"the camera that does not squeeze its pictures, or scale them all to {width} x "
        f"{round(height * pixel_height)} px"
    )


def _any_port(
    fit: CameraFit, priors: CameraPriors, pixel_height: float
) -> tuple[PosedBoards, float]:
    """Boards and camera behind any port, its pixels so many times as high as wide; px rms left."""
    sigma, theta = priors.sigma.copy(), fit.boards.theta.copy()
    for name, least in ANY_PORT.items():
        sigma[CAMERA.index(name)] = max(least, sigma[CAMERA.index(name)])
    theta[CAMERA.index("centre_v_px")] *= pixel_height
    theta[COUNT + POSE.index("seen_v_px") :: len(POSE)] *= pixel_height
    marks = replace(fit.marks, image_px=fit.marks.image_px * [1.0, pixel_height])
    start, freed = replace(fit.boards, theta=theta), replace(priors, sigma=sigma)
    boards = fit_boards(start, select(marks, fit.good), freed, TOLERANCE)
    return boards, left_px(replace(fit, boards=boards, marks=marks))


def left_px(fit: CameraFit) -> float:
    """Px rms, of u and of v, by which a fit misses the marks it rests on.

    Parameters
    ----------
    fit : CameraFit, camera and poses
    """
    return float(np.sqrt(np.mean(fit.marks.missed_px(fit.boards)[fit.good] ** 2)))


def _pinhole(fit: CameraFit, image_size: tuple[int, int], flags: int) -> tuple[float, float]:
    """Px rms that a pinhole with distortion leaves of the marks; a pixel's height over width."""
    marks, boards = fit.marks, np.unique(fit.marks.board)
    each = [fit.good & (marks.board == board) for board in boards]
    on_board = np.column_stack([marks.board_mm, np.zeros(len(marks.board_mm))]).astype(np.float32)
    try:
        rms, camera, *_ = cv2.calibrateCamera(
            [on_board[used] for used in each],
            [marks.image_px[used].astype(np.float32) for used in each],
            image_size,
            np.eye(3),
            np.zeros(5),
            flags=flags | cv2.CALIB_FIX_K3,
        )
    except cv2.error:  # poses that give it no start
        return np.inf, 1.0
    return float(rms), float(camera[0, 0] / camera[1, 1])


# Camera and poses from the views of a board, and which of the views they rest on.


FEWEST_VIEWS = 3  # Zhang 2000, Sec. 3.1: two give a camera without skew, a third checks it
FEWEST_MARKS = 6  # of a view; its pose needs four
WRONG_VIEW = 4.0  # times the median over the views of each one's median residual
DOUBTFUL_VIEW = 2.0  # times the median over the views of each one's rms, from which it is named
MISFIT = (
    2.0  # times the marks' own uncertainty; noise, print and unevenness, each as large, make 1.7
)
COMMON = 1.1  # times it: of 400 marks noise alone makes 1.03, and the bend of each view 0.05 more
MOST_LEFT_PX = 1.0  # rms: no mark that is read at all is read a pixel off as a rule
STARTS = [CAMERA.index(name) for name in ("thickness_mm", "tilt_x_deg", "tilt_y_deg", "gap_mm")]
APART = 1.0  # sigma from what is known, where other searches start
MOST_WRONG = 0.25  # of a view's marks; beyond it the view is an outlier
LEAST_FOCAL = 0.05  # relative uncertainty of the focal length beyond which it is not known
MOST_BENT = 0.01  # of a board's half diagonal: how far the bend, which is found, may lift its rim
ROUNDS = 10
TOLERANCE = 1e-12  # relative change of the sum of squares
SETTLED = 1e-3  # relative change of chi squared
MOST_NAMED = 12  # views that a message names
NO_MODEL = (
    'the lens is none that its model describes (lens = "brown", "rational" or "fisheye" is), '
    "the port is not as [optics] says, or the board not as the file says"
)
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
        determine the focal length, the pixels are not square, or the marks lie pixels off.

    References
    ----------
    Z. Zhang, "A flexible new technique for camera calibration", IEEE PAMI 22 (2000).
    """
    faults = {number: reason for number, view in enumerate(views) if (reason := _unusable(view))}
    numbers = [number for number in range(len(views)) if number not in faults]
    while True:
        if len(numbers) < FEWEST_VIEWS:
            wanted = f"{FEWEST_VIEWS} views of the board, usable {len(numbers)}"
            raise UnsolvedViews(
                f"the metric route needs {wanted}", _views_with_faults(views, faults)
            )
        found = [seen for number in numbers if (seen := views[number].marks) is not None]
        marks = found_on(found, range(len(numbers)))
        if (fit := _best_fit(marks, priors, optics.port, image_size[0])) is None:
            message = "no camera explains the views of the board"
            raise UnsolvedViews(message, _views_with_faults(views, faults))
        if (wrong := _worst_view(fit, marks)) is None:
            break
        index, faults[numbers[index]] = wrong
        del numbers[index]
    used = UsedViews(fit, tuple(numbers), faults)
    message = oblong_pixels(fit, priors, image_size, marks.sigma_px)
    message = message or _unexplained(fit, marks.sigma_px)
    message = message or _open_focal(fit, priors, marks.sigma_px)
    if message:
        raise UnsolvedViews(message, fitted_views(views, used))
    return used


# Which model of a lens, where the file leaves it open: what best predicts views held out of it.


LENSES: tuple[LensKind, ...] = ("brown", "fisheye", "rational")  # in the order of preference
FOLDS = 4  # parts into which the views are cut, each predicted by the others
BETTER_LENS = 1.02  # times less a later one must leave of the views held out


def fit_lens(
    views: Sequence[CalibrationView],
    optics: OpticsSection,
    image_size: tuple[int, int],
    k3: Known,
    lens: LensChoice,
) -> tuple[UsedViews, LensKind]:
    """Camera and poses, and the model of the lens, chosen where it is left open.

    Brown's model stays where it leaves of the marks what they state of themselves; and behind a
    flat port, which bends rays as a wider lens does.  Else each model is fitted to three quarters
    of the views in turn, and that is taken which then misses the marks of the rest least, the
    boards' poses apart.

    Parameters
    ----------
    views : sequence of CalibrationView, px and mm
    optics : OpticsSection, what is known of the camera beforehand
    image_size : tuple of int, (width, height) of the pictures, px
    k3 : tuple of float, third radial coefficient and its standard uncertainty
    lens : str, a LensKind, or "auto"

    Raises
    ------
    UnsolvedViews
        As ``fit_views``; where all models fail, as Brown's does.
    """
    if lens == "auto" and optics.port == "flat":
        lens = "brown"
    fits: dict[LensKind, UsedViews] = {}
    failed: UnsolvedViews | None = None
    # Of focal length and centre nothing is assumed: several poses determine them.
    priors = {
        kind: priors_of(optics, image_size, k3, assume_webcam=False, lens=kind)
        for kind in LENSES
        if lens in (kind, "auto")
    }
    for kind, of_lens in priors.items():
        try:
            fits[kind] = fit_views(views, optics, of_lens, image_size)
        except UnsolvedViews as error:
            failed = failed or error
        else:
            if kind == lens or (kind == "brown" and not _is_missed(fits[kind], views)):
                return fits[kind], kind
    if not fits:
        assert failed is not None
        raise failed
    numbers = sorted({number for used in fits.values() for number in used.numbers})
    found = [seen for number in numbers if (seen := views[number].marks) is not None]
    marks = found_on(found, range(len(numbers)))
    left = {kind: _held_out_px(fits[kind].fit.boards, marks, priors[kind]) for kind in fits}
    chosen = next(kind for kind in fits if left[kind] <= BETTER_LENS * min(left.values()))
    return fits[chosen], chosen


def _is_missed(used: UsedViews, views: Sequence[CalibrationView]) -> bool:
    """Whether the marks lie farther off than they state of themselves."""
    seen = [marks for number in used.numbers if (marks := views[number].marks) is not None]
    own = np.concatenate([marks.sigma_px[marks.found] for marks in seen])
    return left_px(used.fit) > COMMON * float(np.median(own))


def _held_out_px(start: PosedBoards, marks: BoardMarks, priors: CameraPriors) -> float:
    """Px rms by which cameras miss the boards' marks that were fitted to other boards alone."""
    boards = np.unique(marks.board)
    held = replace(priors, sigma=np.zeros(COUNT))
    missed = []
    for fold in range(min(FOLDS, len(boards))):
        apart = boards[fold::FOLDS]
        known, rest = (
            _renumbered(select(marks, np.isin(marks.board, apart, invert=way)))
            for way in (True, False)
        )
        posed = posed_boards(start.theta, start.port, known)
        if posed is None:
            return np.inf
        theta = fit_boards(posed, known, priors, TOLERANCE).theta[:COUNT]
        if (posed := posed_boards(theta, start.port, rest)) is None:
            return np.inf
        seen = fit_boards(posed, rest, replace(held, mean=theta), TOLERANCE)
        missed.append(np.hypot(*rest.missed_px(seen).T))
    return capped_rms(np.concatenate(missed))


def capped_rms(lengths: Floats) -> float:
    """Root mean square of residuals' lengths, of which none counts more than an outlier's least.

    A mark that was read wrongly then counts alike for all models of a lens, and one for which a
    model has no place at all counts against it.

    Parameters
    ----------
    lengths : (N,) array

    Examples
    --------
    >>> round(capped_rms(np.array([1.0] * 99 + [1e4])), 3)
    1.118
    """
    most = WRONG * float(np.median(lengths)) / MEDIAN
    return float(np.sqrt(np.mean(np.minimum(lengths, most) ** 2)))


def _renumbered(marks: BoardMarks) -> BoardMarks:
    """The marks, their boards counted from 0."""
    return replace(marks, board=np.unique(marks.board, return_inverse=True)[1])


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
    fitted = _views_with_faults(views, used.faults)
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


def _views_with_faults(
    views: Sequence[CalibrationView], faults: dict[int, str]
) -> list[FittedView]:
    """The views as read, with the faults of some by number."""
    return [
        FittedView(view.name, view.marks, view.line, view.fault, reason=faults.get(number, ""))
        for number, view in enumerate(views)
    ]


def _best_fit(
    marks: BoardMarks, priors: CameraPriors, port: PortKind, width: int
) -> CameraFit | None:
    """The fit, from other starts too where it misses the marks; None where there is none.

    A thick slab in front of the camera, tilted, has several minima.  Of the starts on either side
    of what is known of the port, the one counts that leaves the least of the marks.
    """
    half_mm = float(np.linalg.norm(np.ptp(marks.board_mm, axis=0))) / 2
    bent = replace(priors, bend_per_mm=MOST_BENT / half_mm)
    own_px, best = float(np.median(marks.sigma_px)), None
    steps = [np.zeros(COUNT)]
    steps += [way * APART * np.eye(COUNT)[k] for k in STARTS if priors.sigma[k] for way in (1, -1)]
    for step in steps:
        mean = np.clip(priors.mean + step * np.where(step, priors.sigma, 0.0), LEAST, GREATEST)
        start = best_start(marks, replace(priors, mean=mean), port, width)
        fit = None if start is None else _fit(start, marks, bent)
        if fit is not None and (best is None or left_px(fit) < left_px(best)):
            best = fit
        if best is not None and left_px(best) < POOR * own_px:
            break
    return best


def _fit(start: PosedBoards, marks: BoardMarks, priors: CameraPriors) -> CameraFit:
    """The fit to the sound marks, with the marks' uncertainties as it shows them.

    What is left beyond the marks' own uncertainties (compression, an uneven board) is taken to
    displace all marks alike, and is added to each one's: a few marks of little noise must not
    decide alone.  Beyond COMMON times those it is the lens's, or the port's, and the same in all
    views.
    """
    good = np.ones(len(marks.board), dtype=bool)
    own = marks.sigma_px
    boards = fit_boards(start, marks, priors, TOLERANCE)
    chi = chi_square(boards, marks, priors)
    free = int(priors.free.sum()) + len(boards.theta) - COUNT + len(boards.bend_per_mm)
    for _ in range(ROUNDS):
        miss = marks.missed_px(boards)[good]
        excess = (miss**2).sum() / max(miss.size - free, 1) - np.mean(own[good] ** 2)
        marks = replace(marks, sigma_px=np.hypot(own, np.sqrt(max(0.0, excess))))
        before, good = good, sound_marks(marks.lengths(boards))
        boards = fit_boards(boards, select(marks, good), priors, TOLERANCE)
        chi_before, chi = chi, chi_square(boards, select(marks, good), priors)
        if np.isclose(chi, chi_before, rtol=SETTLED) and (good == before).all():
            break
    left = float(np.sqrt(np.mean(marks.missed_px(boards)[good] ** 2)))
    return with_covariance(boards, marks, priors, good, left > COMMON * float(np.median(own)))


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


def _unexplained(fit: CameraFit, own_px: Floats) -> str:
    """What is wrong with marks that lie pixels off, or ""."""
    left, own = np.sqrt(2) * left_px(fit), np.sqrt(2) * float(np.median(own_px))
    if left <= (most := max(MOST_LEFT_PX, MISFIT * own)):
        return ""
    return (
        f"the marks lie {left:.1f} px rms off where the camera that fits best sees them, "
        f"allowed is {most:.1f} px; {NO_MODEL}"
    )


def _open_focal(fit: CameraFit, priors: CameraPriors, own_px: Floats) -> str:
    """What is wrong with views that leave the focal length open, or "".

    Boards that all face the camera do, and a lens that the model does not describe.
    """
    if priors.sigma[0] == 0:
        return ""
    focal, sigma = float(fit.boards.theta[0]), float(np.linalg.norm(fit.root[0]))
    if sigma <= LEAST_FOCAL * focal:
        return ""
    misfit = left_px(fit) > MISFIT * float(np.median(own_px))
    why = NO_MODEL if misfit else f"the board faces the camera alike in all of them; {TILTED}"
    return (
        f"the views do not determine the focal length ({focal:.0f} px, standard uncertainty "
        f"{sigma:.0f} px): {why}"
    )


# From the views of a board to camera, laser sheet and map, and what became of each view.


FARTHER = 2.0  # times than the lines: the origin's uncertainty goes with the square of its distance


@dataclass(frozen=True)
class SolvedViews:
    """The views of a board that something was solved from, and what is known of the camera.

    Attributes
    ----------
    views : tuple of FittedView, as read, and what became of each
    optics : OpticsSection, what was known of the camera
    k3 : tuple of float, third radial coefficient and its standard uncertainty beforehand
    lens : str, the model of the lens, as it was stated or chosen
    image_size : tuple of int, (width, height) of the pictures, px
    sigma : (18,) array, standard uncertainties of the camera (parameters.CAMERA), 0 of what was
        held
    software : str, name and version of the program that solved it
    """

    views: tuple[FittedView, ...]
    optics: OpticsSection
    k3: Known
    lens: LensKind
    image_size: tuple[int, int]
    sigma: Floats
    software: str

    @property
    def rms_px(self) -> float:
        """Root mean square length of the used marks' residuals in all used views."""
        return _pooled_rms([(view.rms_px, view.marks_used) for view in self.views if view.used])

    @property
    def misfit(self) -> str:
        """A warning where the marks lie farther off than they state of themselves; else ""."""
        seen = [view.marks for view in self.views if view.used and view.marks is not None]
        own = float(np.median(np.concatenate([marks.sigma_px[marks.found] for marks in seen])))
        times = self.rms_px / np.sqrt(2) / own
        if times <= MISFIT:
            return ""
        return f"the marks lie {times:.1f} times as far off as they state of themselves: {NO_MODEL}"


@dataclass(frozen=True)
class CameraCalibration(SolvedViews):
    """A camera alone, and what it rests on.

    Attributes
    ----------
    theta : (18,) array, the camera (parameters.CAMERA)
    """

    theta: Floats

    def boards_beside(self, views: Sequence[CalibrationView]) -> list[CalibrationView]:
        """The used boards, for another calibration to rest on as well, but those it has itself.

        The same picture counts once: twice, it would halve its variance.

        Parameters
        ----------
        views : sequence of CalibrationView, of the other calibration
        """
        seen = {_place(view) for view in views}
        used = [CalibrationView(view.name, view.marks) for view in self.views if view.used]
        return [board for board in used if _place(board) not in seen]


@dataclass(frozen=True)
class MetricCalibration(SolvedViews):
    """A metric map and what it rests on.

    Attributes
    ----------
    plane_map : Metric, from the pixels of that camera to the laser sheet
    """

    plane_map: Metric

    @property
    def theta(self) -> Floats:
        """(18,) the camera (parameters.CAMERA)."""
        return self.plane_map.view.theta

    @property
    def line_rms_mm(self) -> float:
        """Root mean square distance of the used line points from the sheet."""
        lines = [view for view in self.views if view.line_used]
        return _pooled_rms([(view.line_rms_mm, view.line_points_used) for view in lines])


def _place(view: CalibrationView) -> bytes:
    """Where the marks are, to the last bit: no two pictures show them alike."""
    return b"" if view.marks is None else view.marks.image_px[view.marks.found].tobytes()


def calibrate_camera(
    views: Sequence[CalibrationView],
    optics: OpticsSection,
    image_size: tuple[int, int],
    k3: Known = (0.0, 0.0),
    lens: LensChoice = "auto",
) -> CameraCalibration:
    """The camera alone from views of a board in several poses; a laser line is not needed.

    Parameters
    ----------
    views : sequence of CalibrationView, px and mm, three usable ones or more
    optics : OpticsSection, what is known of the camera beforehand
    image_size : tuple of int, (width, height) of the pictures, px
    k3 : tuple of float, third radial coefficient and its standard uncertainty; held at 0 by default
    lens : str, "brown", "rational", "fisheye", or "auto": chosen by views held out

    Raises
    ------
    InputError
        For what is known of the camera out of its range.
    UnsolvedViews
        Where fewer than three views are usable, or where their poses do not determine the focal
        length.
    """
    views = [
        view if view.marks is None else CalibrationView(view.name, view.marks) for view in views
    ]
    used, kind = fit_lens(views, optics, image_size, k3, lens)
    solved = _solved_fields(used, fitted_views(views, used), optics, image_size, k3, kind)
    return CameraCalibration(theta=used.fit.boards.theta[:COUNT], **solved)


def calibrate_metric(
    views: Sequence[CalibrationView],
    optics: OpticsSection,
    image_size: tuple[int, int],
    k3: Known = (0.0, 0.0),
    lens: LensChoice = "auto",
) -> MetricCalibration:
    """The camera, the laser's sheet and the map from views of a board in several poses.

    A view, or its line, that disagrees with the others is left out, with the reason.

    Parameters
    ----------
    views : sequence of CalibrationView, px and mm, three usable ones or more
    optics : OpticsSection, what is known of the camera beforehand
    image_size : tuple of int, (width, height) of the pictures, px
    k3 : tuple of float, third radial coefficient and its standard uncertainty; held at 0 by default
    lens : str, "brown", "rational", "fisheye", or "auto": chosen by views held out

    Raises
    ------
    InputError
        For what is known of the camera out of its range.
    UnsolvedViews
        Where fewer than three views are usable, where their poses do not determine the focal
        length, where too few of the lines agree on one plane, or where they do not determine it.

    References
    ----------
    Z. Zhang, "A flexible new technique for camera calibration", IEEE PAMI 22 (2000).
    """
    used, kind = fit_lens(views, optics, image_size, k3, lens)
    fitted = fitted_views(views, used)
    lines = {
        board: line
        for board, number in enumerate(used.numbers)
        if (line := views[number].line) is not None
    }
    try:
        free = priors_of(optics, image_size, k3, assume_webcam=False, lens=kind).free
        plane = find_plane(used.fit, free, lines)
    except MeasurementError as error:
        faults = error.faults if isinstance(error, NoLaserPlane) else {}
        for board, fault in faults.items():
            number = used.numbers[board]
            fitted[number] = _with_reason(fitted[number], fault)
        raise UnsolvedViews(str(error), fitted) from error
    for board in lines:
        number = used.numbers[board]
        fitted[number] = _with_line(fitted[number], board, plane)
    plane_map = _map_of(used, lines, plane, optics, image_size)
    solved = _solved_fields(used, fitted, optics, image_size, k3, kind)
    return MetricCalibration(plane_map=plane_map, **solved)


def _solved_fields(
    used: UsedViews,
    views: Sequence[FittedView],
    optics: OpticsSection,
    image_size: tuple[int, int],
    k3: Known,
    lens: LensKind,
) -> dict[str, Any]:
    """The fields of a SolvedViews."""
    return {
        "views": tuple(views),
        "optics": optics,
        "k3": k3,
        "lens": lens,
        "image_size": image_size,
        "sigma": np.linalg.norm(used.fit.root[:COUNT], axis=1),
        "software": f"lscan {__version__}",
    }


def _map_of(
    used: UsedViews,
    lines: dict[int, LinePoints],
    plane: LaserPlane,
    optics: OpticsSection,
    image_size: tuple[int, int],
) -> Metric:
    """The map, which holds about the marks and the line points that were used."""
    marks = used.fit.marks.image_px[used.fit.good]
    on_lines = [line.image_px[plane.good[board]] for board, line in lines.items()]
    middle = (np.array(image_size, dtype=float) - 1) / 2
    view = SheetView(used.fit.boards.theta[:COUNT], optics.port, plane.q_per_mm, middle)
    view = replace(view, origin_px=_origin_px(view, np.vstack(on_lines)))
    # All distances go with the scale of the boards.
    by_scale = np.append(np.zeros(COUNT), plane.q_per_mm * optics.board_scale_percent / 100)
    root = np.column_stack([plane.root, by_scale])
    solved = metric_map(view, root, region_around(np.vstack([marks, *on_lines])))
    return with_medium(solved, optics)


def _origin_px(view: SheetView, lines_px: Floats) -> Floats:
    """(2,) px that sees the origin: the picture's middle, or where that is no use, of the lines.

    Where the sheet is seen almost edge on, the ray of the picture's middle meets it far behind all
    boards, or nowhere, and the whole frame would be as uncertain as that place.
    """
    depth = view.meet(lines_px)[:, 2]
    middle = view.meet(view.origin_px[None])[0, 2]
    if depth.min() / FARTHER <= middle <= depth.max() * FARTHER:
        return view.origin_px
    return np.asarray(lines_px.mean(axis=0))


def _with_line(view: FittedView, board: int, plane: LaserPlane) -> FittedView:
    """The view with what became of its line."""
    good, far = plane.good[board], plane.distances_mm[board]
    shown = far[good] if good.any() else far[np.isfinite(far)]
    fault = plane.faults.get(board, "")
    line_rms_mm = float(np.sqrt(np.mean(shown**2))) if len(shown) else np.nan
    fitted = replace(
        view, line_used=not fault, line_points_used=int(good.sum()), line_rms_mm=line_rms_mm
    )
    return _with_reason(fitted, fault)


def _with_reason(view: FittedView, fault: str) -> FittedView:
    """The view with another fault beside those it has."""
    return replace(view, reason="; ".join(filter(None, (view.reason, fault))))


def _pooled_rms(parts: list[tuple[float, int]]) -> float:
    """Root mean square of parts of a root mean square and a count each."""
    rms, count = np.array(parts).T
    return float(np.sqrt((rms**2 * count).sum() / count.sum()))
