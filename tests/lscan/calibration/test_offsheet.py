"""How far a board stands off the sheet: poses known exactly, seen from a known place."""

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from planeviews import paper_board
from scipy.spatial.transform import Rotation

from lscan.calibration.offsheet import LinesOfSight, off_sheet, seen_from
from lscan.errors import MeasurementError
from lscan.records import PlanePoints, Status

CAMERA_MM = (225.0, -866.0, 300.0)
BOARD_MM = paper_board().grid.points_mm()
CORNERS_MM = np.array([[0.0, 0.0], [450.0, 0.0], [450.0, -450.0], [0.0, -450.0]])
MIDDLE_MM = CORNERS_MM.mean(axis=0)


def in_space(turn, place_mm, board_mm):
    """(N, 3) of board points, the middle at ``place_mm``, turned about it."""
    arm = np.column_stack(
        [board_mm[:, 0] - MIDDLE_MM[0], np.zeros(len(board_mm)), board_mm[:, 1] - MIDDLE_MM[1]]
    )
    return turn.apply(arm) + np.asarray(place_mm)


def on_sheet(points_mm, camera_mm=CAMERA_MM):
    """(N, 2) where the lines from the camera through the points cross y = 0."""
    camera = np.array(camera_mm)
    part = camera[1] / (camera[1] - points_mm[:, 1])
    return (camera + part[:, None] * (points_mm - camera))[:, [0, 2]]


def plane_points(xz_mm, sigma_mm=0.02, modes_mm=None):
    status = np.where(np.isfinite(xz_mm).all(axis=1), Status.OK, Status.OUT_OF_BOARD)
    return PlanePoints(xz_mm, np.full_like(xz_mm, sigma_mm), status, modes_mm)


def solved(xz_mm, camera_mm=CAMERA_MM, **points):
    return off_sheet(
        BOARD_MM, plane_points(xz_mm, **points), seen_from(camera_mm, xz_mm), CORNERS_MM
    )


def test_a_board_in_the_sheet_is_at_no_distance():
    found = solved(BOARD_MM)
    assert found.distance_mm == pytest.approx(0, abs=1e-9)
    assert found.corners_mm == pytest.approx(np.zeros(4), abs=1e-9)
    assert (found.tilt_x_rad, found.tilt_z_rad) == pytest.approx((0, 0), abs=1e-12)
    assert found.residual_mm == pytest.approx(np.zeros_like(BOARD_MM), abs=1e-9)


def test_a_board_moved_back_looks_smaller_and_is_behind_by_as_much():
    place = (MIDDLE_MM[0], 3.0, MIDDLE_MM[1])
    seen = on_sheet(in_space(Rotation.identity(), place, BOARD_MM))
    # Similar triangles: the picture shrinks by 866 / (866 + 3).
    assert np.ptp(seen[:, 0]) == pytest.approx(450 * 866 / 869)
    found = solved(seen)
    assert found.distance_mm == pytest.approx(3.0, abs=1e-9)
    assert found.corners_mm == pytest.approx(np.full(4, 3.0), abs=1e-9)


@examples(60)
@given(
    shift=st.tuples(*[st.floats(-20, 20)] * 3),
    tilt_deg=st.tuples(st.floats(-5, 5), st.floats(-5, 5)),
    roll_deg=st.floats(-180, 180),
)
def test_any_pose_is_found_to_rounding(shift, tilt_deg, roll_deg):
    turn = Rotation.from_euler("yzx", [roll_deg, tilt_deg[1], tilt_deg[0]], degrees=True)
    place = np.array([MIDDLE_MM[0], 0.0, MIDDLE_MM[1]]) + shift
    seen = on_sheet(in_space(turn, place, BOARD_MM))
    found = solved(seen)
    assert found.distance_mm == pytest.approx(shift[1], abs=1e-6)
    expected = in_space(turn, place, CORNERS_MM)[:, 1]
    assert found.corners_mm == pytest.approx(expected, abs=1e-6)
    normal = turn.apply([0.0, 1.0, 0.0])
    assert np.tan(found.tilt_x_rad) == pytest.approx(normal[2] / normal[1], abs=1e-8)
    assert np.tan(found.tilt_z_rad) == pytest.approx(-normal[0] / normal[1], abs=1e-8)


def test_the_signs_of_the_tilts():
    """Right-handed: about x the top comes towards the camera, about z the right goes away."""
    middle = (MIDDLE_MM[0], 0.0, MIDDLE_MM[1])
    turn = Rotation.from_euler("x", 1, degrees=True)
    leaning = solved(on_sheet(in_space(turn, middle, BOARD_MM)))
    assert np.degrees(leaning.tilt_x_rad) == pytest.approx(1)
    assert leaning.corners_mm[0] < 0 < leaning.corners_mm[3]
    turn = Rotation.from_euler("z", 1, degrees=True)
    yawed = solved(on_sheet(in_space(turn, middle, BOARD_MM)))
    assert np.degrees(yawed.tilt_z_rad) == pytest.approx(1)
    assert yawed.corners_mm[0] < 0 < yawed.corners_mm[1]


def z_scores(trials, noise_mm, camera_sigma_mm, modes=None):
    """(trials, 7) errors over stated uncertainties of distance, tilts and corners."""
    rng = np.random.default_rng(17)
    turn = Rotation.from_euler("xz", [0.5, -0.3], degrees=True)
    truth = in_space(turn, (226.0, 4.0, -224.0), BOARD_MM)
    corners = in_space(turn, (226.0, 4.0, -224.0), CORNERS_MM)[:, 1]
    normal = turn.apply([0.0, 1.0, 0.0])
    tilts = np.arctan2(normal[2], normal[1]), np.arctan2(-normal[0], normal[1])
    scores = []
    for _ in range(trials):
        camera = np.array(CAMERA_MM) + rng.normal(0, camera_sigma_mm, 3)
        xz = on_sheet(truth, camera) + rng.normal(0, noise_mm, BOARD_MM.shape)
        if modes is not None:
            xz = xz + modes @ rng.normal(size=modes.shape[2])
        own = noise_mm**2 + (0 if modes is None else (modes**2).sum(axis=2))
        points = PlanePoints(xz, np.sqrt(own + 0 * xz), np.zeros(len(xz), dtype=int), modes)
        found = off_sheet(BOARD_MM, points, seen_from(CAMERA_MM, xz, camera_sigma_mm), CORNERS_MM)
        errors = [
            found.distance_mm - 4.0,
            found.tilt_x_rad - tilts[0],
            found.tilt_z_rad - tilts[1],
            *(found.corners_mm - corners),
        ]
        sigmas = [
            found.distance_sigma_mm,
            found.tilt_x_sigma_rad,
            found.tilt_z_sigma_rad,
            *found.corners_sigma_mm,
        ]
        scores.append(np.array(errors) / sigmas)
    return np.array(scores)


TRIALS = 300
# The standard deviation of T normal numbers has the relative standard error 1 / sqrt(2 T);
# four of them are a chance of 1 in 16,000.
SPREAD = 4 / np.sqrt(2 * TRIALS)


def common_modes():
    """A map's scale, wrong by 0.1 mm at the board's edges, and its bow."""
    about = (BOARD_MM - MIDDLE_MM) / 225
    bow = 0.05 * (about**2).sum(axis=1, keepdims=True) * np.array([[0.3, 1.0]])
    return np.stack([0.1 * about, bow], axis=2)


@pytest.mark.parametrize(
    ("noise_mm", "camera_sigma_mm", "modes"),
    [(0.05, 0.0, None), (0.001, 10.0, None), (0.02, 5.0, common_modes())],
    ids=["marks", "camera", "all, and the map's"],
)
def test_the_stated_uncertainty_is_that_of_many_trials(noise_mm, camera_sigma_mm, modes):
    spread = np.sqrt((z_scores(TRIALS, noise_mm, camera_sigma_mm, modes) ** 2).mean(axis=0))
    # Uncertainties are scaled up, never down, by chance residuals: up to 5 % for 194 of them.
    assert (spread > 1 - SPREAD - 0.05).all()
    assert (spread < 1 + SPREAD).all()


def test_marks_without_a_value_are_left_out():
    seen = on_sheet(in_space(Rotation.identity(), (225.0, 2.0, -225.0), BOARD_MM))
    left_out = np.arange(len(seen)) % 7 != 0
    seen[left_out] = np.nan
    found = solved(seen)
    assert found.distance_mm == pytest.approx(2.0, abs=1e-6)
    assert (np.isnan(found.residual_mm).all(axis=1) == left_out).all()
    seen[5 * 7 :] = np.nan
    with pytest.raises(MeasurementError, match=r"5 marks .* 6 needed"):
        solved(seen)


def test_marks_in_one_line_do_not_determine_the_offset():
    line = np.zeros((20, 2))
    line[:, 0] = 20.0 * np.arange(20)
    with pytest.raises(MeasurementError, match="do not determine"):
        off_sheet(line, plane_points(line), seen_from(CAMERA_MM, line), CORNERS_MM)


def test_lines_of_sight_without_slope_do_not_determine_the_offset():
    """Seen from infinitely far and squarely, nothing changes with the distance."""
    square = LinesOfSight(np.zeros_like(BOARD_MM), np.zeros((len(BOARD_MM), 2, 0)))
    with pytest.raises(MeasurementError, match="do not determine"):
        off_sheet(BOARD_MM, plane_points(BOARD_MM), square, CORNERS_MM)
