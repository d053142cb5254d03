"""From the views of a board to camera, laser sheet and map, and what became of each view."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lscan.calibration.multiview.planemap import Metric, SheetView, metric_map
from lscan.calibration.multiview.sheet import LaserPlane, NoLaserPlane, find_plane
from lscan.calibration.multiview.usedviews import UnsolvedViews, UsedViews, fit_views, fitted_views
from lscan.calibration.multiview.views import CalibrationView, FittedView, LinePoints
from lscan.calibration.region import region_around
from lscan.camera.optics import stated_water
from lscan.camera.posedboards import COUNT, priors_of
from lscan.config.rig import Known, OpticsSection
from lscan.errors import MeasurementError
from lscan.records import Floats
from lscan.version import __version__

FARTHER = 2.0  # times than the lines: the origin's uncertainty goes with the square of its distance


@dataclass(frozen=True)
class SolvedViews:
    """The views of a board that something was solved from, and what is known of the camera.

    Attributes
    ----------
    views : tuple of FittedView, as read, and what became of each
    optics : OpticsSection, what was known of the camera
    k3 : tuple of float, third radial coefficient and its standard uncertainty beforehand
    image_size : tuple of int, (width, height) of the pictures, px
    sigma : (14,) array, standard uncertainties of the camera (parameters.CAMERA), 0 of what was
        held
    software : str, name and version of the program that solved it
    """

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


@dataclass(frozen=True)
class CameraCalibration(SolvedViews):
    """A camera alone, and what it rests on.

    Attributes
    ----------
    theta : (14,) array, the camera (parameters.CAMERA)
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
        """(14,) the camera (parameters.CAMERA)."""
        return self.plane_map.view.theta

    @property
    def line_rms_mm(self) -> float:
        """Root mean square distance of the used line points from the sheet."""
        lines = [view for view in self.views if view.line_used]
        return _pooled([(view.line_rms_mm, view.line_points_used) for view in lines])


def _place(view: CalibrationView) -> bytes:
    """Where the marks are, to the last bit: no two pictures show them alike."""
    return b"" if view.marks is None else view.marks.image_px[view.marks.found].tobytes()


def calibrate_camera(
    views: Sequence[CalibrationView],
    optics: OpticsSection,
    image_size: tuple[int, int],
    k3: Known = (0.0, 0.0),
) -> CameraCalibration:
    """The camera alone from views of a board in several poses; a laser line is not needed.

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
    UnsolvedViews
        Where fewer than three views are usable, or where their poses do not determine the focal
        length.
    """
    views = [
        view if view.marks is None else CalibrationView(view.name, view.marks) for view in views
    ]
    priors = priors_of(optics, image_size, k3, assume_webcam=False)
    used = fit_views(views, optics, priors, image_size)
    solved = _solved(used, fitted_views(views, used), optics, image_size, k3)
    return CameraCalibration(theta=used.fit.boards.theta[:COUNT], **solved)


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
    UnsolvedViews
        Where fewer than three views are usable, where their poses do not determine the focal
        length, where too few of the lines agree on one plane, or where they do not determine it.

    References
    ----------
    Z. Zhang, "A flexible new technique for camera calibration", IEEE PAMI 22 (2000).
    """
    # Of focal length and centre nothing is assumed: several poses determine them.
    priors = priors_of(optics, image_size, k3, assume_webcam=False)
    used = fit_views(views, optics, priors, image_size)
    fitted = fitted_views(views, used)
    lines = {
        board: line
        for board, number in enumerate(used.numbers)
        if (line := views[number].line) is not None
    }
    try:
        plane = find_plane(used.fit, priors.free, lines)
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
    solved = _solved(used, fitted, optics, image_size, k3)
    return MetricCalibration(plane_map=plane_map, **solved)


def _solved(
    used: UsedViews,
    views: Sequence[FittedView],
    optics: OpticsSection,
    image_size: tuple[int, int],
    k3: Known,
) -> dict[str, Any]:
    """The fields of a SolvedViews."""
    return {
        "views": tuple(views),
        "optics": optics,
        "k3": k3,
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
    solved = metric_map(view, plane.root, region_around(np.vstack([marks, *on_lines])))
    return solved.model_copy(update={"stated_water": stated_water(optics)})


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
    fitted = replace(
        view,
        line_used=not fault,
        line_points_used=int(good.sum()),
        line_rms_mm=float(np.sqrt(np.mean(shown**2))) if len(shown) else np.nan,
    )
    return _with_reason(fitted, fault)


def _with_reason(view: FittedView, fault: str) -> FittedView:
    """The view with another fault beside those it has."""
    return replace(view, reason="; ".join(filter(None, (view.reason, fault))))


def _pooled(parts: list[tuple[float, int]]) -> float:
    """Root mean square of parts of a root mean square and a count each."""
    rms, count = np.array(parts).T
    return float(np.sqrt((rms**2 * count).sum() / count.sum()))
