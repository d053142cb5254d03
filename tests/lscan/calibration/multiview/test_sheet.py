"""The laser's plane from lines on boards, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from metricviews import SIZE, Pose, known, line_of, marks_of, paper_rig, poses, views_of, with_noise

from lscan.calibration.metric.solve import UnsolvedViews, calibrate_metric
from lscan.calibration.metric.views import CalibrationView, LinePoints
from lscan.errors import MeasurementError
from lscan.records import Status


def shifted(line: LinePoints, by_px: float) -> LinePoints:
    across = np.array([0.0, by_px]) if line.axis == "columns" else np.array([by_px, 0.0])
    return replace(line, image_px=line.image_px + across)


def noisy_views(seed: int, noise: float = 0.02) -> list[CalibrationView]:
    rig, rng = paper_rig(), np.random.default_rng(seed)
    return [with_noise(view, noise, rng) for view in views_of(rig, poses(rig, rng, 6))]


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


def test_a_line_all_in_one_place_is_left_out() -> None:
    views = noisy_views(1)
    line = views[2].line
    assert line is not None
    there = np.repeat(line.image_px[:1], len(line.image_px), axis=0)
    views[2] = replace(views[2], line=replace(line, image_px=there))
    view = calibrate_metric(views, known(paper_rig()), SIZE).views[2]
    assert view.used and not view.line_used
    assert "only 0 points" in view.reason


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
    boards = poses(rig, rng, 5)
    normal = rig.q_per_mm / np.linalg.norm(rig.q_per_mm)
    lean = np.radians(4.0)
    up = np.array([0.0, normal[2], -normal[1]])
    away = np.cos(lean) * normal + np.sin(lean) * up
    along = np.array([1.0, 0.0, 0.0])
    lying = Pose(np.column_stack([along, np.cross(away, along), away]), boards[0].place_mm)
    views = [with_noise(view, 0.02, rng) for view in views_of(rig, [*boards, lying])]
    found = calibrate_metric(views, known(rig), SIZE)
    assert found.views[5].used and not found.views[5].line_used
    assert "deg from the sheet" in found.views[5].reason


def glared(view: CalibrationView, rng: np.random.Generator) -> CalibrationView:
    """The view with a straight streak of glare in its line's place: displaced, and slanted."""
    assert view.line is not None
    along = np.linspace(-1, 1, len(view.line.image_px))
    away = rng.choice([-1, 1]) * rng.uniform(8, 40) + rng.uniform(-10, 10) * along
    across = 1 if view.line.axis == "columns" else 0
    places = view.line.image_px.copy()
    places[:, across] += away
    return replace(view, line=replace(view.line, image_px=places))


@pytest.mark.parametrize("seed", [11, pytest.param(12, marks=pytest.mark.slow)])
def test_half_of_the_lines_wrong_by_glare_are_named_and_left_out(seed: int) -> None:
    """The plane is that of the right lines alone, to rounding, whatever the wrong ones show."""
    rig, rng = paper_rig(), np.random.default_rng(seed)
    views = [with_noise(view, 0.05, rng) for view in views_of(rig, poses(rig, rng, 10))]
    wrong = set(rng.permutation(10)[:5].tolist())
    mixed = [glared(view, rng) if k in wrong else view for k, view in enumerate(views)]
    found = calibrate_metric(mixed, known(rig), SIZE)
    assert {k for k, view in enumerate(found.views) if not view.line_used} == wrong
    assert all(found.views[k].reason for k in wrong)
    alone = [replace(view, line=None) if k in wrong else view for k, view in enumerate(views)]
    right = calibrate_metric(alone, known(rig), SIZE)
    np.testing.assert_allclose(
        found.plane_map.view.q_per_mm, right.plane_map.view.q_per_mm, rtol=0, atol=1e-12
    )


def test_the_plane_does_not_depend_on_the_order_of_the_views() -> None:
    rig, rng = paper_rig(), np.random.default_rng(14)
    views = [with_noise(view, 0.05, rng) for view in views_of(rig, poses(rig, rng, 7))]
    views = [glared(view, rng) if k % 2 else view for k, view in enumerate(views)]
    order = rng.permutation(len(views)).tolist()
    one = calibrate_metric(views, known(rig), SIZE)
    two = calibrate_metric([views[k] for k in order], known(rig), SIZE)
    assert [one.views[k].line_used for k in order] == [view.line_used for view in two.views]
    # Sums in another order; the fit stops where chi squared changes by 1e-12 of itself, and near
    # its minimum it changes as the square of a change of the plane: 1e-6 of the vector.
    planes = [found.plane_map.view.q_per_mm for found in (one, two)]
    assert np.linalg.norm(planes[0] - planes[1]) <= 1e-6 * np.linalg.norm(planes[0])


def test_one_line_of_five_six_millimetres_off_does_not_move_the_plane() -> None:
    """A pixel is 1.2 mm of board: 12 px across a line lie some 6 mm off the sheet."""
    rig, rng = paper_rig(), np.random.default_rng(15)
    views = [with_noise(view, 0.1, rng) for view in views_of(rig, poses(rig, rng, 5))]
    assert views[0].line is not None
    without = [replace(views[0], line=None), *views[1:]]
    views[0] = replace(views[0], line=shifted(views[0].line, 12.0))
    found = calibrate_metric(views, known(rig), SIZE)
    assert [view.line_used for view in found.views] == [False, True, True, True, True]
    right = calibrate_metric(without, known(rig), SIZE)
    np.testing.assert_allclose(
        found.plane_map.view.q_per_mm, right.plane_map.view.q_per_mm, rtol=0, atol=1e-12
    )


def test_lines_that_agree_on_no_plane_are_refused_by_name() -> None:
    rig, rng = paper_rig(), np.random.default_rng(16)
    views = [with_noise(view, 0.05, rng) for view in views_of(rig, poses(rig, rng))]
    views = [glared(view, rng) if k > 1 else view for k, view in enumerate(views)]
    with pytest.raises(UnsolvedViews, match=r"laser lines .*pose-5") as caught:
        calibrate_metric(views, known(rig), SIZE)
    assert [view.used for view in caught.value.views] == [True] * 8
    assert str(caught.value).count("\n") == 0


def test_three_lines_of_which_one_is_wrong_are_refused() -> None:
    """Two of three prove nothing: either may be the wrong one."""
    rig, rng = paper_rig(), np.random.default_rng(17)
    views = [with_noise(view, 0.02, rng) for view in views_of(rig, poses(rig, rng))]
    assert views[1].line is not None
    views[1] = replace(views[1], line=shifted(views[1].line, 12.0))
    views = [view if k < 3 else replace(view, line=None) for k, view in enumerate(views)]
    with pytest.raises(MeasurementError, match=r"laser lines .* one plane"):
        calibrate_metric(views, known(rig), SIZE)


def test_a_sheet_seen_almost_edge_on_keeps_a_frame_of_use() -> None:
    """The sheet 40 mm beside the pinhole: the picture's middle sees it metres behind the boards."""
    rig, rng = paper_rig(water=False), np.random.default_rng(18)
    rig = replace(rig, q_per_mm=np.array([-1 / 40, 0.0, 2e-6]))
    boards = []
    for pose in poses(paper_rig(water=False), rng):
        y, z = rng.uniform(-60, 60), rng.uniform(550, 800)
        x = (1 - rig.q_per_mm[2] * z) / rig.q_per_mm[0]
        boards.append(Pose(pose.rotation, np.array([x, y, z])))
    views = [with_noise(view, 0.02, rng) for view in views_of(rig, boards)]
    found = calibrate_metric(views, known(rig), SIZE)
    seen = np.vstack([view.line.image_px[[20, 60]] for view in views if view.line is not None])
    points = found.plane_map.to_plane(seen)
    truth = replace(rig.truth, origin_px=found.plane_map.view.origin_px).locate(seen)
    assert (points.sigma_mm < 10.0).all()  # of 800 mm; the middle's own place is off by metres
    assert (np.abs(points.xz_mm - truth) < 5 * points.sigma_mm + 1e-9).all()
