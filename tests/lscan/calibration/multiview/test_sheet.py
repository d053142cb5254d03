"""The laser's plane from lines on boards, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from metricviews import SIZE, Pose, known, line_of, marks_of, paper_rig, poses, views_of, with_noise

from lscan.calibration.multiview.solve import calibrate_metric
from lscan.calibration.multiview.views import CalibrationView, LinePoints
from lscan.errors import MeasurementError
from lscan.records import Status


def shifted(line: LinePoints, by_px: float) -> LinePoints:
    across = np.array([0.0, by_px]) if line.axis == "columns" else np.array([by_px, 0.0])
    return replace(line, image_px=line.image_px + across)


def noisy_views(seed: int, noise: float = 0.02) -> list[CalibrationView]:
    rig, rng = paper_rig(), np.random.default_rng(seed)
    return [with_noise(view, noise, rng) for view in views_of(rig, poses(rig, rng))]


def test_a_line_off_the_sheet_is_named_and_left_out() -> None:
    views, rig = noisy_views(1), paper_rig()
    assert views[2].line is not None
    without = [*views[:2], replace(views[2], line=None), *views[3:]]
    views[2] = replace(views[2], line=shifted(views[2].line, 6.0))
    found = calibrate_metric(views, known(rig), SIZE)
    view = found.views[2]
    assert view.used and not view.line_used
    assert "mm rms off the sheet of the other views" in view.reason
    left = calibrate_metric(without, known(rig), SIZE)
    np.testing.assert_allclose(
        found.plane_map.view.q_per_mm, left.plane_map.view.q_per_mm, rtol=0, atol=1e-12
    )


def test_points_off_the_line_are_left_out() -> None:
    views, rig = noisy_views(2), paper_rig()
    line = views[0].line
    assert line is not None
    outliers = line.image_px.copy()
    outliers[10:30] += [0.0, 9.0] if line.axis == "columns" else [9.0, 0.0]
    views[0] = replace(views[0], line=replace(line, image_px=outliers))
    found = calibrate_metric(views, known(rig), SIZE)
    assert (found.views[0].line_points_used, found.views[0].points_found) == (60, 80)
    assert found.views[0].line_used


def test_pixels_outside_what_was_seen_have_no_value() -> None:
    found = calibrate_metric(noisy_views(3), known(paper_rig()), SIZE)
    points = found.plane_map.to_plane(np.array([[5.0, 5.0], [319.5, 239.5], [np.nan, 1.0]]))
    assert points.status.tolist() == [Status.OUT_OF_BOARD, Status.OK, Status.NO_DATA]
    # The middle of the picture is the origin, whatever the camera is.
    np.testing.assert_allclose(points.xz_mm[1], 0.0, atol=1e-9)
    np.testing.assert_allclose(points.sigma_mm[1], 0.0, atol=1e-9)


def test_the_modes_are_the_calibrations_part_of_sigma() -> None:
    found = calibrate_metric(noisy_views(4), known(paper_rig()), SIZE)
    pixels = np.array([[250.0, 200.0], [400.0, 280.0]])
    without = found.plane_map.to_plane(pixels)
    assert without.modes_mm is not None
    np.testing.assert_allclose((without.modes_mm**2).sum(axis=2), without.sigma_mm**2, rtol=1e-9)
    with_pixel = found.plane_map.to_plane(pixels, np.full(2, 0.1))
    assert (with_pixel.sigma_mm > without.sigma_mm).all()


def test_one_line_does_not_make_a_plane() -> None:
    views, rig = noisy_views(5), paper_rig()
    views = [views[0], *(replace(view, line=None) for view in views[1:])]
    with pytest.raises(MeasurementError, match="on two boards, usable 1"):
        calibrate_metric(views, known(rig), SIZE)


def test_lines_in_one_line_of_space_are_refused() -> None:
    """Boards turned about one line of the sheet: every plane through it fits."""
    rig, rng = paper_rig(), np.random.default_rng(6)
    normal = rig.q_per_mm / np.linalg.norm(rig.q_per_mm)
    place = np.array([0.0, 0.0, 1 / rig.q_per_mm[2]])
    along = np.array([1.0, 0.0, 0.0])
    boards = []
    for lean in np.radians([-35.0, -20.0, 20.0, 35.0]):
        away = np.cos(lean) * np.array([0.0, 0.0, 1.0]) + np.sin(lean) * np.array([0.0, 1.0, 0.0])
        boards.append(Pose(np.column_stack([along, np.cross(away, along), away]), place))
    assert abs(normal @ along) < 1e-12
    tilted = poses(rig, rng, 4)  # of these only the marks: the camera is well known
    views = [
        CalibrationView(f"{k}", marks_of(rig, pose), line_of(rig, pose))
        for k, pose in enumerate(boards)
    ]
    views += [
        CalibrationView(f"m{k}", marks_of(rig, p), line_of(rig, p)) for k, p in enumerate(tilted)
    ]
    views = [with_noise(view, 0.03, rng) for view in views]
    views = [view if number < 4 else replace(view, line=None) for number, view in enumerate(views)]
    with pytest.raises(MeasurementError, match="not determined"):
        calibrate_metric(views, known(rig), SIZE)


def test_a_board_nearly_in_the_sheet_is_named() -> None:
    rig, rng = paper_rig(), np.random.default_rng(7)
    boards = poses(rig, rng)
    normal = rig.q_per_mm / np.linalg.norm(rig.q_per_mm)
    lean = np.radians(4.0)
    up = np.array([0.0, normal[2], -normal[1]])
    away = np.cos(lean) * normal + np.sin(lean) * up
    along = np.array([1.0, 0.0, 0.0])
    lying = Pose(np.column_stack([along, np.cross(away, along), away]), boards[0].place_mm)
    views = [with_noise(view, 0.02, rng) for view in views_of(rig, [*boards, lying])]
    found = calibrate_metric(views, known(rig), SIZE)
    assert found.views[8].used and not found.views[8].line_used
    assert "deg from the sheet" in found.views[8].reason
