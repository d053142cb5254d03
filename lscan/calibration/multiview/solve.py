"""From the views of a board to camera, laser sheet and map, and what became of each view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lscan.calibration.multiview.bundle import (
    NAMES,
    Adjusted,
    Bundle,
    Observations,
    Prior,
    adjust,
    observations,
)
from lscan.calibration.multiview.lines import Sight, sight_of
from lscan.calibration.multiview.planemap import Metric, SheetView, modes_that_matter, region_around
from lscan.calibration.multiview.sheet import Sheet, find_sheet
from lscan.calibration.multiview.start import prior_of, start_bundle
from lscan.calibration.multiview.views import View
from lscan.config.rig import Known, OpticsSection
from lscan.errors import InputError, MeasurementError
from lscan.records import Floats, Mask
from lscan.version import __version__

FEWEST_VIEWS = 3  # Zhang 2000, Sec. 3.1: two give a camera without skew, a third checks it
FEWEST_MARKS = 6  # of a view; its pose needs four
WRONG_MARK = 6.0  # sigmas: one good mark in 6e7 is as far off (Rayleigh)
WRONG_VIEW = 4.0  # times the median of the views' rms residuals
MEDIAN = np.sqrt(2 * np.log(2))  # of a residual's length over its uncertainty (Rayleigh)
MOST_WRONG = 0.25  # of a view's marks; beyond it the view is wrong
LEAST_FOCAL = 0.05  # relative uncertainty of the focal length beyond which it is not known
ROUNDS = 10
SETTLED = 1e-3  # relative change of chi squared
TILTED = "hold it at different tilts, 20 to 45 deg, to different sides"


@dataclass(frozen=True)
class ViewReport:
    """What became of one view.

    marks: how many were used, of how many found.  rms_px: root mean square length of their
    residuals.  line_points: used, of how many found.  line_rms_mm: of their distances from
    the sheet.  Each NaN where there is none.  fault: why the view, or its line, was not used.
    """

    name: str
    used: bool
    marks: tuple[int, int]
    rms_px: float
    line_used: bool
    line_points: tuple[int, int]
    line_rms_mm: float
    fault: str


@dataclass(frozen=True)
class MetricCalibration:
    """A metric map and what it rests on.

    views: as read.  optics, k3: what was known of the camera.  image_size: (width, height).
    reports: one a view.  sigma: (14,) standard uncertainties of the camera (bundle.NAMES), 0
    of what was held.
    """

    plane_map: Metric
    views: tuple[View, ...]
    optics: OpticsSection
    k3: Known
    image_size: tuple[int, int]
    reports: tuple[ViewReport, ...]
    sigma: Floats
    software: str

    @property
    def rms_px(self) -> float:
        """Root mean square length of the used marks' residuals in all used views."""
        return _pooled([(r.rms_px, r.marks[0]) for r in self.reports if r.used])

    @property
    def line_rms_mm(self) -> float:
        """Root mean square distance of the used line points from the sheet."""
        return _pooled([(r.line_rms_mm, r.line_points[0]) for r in self.reports if r.line_used])


@dataclass(frozen=True)
class Board:
    """The adjusted bundle of the views ``numbers``, and why others are not among them."""

    adjusted: Adjusted
    marks: Observations
    numbers: tuple[int, ...]
    faults: dict[int, str]


def calibrate_metric(
    views: Sequence[View],
    optics: OpticsSection,
    image_size: tuple[int, int],
    k3: Known = (0.0, 0.0),
) -> MetricCalibration:
    """The camera, the laser's sheet and the map from views of a board in several poses.

    k3: third radial coefficient and its standard uncertainty, held at 0 if left out.
    A view, or its line, that disagrees with the others is set aside, and its report says why.

    Raises InputError for what is known of the camera out of its range, MeasurementError where
    fewer than three views are usable, where their poses do not tell the focal length, or where
    the lines do not tell the sheet.
    """
    prior = prior_of(optics, k3, image_size)
    board = adjust_views(views, optics, prior, image_size)
    sights = [
        sight_of(line, index)
        for index, number in enumerate(board.numbers)
        if (line := views[number].line) is not None
    ]
    sheet = find_sheet(board.adjusted, prior, sights)
    plane_map = _map_of(board, sheet, sights, image_size)
    sigma = np.zeros(len(NAMES))
    sigma[prior.free] = np.linalg.norm(board.adjusted.root[: len(prior.free)], axis=1)
    return MetricCalibration(
        plane_map=plane_map,
        views=tuple(views),
        optics=optics,
        k3=k3,
        image_size=image_size,
        reports=tuple(_report(number, view, board, sheet) for number, view in enumerate(views)),
        sigma=sigma,
        software=f"lscan {__version__}",
    )


def adjust_views(
    views: Sequence[View], optics: OpticsSection, prior: Prior, image_size: tuple[int, int]
) -> Board:
    """The bundle of all views but wrong ones.

    The worst view is set aside, one at a time, while its residuals are WRONG_VIEW times as
    large as the median view's; within views, single marks that are more than WRONG_MARK
    standard uncertainties (or of the residuals' usual size, where all are larger) off.
    """
    faults = {number: reason for number, view in enumerate(views) if (reason := _unusable(view))}
    numbers = [number for number in range(len(views)) if number not in faults]
    while True:
        _require_views(views, numbers, faults)
        marks = observations([views[number] for number in numbers])
        start = start_bundle(marks, len(numbers), prior, optics.port, image_size)
        adjusted, marks = _fit(start, marks, prior)
        wrong = _worst_view(adjusted, marks, numbers)
        if wrong is None:
            break
        index, faults[numbers[index]] = wrong
        del numbers[index]
    _require_focal(adjusted, prior)
    return Board(adjusted, marks, tuple(numbers), faults)


def _fit(start: Bundle, marks: Observations, prior: Prior) -> tuple[Adjusted, Observations]:
    """The bundle of the sound marks, and the marks with their uncertainties as it shows them.

    What is left beyond the marks' own uncertainties (compression, an uneven board) is taken to
    displace all marks alike, and is added to each one's: a few marks of little noise must not
    decide alone.
    """
    good = np.ones(len(marks.view), dtype=bool)
    own = marks.sigma_px
    adjusted = adjust(start, marks, prior, good)
    for _ in range(ROUNDS):
        marks = replace(marks, sigma_px=np.hypot(own, _excess_px(adjusted, marks, own)))
        good = _sound_marks(adjusted, marks)
        before, adjusted = adjusted, adjust(adjusted.bundle, marks, prior, good)
        settled = np.isclose(adjusted.chi_square, before.chi_square, rtol=SETTLED)
        if settled and (good == before.good).all():
            break
    return adjusted, marks


def _excess_px(adjusted: Adjusted, marks: Observations, own: Floats) -> float:
    """What u and v of the good marks are off by, rms, beyond their own uncertainties (N,)."""
    miss = adjusted.bundle.misses_px(marks)[adjusted.good]
    equations = miss.size
    freedom = max(equations - adjusted.root.shape[0], 1)
    return float(np.sqrt(max(0.0, (miss**2).sum() / freedom - np.mean(own[adjusted.good] ** 2))))


def _unusable(view: View) -> str:
    """Why a view has no marks to use; "" where it has."""
    if view.marks is None:
        return view.fault or "the board was not found"
    found = int(view.marks.found.sum())
    return "" if found >= FEWEST_MARKS else f"only {found} marks found, {FEWEST_MARKS} are needed"


def _worst_view(
    adjusted: Adjusted, marks: Observations, numbers: list[int]
) -> tuple[int, str] | None:
    """The index and the fault of the view that disagrees most with the others, if one does."""
    lengths = np.hypot(*adjusted.bundle.misses_px(marks).T)
    each = [marks.view == index for index in range(len(numbers))]
    rms = np.array([np.sqrt(np.mean(lengths[mask] ** 2)) for mask in each])
    level = np.array([np.median(lengths[mask]) for mask in each])
    lost = np.array([np.mean(~adjusted.good[mask]) for mask in each])
    worst = int(level.argmax())
    usual = max(float(np.median(level)), MEDIAN * float(np.median(marks.sigma_px)))
    if level[worst] > WRONG_VIEW * usual:
        return worst, f"its marks lie {rms[worst]:.2f} px rms off what the other views say"
    worst = int(lost.argmax())
    if lost[worst] > MOST_WRONG:
        return worst, f"{100 * lost[worst]:.0f} % of its marks do not fit the board"
    return None


def _sound_marks(adjusted: Adjusted, marks: Observations) -> Mask:
    """(N,) mask of the marks whose residuals are no larger than noise makes them."""
    length = np.hypot(*adjusted.bundle.misses_px(marks).T) / marks.sigma_px
    usual = max(1.0, float(np.median(length)) / MEDIAN)
    sound: Mask = length <= WRONG_MARK * usual
    return sound


def _require_views(views: Sequence[View], numbers: list[int], faults: dict[int, str]) -> None:
    if len(numbers) < FEWEST_VIEWS:
        listed = "; ".join(f"{views[number].name}: {faults[number]}" for number in sorted(faults))
        raise MeasurementError(
            f"the metric route needs {FEWEST_VIEWS} views of the board, usable {len(numbers)}"
            + (f" ({listed})" if listed else "")
        )


def _require_focal(adjusted: Adjusted, prior: Prior) -> None:
    """Refuse poses that leave the focal length open: boards that all face the camera do."""
    if prior.sigma[0] == 0:
        return
    focal = float(adjusted.bundle.theta[0])
    sigma = float(np.linalg.norm(adjusted.root[0]))
    if not sigma <= LEAST_FOCAL * focal:
        raise MeasurementError(
            f"the views do not tell the focal length ({focal:.0f} px, standard uncertainty "
            f"{sigma:.0f} px): the board faces the camera alike in all of them; {TILTED}"
        )


def _map_of(board: Board, sheet: Sheet, sights: list[Sight], image_size: tuple[int, int]) -> Metric:
    """The map of a camera and a sheet; it holds where marks or lines were seen."""
    bundle = board.adjusted.bundle
    lines = [sight.image_px[sheet.good[sight.view]] for sight in sights]
    region = region_around(np.vstack([board.marks.image_px[board.adjusted.good], *lines]))
    middle = (np.array(image_size, dtype=float) - 1) / 2
    view = SheetView(bundle.theta, bundle.port, sheet.q_per_mm, middle)
    corners = region.outline_px
    half_way = (corners + corners.mean(axis=0)) / 2
    modes = modes_that_matter(view, sheet.root, np.vstack([corners, half_way]))
    return Metric(view, modes, region)


def _report(number: int, view: View, board: Board, sheet: Sheet) -> ViewReport:
    found = 0 if view.marks is None else int(view.marks.found.sum())
    seen = 0 if view.line is None else len(view.line.image_px)
    if number in board.faults:
        reason = board.faults[number]
        return ViewReport(view.name, False, (0, found), np.nan, False, (0, seen), np.nan, reason)
    index = board.numbers.index(number)
    mine = (board.marks.view == index) & board.adjusted.good
    miss = board.adjusted.bundle.misses_px(board.marks)[mine]
    rms_px = float(np.sqrt((miss**2).sum(axis=1).mean()))
    marks = (int(mine.sum()), found)
    if view.line is None:
        return ViewReport(view.name, True, marks, rms_px, False, (0, 0), np.nan, view.fault)
    good, fault = sheet.good[index], sheet.faults.get(index, "")
    far = sheet.distances_mm[index]
    shown = far[good] if good.any() else far[np.isfinite(far)]
    line_rms = float(np.sqrt(np.mean(shown**2))) if len(shown) else np.nan
    points = (int(good.sum()), seen)
    return ViewReport(view.name, True, marks, rms_px, not fault, points, line_rms, fault)


def _pooled(parts: list[tuple[float, int]]) -> float:
    """Root mean square of parts of a root mean square and a count each."""
    if not parts:
        raise InputError("nothing was used", where="metric calibration")
    rms, count = np.array(parts).T
    return float(np.sqrt((rms**2 * count).sum() / count.sum()))
