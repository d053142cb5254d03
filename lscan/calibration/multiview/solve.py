"""From the views of a board to camera, laser sheet and map, and what became of each view."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lscan.calibration.multiview.planemap import Metric, SheetView, metric_map
from lscan.calibration.multiview.sheet import LaserPlane, find_plane
from lscan.calibration.multiview.views import CalibrationView, FittedView
from lscan.calibration.readings import found_on
from lscan.calibration.region import region_around
from lscan.camera.boards import PosedBoards
from lscan.camera.fit import (
    MEDIAN,
    BoardMarks,
    CameraFit,
    chi_square,
    fit_boards,
    sound_marks,
    with_covariance,
)
from lscan.camera.parameters import COUNT, CameraPriors, priors_of
from lscan.camera.start import best_start
from lscan.camera.water import stated_water
from lscan.config.rig import Known, OpticsSection
from lscan.errors import MeasurementError
from lscan.records import Floats, select
from lscan.version import __version__

FEWEST_VIEWS = 3  # Zhang 2000, Sec. 3.1: two give a camera without skew, a third checks it
FEWEST_MARKS = 6  # of a view; its pose needs four
WRONG_VIEW = 4.0  # times the median over the views of each one's median residual
MOST_WRONG = 0.25  # of a view's marks; beyond it the view is an outlier
LEAST_FOCAL = 0.05  # relative uncertainty of the focal length beyond which it is not known
ROUNDS = 10
TOLERANCE = 1e-12  # relative change of the sum of squares
SETTLED = 1e-3  # relative change of chi squared
TILTED = "hold it at different tilts, 20 to 45 deg, to different sides"


@dataclass(frozen=True)
class MetricCalibration:
    """A metric map and what it rests on.

    Attributes
    ----------
    plane_map : Metric, from the pixels of that camera to the laser sheet
    views : tuple of FittedView, as read, and what became of each
    optics : OpticsSection, what was known of the camera
    k3 : tuple of float, third radial coefficient and its standard uncertainty beforehand
    image_size : tuple of int, (width, height) of the pictures, px
    sigma : (14,) array, standard uncertainties of the camera (parameters.CAMERA), 0 of what was
        held
    software : str, name and version of the program that solved it
    """

    plane_map: Metric
    views: tuple[FittedView, ...]
    optics: OpticsSection
    k3: Known
    image_size: tuple[int, int]
    sigma: Floats
    software: str

    @property
    def rms_px(self) -> float:
        """Root mean square length of the used marks' residuals in all used views."""
        return _pooled([(view.rms_px, view.marks_used) for view in self.views if view.used])

    @property
    def line_rms_mm(self) -> float:
        """Root mean square distance of the used line points from the sheet."""
        lines = [view for view in self.views if view.line_used]
        return _pooled([(view.line_rms_mm, view.line_points_used) for view in lines])


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


def calibrate_metric(
    views: Sequence[CalibrationView],
    optics: OpticsSection,
    image_size: tuple[int, int],
    k3: Known = (0.0, 0.0),
) -> MetricCalibration:
    """The camera, the laser's sheet and the map from views of a board in several poses.

    A view, or its line, that disagrees with the others is left out, with the reason.

    Parameters
    ----------
    views : sequence of CalibrationView, px and mm, three usable ones or more
    optics : OpticsSection, what is known of the camera beforehand
    image_size : tuple of int, (width, height) of the pictures, px
    k3 : tuple of float, third radial coefficient and its standard uncertainty; held at 0 by default

    Raises
    ------
    InputError
        For what is known of the camera out of its range.
    MeasurementError
        Where fewer than three views are usable, where their poses do not determine the focal
        length, or where the lines do not determine the sheet.

    References
    ----------
    Z. Zhang, "A flexible new technique for camera calibration", IEEE PAMI 22 (2000).
    """
    # Of focal length and centre nothing is assumed: several poses determine them.
    priors = priors_of(optics, image_size, k3, assume_webcam=False)
    used = fit_views(views, optics, priors, image_size)
    lines = {
        board: line
        for board, number in enumerate(used.numbers)
        if (line := views[number].line) is not None
    }
    plane = find_plane(used.fit, priors.free, lines)
    marks = used.fit.marks.image_px[used.fit.good]
    on_lines = [line.image_px[plane.good[board]] for board, line in lines.items()]
    middle = (np.array(image_size, dtype=float) - 1) / 2
    view = SheetView(used.fit.boards.theta[:COUNT], optics.port, plane.q_per_mm, middle)
    solved = metric_map(view, plane.root, region_around(np.vstack([marks, *on_lines])))
    return MetricCalibration(
        plane_map=solved.model_copy(update={"stated_water": stated_water(optics)}),
        views=tuple(_judged(number, view, used, plane) for number, view in enumerate(views)),
        optics=optics,
        k3=k3,
        image_size=image_size,
        sigma=np.linalg.norm(used.fit.root[:COUNT], axis=1),
        software=f"lscan {__version__}",
    )


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
    MeasurementError
        Where fewer than three views are usable, no camera explains them, or their poses do not
        determine the focal length.
    """
    faults = {number: reason for number, view in enumerate(views) if (reason := _unusable(view))}
    numbers = [number for number in range(len(views)) if number not in faults]
    while True:
        _require_views(views, numbers, faults)
        found = [seen for number in numbers if (seen := views[number].marks) is not None]
        marks = found_on(found, range(len(numbers)))
        start = best_start(marks, priors, optics.port, image_size[0])
        if start is None:
            raise MeasurementError("no camera explains the views of the board")
        fit = _fit(start, marks, priors)
        wrong = _worst_view(fit, len(numbers))
        if wrong is None:
            break
        index, faults[numbers[index]] = wrong
        del numbers[index]
    _require_focal(fit, priors)
    return UsedViews(fit, tuple(numbers), faults)


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
    found = view.marks_found
    return "" if found >= FEWEST_MARKS else f"only {found} marks found, {FEWEST_MARKS} are needed"


def _worst_view(fit: CameraFit, count: int) -> tuple[int, str] | None:
    """The index and the fault of the view that disagrees most with the others, if one does."""
    lengths = np.hypot(*fit.marks.missed_px(fit.boards).T)
    each = [fit.marks.board == index for index in range(count)]
    rms = np.array([np.sqrt(np.mean(lengths[mask] ** 2)) for mask in each])
    level = np.array([np.median(lengths[mask]) for mask in each])
    lost = np.array([np.mean(~fit.good[mask]) for mask in each])
    worst = int(level.argmax())
    usual = max(float(np.median(level)), MEDIAN * float(np.median(fit.marks.sigma_px)))
    if level[worst] > WRONG_VIEW * usual:
        return worst, f"its marks lie {rms[worst]:.2f} px rms off what the other views say"
    worst = int(lost.argmax())
    if lost[worst] > MOST_WRONG:
        return worst, f"{100 * lost[worst]:.0f} % of its marks do not fit the board"
    return None


def _require_views(
    views: Sequence[CalibrationView], numbers: list[int], faults: dict[int, str]
) -> None:
    if len(numbers) < FEWEST_VIEWS:
        listed = "; ".join(f"{views[number].name}: {faults[number]}" for number in sorted(faults))
        raise MeasurementError(
            f"the metric route needs {FEWEST_VIEWS} views of the board, usable {len(numbers)}"
            + (f" ({listed})" if listed else "")
        )


def _require_focal(fit: CameraFit, priors: CameraPriors) -> None:
    """Refuse poses that leave the focal length open: boards that all face the camera do."""
    if priors.sigma[0] == 0:
        return
    focal = float(fit.boards.theta[0])
    sigma = float(np.linalg.norm(fit.root[0]))
    if not sigma <= LEAST_FOCAL * focal:
        raise MeasurementError(
            f"the views do not determine the focal length ({focal:.0f} px, standard uncertainty "
            f"{sigma:.0f} px): the board faces the camera alike in all of them; {TILTED}"
        )


def _judged(number: int, view: CalibrationView, used: UsedViews, plane: LaserPlane) -> FittedView:
    """The view of that number, and what became of it."""
    as_read = FittedView(view.name, view.marks, view.line, view.fault)
    if number in used.faults:
        return replace(as_read, reason=used.faults[number])
    board, fit = used.numbers.index(number), used.fit
    mine = (fit.marks.board == board) & fit.good
    miss = fit.marks.missed_px(fit.boards)[mine]
    rms_px = float(np.sqrt((miss**2).sum(axis=1).mean()))
    fitted = replace(as_read, used=True, marks_used=int(mine.sum()), rms_px=rms_px)
    if view.line is None:
        return replace(fitted, reason=view.fault)
    good, fault = plane.good[board], plane.faults.get(board, "")
    far = plane.distances_mm[board]
    shown = far[good] if good.any() else far[np.isfinite(far)]
    return replace(
        fitted,
        line_used=not fault,
        line_points_used=int(good.sum()),
        line_rms_mm=float(np.sqrt(np.mean(shown**2))) if len(shown) else np.nan,
        reason=fault,
    )


def _pooled(parts: list[tuple[float, int]]) -> float:
    """Root mean square of parts of a root mean square and a count each."""
    rms, count = np.array(parts).T
    return float(np.sqrt((rms**2 * count).sum() / count.sum()))
