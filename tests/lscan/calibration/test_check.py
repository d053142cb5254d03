"""The check of an old calibration against new pictures: agrees where it holds, and only there."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from planeviews import BARREL, EXACT_BOARD, View, paper_board, read_board, with_noise
from scipy import stats

from lscan.calibration.calibrate import Calibration, calibrate
from lscan.calibration.check import CalibrationCheck, check_calibration
from lscan.calibration.offsheet import Motion, closest_motion, fit_similarity
from lscan.config.rig import OpticsSection
from lscan.errors import InputError, MeasurementError
from lscan.records import BoardReading, Floats

BOARD = paper_board()
NOISE_PX = 0.05


@dataclass(frozen=True)
class OffSheet(View):
    """The view of a board that lies ``off_mm`` behind the sheet and leans by ``lean_deg``.

    The board stays the plane of the numbers; camera and sheet move against it."""

    off_mm: float = 0.0
    lean_deg: float = 0.0

    def _lean(self) -> Floats:
        cosine, sine = np.cos(np.radians(self.lean_deg)), np.sin(np.radians(self.lean_deg))
        return np.array([[1.0, 0.0, 0.0], [0.0, cosine, sine], [0.0, -sine, cosine]])

    def axes(self) -> Floats:
        return self._lean() @ super().axes()

    def eye_mm(self) -> Floats:
        x, z = self.target_mm
        eye = np.array([x, 0.0, z]) - self.distance_mm * super().axes()[:, 2]
        return self._lean() @ (eye - np.array([0.0, self.off_mm, 0.0]))


@cache
def _calibration(name: str) -> Calibration:
    return calibrate(_reading(BARREL, 1), name, OpticsSection(**EXACT_BOARD))


def _reading(view: View, seed: int) -> BoardReading:
    return read_board(BOARD, view.project, NOISE_PX, np.random.default_rng(seed))


def _check(view: View, name: str = "spline", placed_mm: float | None = None) -> CalibrationCheck:
    return check_calibration(_calibration(name), _reading(view, 2), placed_mm=placed_mm)


# --- motions ------------------------------------------------------------------------------


@examples(30)
@given(
    turn=st.floats(-3.1, 3.1),
    shift=st.tuples(st.floats(-90, 90), st.floats(-90, 90)),
    scale=st.floats(-1e-4, 1e-4),
)
def test_a_motion_and_a_scale_come_back(
    turn: float, shift: tuple[float, float], scale: float
) -> None:
    rng = np.random.default_rng(3)
    before = rng.uniform(-200, 200, (30, 2))
    centre = before.mean(axis=0)
    motion = Motion(centre, np.array(shift), turn)
    after = motion.apply(centre + (1 + scale) * (before - centre))
    np.testing.assert_allclose(closest_motion(before, after).turn_rad, turn, atol=1e-12)
    sigma, modes = rng.uniform(0.1, 0.3, (30, 2)), rng.normal(0.0, 0.02, (30, 2, 4))
    found = fit_similarity(before, after, sigma, modes)
    assert found.scale == pytest.approx(scale, abs=1e-10)
    assert found.motion.turn_rad == pytest.approx(turn, abs=1e-10)
    np.testing.assert_allclose(found.motion.shift_mm, shift, atol=1e-9)
    assert found.chi_square == pytest.approx(0.0, abs=1e-9)


def test_marks_that_show_no_scale_are_refused() -> None:
    """All of them in one place, as a map of a stranger's file may take them."""
    same = np.full((8, 2), 3.0)
    with pytest.raises(MeasurementError, match="no scale"):
        fit_similarity(same, same, np.full((8, 2), 0.1), None)


def test_similarity_is_generalised_least_squares() -> None:
    """Against the textbook formula with the whole covariance matrix written out."""
    rng = np.random.default_rng(4)
    before = rng.uniform(-200, 200, (25, 2))
    modes = rng.normal(0.0, 0.1, (25, 2, 3))
    own = rng.uniform(0.05, 0.2, (25, 2))
    after = before + rng.normal(0.0, 0.1, (25, 2))
    sigma = np.sqrt(own**2 + (modes**2).sum(axis=2))
    found = fit_similarity(before, after, sigma, modes)
    start = closest_motion(before, after)
    near = start.apply(before)
    x, z = (near - near.mean(axis=0)).T
    one, nought = np.ones(25), np.zeros(25)
    design = np.stack(
        [np.column_stack([one, nought]), np.column_stack([nought, one]),
         np.column_stack([-z, x]), np.column_stack([x, z])], axis=2,
    ).reshape(50, 4)  # fmt: skip
    flat = modes.reshape(50, 3)
    weigh = np.linalg.inv(np.diag(own.ravel() ** 2) + flat @ flat.T)
    covariance = np.linalg.inv(design.T @ weigh @ design)
    left = (after - near).ravel()
    expected = covariance @ design.T @ weigh @ left
    rest = left - design @ expected
    np.testing.assert_allclose(found.covariance, covariance, rtol=1e-8, atol=1e-18)
    assert found.scale == pytest.approx(expected[3], abs=1e-12)
    assert found.chi_square == pytest.approx(rest @ weigh @ rest, rel=1e-8)
    assert found.degrees_of_freedom == 46


# --- calibrations that hold ---------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(("name", "boards"), [("polynomial-5", 200), ("spline", 60)])
def test_false_alarms_come_at_the_stated_level(name: str, boards: int) -> None:
    """New calibration and new picture each time; the count lies in the 99.8 % interval of
    the binomial with the level for its chance."""
    level, alarms = 0.05, 0
    exact, rng = read_board(BOARD, BARREL.project, sigma_px=NOISE_PX), np.random.default_rng(5)
    for _ in range(boards):
        calibration = calibrate(with_noise(exact, NOISE_PX, rng), name)
        alarms += not check_calibration(calibration, with_noise(exact, NOISE_PX, rng), level).agrees
    low, high = stats.binom.interval(0.998, boards, level)
    assert low <= alarms <= high


@pytest.mark.parametrize("name", ["graticule-2", "projective", "polynomial-3"])
def test_coarse_maps_raise_no_false_alarm(name: str) -> None:
    """What their form misses is as large in the new picture as it was: no change."""
    assert all(
        check_calibration(_calibration(name), _reading(BARREL, seed)).agrees
        for seed in range(10, 20)
    )


def test_a_board_put_back_elsewhere_still_agrees() -> None:
    """Moved by 6 mm and turned by 0.4 degrees in the sheet: found, and not held against the
    map; unless it is said that the board was put back to 0.1 mm."""
    turn, shift = np.radians(0.4), np.array([5.0, -3.3])

    def project(xz: Floats) -> Floats:
        middle = np.array([225.0, -225.0])
        return BARREL.project(Motion(middle, shift, turn).apply(xz))

    reading = read_board(BOARD, project, NOISE_PX, np.random.default_rng(6))
    found = check_calibration(_calibration("spline"), reading)
    assert found.agrees
    assert found.turn_deg == pytest.approx(0.4, abs=4 * found.turn_sigma_deg)
    # The middle of the marks found is some 10 mm from the middle of the turn at most.
    assert np.hypot(*(np.array(found.shift_mm) - shift)) < 10 * turn + 4 * found.shift_sigma_mm[0]
    assert found.raw_rms_mm > 5.0 > 0.2 > found.rms_mm
    assert check_calibration(_calibration("spline"), reading, placed_mm=5.0).agrees
    assert check_calibration(_calibration("spline"), reading, placed_mm=0.1).reasons == ("shift",)


# --- calibrations that do not -------------------------------------------------------------

CHANGES = {
    "board 2 mm off and leaning": (
        OffSheet(k1=BARREL.k1, off_mm=2.0, lean_deg=0.5),
        "scale",
    ),
    "lens moved up 3 px": (replace(BARREL, centre_px=(319.5, 242.5)), "scale"),
    "lens moved aside 3 px": (replace(BARREL, centre_px=(322.5, 239.5)), "shape"),
    "warmer, saltier water": (replace(BARREL, n_water=1.338), "scale"),
    "focus": (replace(BARREL, focal_px=1.005 * BARREL.focal_px), "scale"),
}


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("name", ["spline", "polynomial-5", "graticule-2"])
def test_a_changed_rig_disagrees(change: str, name: str) -> None:
    view, reason = CHANGES[change]
    found = _check(view, name)
    assert not found.agrees
    assert reason in found.reasons


def test_the_board_in_the_sheet_is_the_plain_view() -> None:
    """The moved camera of these tests is the shared one where nothing is moved."""
    points = BOARD.grid.points_mm()
    np.testing.assert_allclose(
        OffSheet(k1=BARREL.k1).project(points), BARREL.project(points), atol=1e-9
    )


def test_scale_is_what_the_focus_changed() -> None:
    """A picture 0.5 % larger about the axis shows all lengths 0.5 % longer, but for what
    perspective makes of it (30 degrees and half a metre in a metre: below a third)."""
    found = _check(replace(BARREL, focal_px=1.005 * BARREL.focal_px))
    assert found.scale_error == pytest.approx(0.005, rel=1 / 3)


def test_a_wrong_mark_is_named() -> None:
    reading = _reading(BARREL, 7)
    image = reading.grid.image_px.copy()
    image[34] += [1.0, 0.0]
    found = check_calibration(
        _calibration("spline"), replace(reading, grid=replace(reading.grid, image_px=image))
    )
    assert found.worst[0].name == "control point row 4 column 5"
    assert found.worst[0].residual_mm[0] == pytest.approx(1.0, abs=0.4)
    ratios = [mark.ratio for mark in found.worst]
    assert ratios == sorted(ratios, reverse=True)
    assert found.reasons == ("shape",)


# --- refusals -----------------------------------------------------------------------------


def test_refusals() -> None:
    calibration, reading = _calibration("spline"), _reading(BARREL, 8)
    with pytest.raises(InputError, match="640 x 480"):
        check_calibration(calibration, replace(reading, image_size=(1280, 960)))
    for level in (0.0, 1.0, np.nan):
        with pytest.raises(InputError, match="level"):
            check_calibration(calibration, reading, level)
    for placed in (-1.0, np.nan, np.inf):
        with pytest.raises(InputError, match="placed_mm"):
            check_calibration(calibration, reading, placed_mm=placed)
    few = np.ones(100, dtype=bool)
    few[[0, 5, 50]] = False
    lost = read_board(BOARD, BARREL.project, NOISE_PX, np.random.default_rng(9), few)
    with pytest.raises(MeasurementError, match="a check needs 6"):
        check_calibration(calibration, replace(lost, rulers=()))
