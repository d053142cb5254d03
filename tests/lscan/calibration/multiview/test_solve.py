"""The metric route's adjustment: exact data, noise, and views that are wrong."""

from dataclasses import replace

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from metricviews import (
    SIZE,
    Pose,
    Rig,
    known,
    line_of,
    marks_of,
    paper_rig,
    poses,
    rigs,
    views_of,
    with_noise,
)

from lscan.calibration.metric.solve import calibrate_camera, calibrate_metric
from lscan.calibration.metric.views import CalibrationView
from lscan.camera.posedboards import CAMERA
from lscan.config.rig import OpticsSection
from lscan.errors import InputError, MeasurementError
from lscan.records import Floats, Status

LENS = [CAMERA.index(name) for name in ("focal_px", "centre_u_px", "centre_v_px", "k1", "k2")]
SEEDS = st.integers(0, 2**32 - 1)


def grid_px() -> Floats:
    """(15, 2) pixels that the boards of every rig here cover."""
    u, v = np.meshgrid([240.0, 280.0, 320.0, 360.0, 400.0], [200.0, 240.0, 280.0])
    return np.column_stack([u.ravel(), v.ravel()])


@examples(2)
@given(rig=rigs(water=False), seed=SEEDS)
def test_exact_marks_give_the_camera_and_the_sheet(rig: Rig, seed: int) -> None:
    boards = poses(rig, np.random.default_rng(seed), 5)
    found = calibrate_metric(views_of(rig, boards), known(rig), SIZE)
    # Priors 1e4 wide draw on k1 and k2 by (uncertainty from the marks / 1e4)^2 < 1e-8 of them.
    np.testing.assert_allclose(
        found.plane_map.view.theta[LENS], rig.truth.theta[LENS], rtol=1e-6, atol=1e-6
    )
    np.testing.assert_allclose(found.plane_map.view.q_per_mm, rig.q_per_mm, atol=1e-9)
    places = found.plane_map.to_plane(grid_px())
    seen = places.status == Status.OK
    assert seen.sum() >= 9
    np.testing.assert_allclose(
        places.xz_mm[seen], rig.truth.locate(grid_px())[seen], rtol=0, atol=1e-3
    )


@examples(2)
@given(rig=rigs(water=True), seed=SEEDS)
def test_exact_marks_through_a_known_port_give_the_map(rig: Rig, seed: int) -> None:
    boards = poses(rig, np.random.default_rng(seed), 5)
    found = calibrate_metric(views_of(rig, boards), known(rig), SIZE)
    assert found.rms_px < 1e-5
    np.testing.assert_allclose(found.plane_map.view.theta[0], rig.truth.theta[0], rtol=1e-6)
    places = found.plane_map.to_plane(grid_px())
    seen = places.status == Status.OK
    np.testing.assert_allclose(
        places.xz_mm[seen], rig.truth.locate(grid_px())[seen], rtol=0, atol=1e-3
    )


@pytest.mark.slow
def test_errors_are_as_large_as_sigma_says() -> None:
    """Places, lengths and the camera, each over its uncertainty: unit variance over 24 draws.

    Were each draw's mean square that of one number, the mean of 24 would lie below 0.34 or
    above 2.13 once in 1000 each (chi squared); places of a draw are correlated, but not
    altogether.
    """
    rig, rng = paper_rig(), np.random.default_rng(11)
    boards = poses(rig, rng)
    exact, truth = views_of(rig, boards), rig.truth.locate(grid_px())
    far, near = truth[[0, 4, 12]], truth[[14, 10, 2]]
    lengths = np.linalg.norm(far - near, axis=1)
    of_places, of_lengths, of_focal = [], [], []
    for _ in range(24):
        noisy = [with_noise(view, 0.03, rng) for view in exact]
        found = calibrate_metric(noisy, known(rig), SIZE)
        points = found.plane_map.to_plane(grid_px())
        assert points.modes_mm is not None
        corner = (points.xz_mm - truth)[[0, 4, 10, 14]] / points.sigma_mm[[0, 4, 10, 14]]
        of_places.append(np.mean(corner**2))
        across = points.xz_mm[[0, 4, 12]] - points.xz_mm[[14, 10, 2]]
        measured = np.linalg.norm(across, axis=1)
        apart = points.modes_mm[[0, 4, 12]] - points.modes_mm[[14, 10, 2]]
        sigma = np.linalg.norm(np.einsum("ni,nim->nm", across / measured[:, None], apart), axis=1)
        of_lengths.append(np.mean(((measured - lengths) / sigma) ** 2))
        error = found.plane_map.view.theta[0] - rig.truth.theta[0]
        of_focal.append((error / found.sigma[0]) ** 2)
    for squares in (of_places, of_lengths, of_focal):
        assert 0.34 < np.mean(squares) < 2.13


def test_sigma_grows_with_the_noise() -> None:
    rig, rng = paper_rig(), np.random.default_rng(2)
    exact = views_of(rig, poses(rig, rng, 4))
    sigma = []
    for noise in (0.01, 0.1):
        noisy = [with_noise(view, noise, np.random.default_rng(5)) for view in exact]
        found = calibrate_metric(noisy, known(rig), SIZE)
        sigma.append(found.plane_map.to_plane(grid_px()).sigma_mm.max())
    # The same draw ten times as large: the map is linear in it to a few per cent.
    np.testing.assert_allclose(np.diff(np.log(sigma)), np.log(10.0), atol=0.3)


def test_a_bad_view_is_named_and_the_others_stand() -> None:
    rig, rng = paper_rig(), np.random.default_rng(6)
    views = [with_noise(view, 0.02, rng) for view in views_of(rig, poses(rig, rng, 5))]
    without = calibrate_camera(views[:3] + views[4:], known(rig), SIZE)
    assert views[3].marks is not None
    u = views[3].marks.image_px[:, 0]
    bent = views[3].marks.image_px + np.column_stack([np.zeros(len(u)), 4 * np.sin(u / 20)])
    views[3] = replace(views[3], marks=replace(views[3].marks, image_px=bent))
    found = calibrate_camera(views, known(rig), SIZE)
    assert [view.used for view in found.views] == [number != 3 for number in range(5)]
    assert "px rms off what the other views say" in found.views[3].reason
    np.testing.assert_allclose(found.theta, without.theta, rtol=1e-6, atol=1e-8)


def test_a_view_that_fits_worse_than_the_others_is_named() -> None:
    """Marks 2.8 times as far off as usual: the view counts, but not in silence."""
    rig, rng = paper_rig(), np.random.default_rng(21)
    exact = views_of(rig, poses(rig, rng, 6))
    views = [with_noise(view, 0.84 if k == 4 else 0.3, rng) for k, view in enumerate(exact)]
    # Each states what the others have: nothing in the picture says that it is worse.
    views = [
        replace(view, marks=replace(view.marks, sigma_px=np.full(48, 0.3)))
        for view in views
        if view.marks is not None
    ]
    found = calibrate_camera(views, known(rig), SIZE)
    assert [bool(view.reason) for view in found.views] == [number == 4 for number in range(6)]
    assert found.views[4].used and "times the usual" in found.views[4].reason


@pytest.mark.slow  # one bad view is named above
def test_views_that_are_far_off_do_not_hide_one_another() -> None:
    """Two of eight, 100 times as far off as the others: what they show does not set the scale."""
    rig, rng = paper_rig(), np.random.default_rng(22)
    exact = views_of(rig, poses(rig, rng))
    views = [with_noise(view, 0.02, rng) for view in exact]
    for number in (2, 5):
        marks = views[number].marks
        assert marks is not None
        bent = marks.image_px + rng.normal(0, 2.0, marks.image_px.shape)
        views[number] = replace(views[number], marks=replace(marks, image_px=bent))
    found = calibrate_metric(views, known(rig), SIZE)
    assert [view.used for view in found.views] == [k not in (2, 5) for k in range(8)]


def test_a_camera_alone_is_that_of_the_whole_calibration() -> None:
    rig, rng = paper_rig(), np.random.default_rng(23)
    views = [with_noise(view, 0.02, rng) for view in views_of(rig, poses(rig, rng, 4))]
    alone = calibrate_camera([replace(v, line=None) for v in views], known(rig), SIZE)
    whole = calibrate_metric(views, known(rig), SIZE)
    np.testing.assert_array_equal(alone.theta, whole.plane_map.view.theta)
    np.testing.assert_array_equal(alone.sigma, whole.sigma)
    # Its boards stand in for those of a later calibration, whose own are too few for a camera.
    later = calibrate_metric([*alone.boards_beside(views[:2]), *views[:2]], known(rig), SIZE)
    assert sum(view.line_used for view in later.views) == 2
    np.testing.assert_allclose(later.plane_map.view.theta, alone.theta, rtol=1e-6, atol=1e-8)


def test_wrong_marks_are_set_aside_and_counted() -> None:
    rig, rng = paper_rig(), np.random.default_rng(7)
    views = [with_noise(view, 0.02, rng) for view in views_of(rig, poses(rig, rng, 4))]
    assert views[1].marks is not None
    wrong = views[1].marks.image_px.copy()
    wrong[[5, 20]] += [3.0, -2.0]
    views[1] = replace(views[1], marks=replace(views[1].marks, image_px=wrong))
    found = calibrate_camera(views, known(rig), SIZE)
    assert (found.views[1].marks_used, found.views[1].marks_found) == (46, 48)
    assert found.views[1].rms_px < 4 * 0.02


def test_a_view_without_a_board_keeps_its_reason() -> None:
    rig, rng = paper_rig(), np.random.default_rng(8)
    views = [with_noise(view, 0.02, rng) for view in views_of(rig, poses(rig, rng, 4))]
    views.insert(2, CalibrationView("dark.png", None, None, "the board was not found: too dark"))
    found = calibrate_camera(views, known(rig), SIZE)
    assert not found.views[2].used
    assert found.views[2].reason == "the board was not found: too dark"
    assert sum(view.used for view in found.views) == 4


def test_too_few_views_are_refused_with_their_reasons() -> None:
    rig = paper_rig()
    views = views_of(rig, poses(rig, np.random.default_rng(9)))[:2]
    views.append(CalibrationView("dark.png", None, None, "no board"))
    with pytest.raises(MeasurementError, match=r"needs 3 views.*usable 2.*dark.png: no board"):
        calibrate_metric(views, known(rig), SIZE)


def test_boards_that_all_face_the_camera_are_refused() -> None:
    rig, rng = paper_rig(water=False), np.random.default_rng(10)
    tilted = poses(rig, rng, 3)
    # All at one distance: size and distance cannot be distinguished.
    facing = [Pose(np.eye(3), np.array([*pose.place_mm[:2], 1000.0])) for pose in tilted]
    views = [
        with_noise(CalibrationView(f"{k}", marks_of(rig, pose), line_of(rig, tilted[k])), 0.03, rng)
        for k, pose in enumerate(facing)
    ]
    with pytest.raises(MeasurementError, match=r"do not determine the focal length.*tilts"):
        calibrate_metric(views, known(rig), SIZE)


def test_a_prior_out_of_range_is_refused() -> None:
    rig = paper_rig()
    views = views_of(rig, poses(rig, np.random.default_rng(9)))
    unchecked = OpticsSection().model_copy(update={"water_index": (0.5, 0.1)})
    with pytest.raises(InputError, match=r"optics\.water_index"):
        calibrate_metric(views, unchecked, SIZE)
