"""Calibrations corrected by a new picture of the board: scale, shift, index of the water."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from metricviews import SIZE, known, paper_rig, poses, views_of
from planeviews import BARREL, EXACT_BOARD, View, paper_board, read_board

from lscan.calibration import physical
from lscan.calibration.calibrate import Calibration, calibrate
from lscan.calibration.calibrationfile import (
    AnyCalibration,
    load_any,
    load_plane_map,
    save_calibration,
)
from lscan.calibration.check import (
    CalibrationCheck,
    check_calibration,
    corrected_calibration,
    fitting_corrections,
)
from lscan.calibration.metric.solve import calibrate_metric
from lscan.calibration.planemap import Estimate, SheetCorrection
from lscan.camera import project
from lscan.config.rig import OpticsSection
from lscan.errors import InputError, MeasurementError
from lscan.records import BoardReading, Floats, Marks, Status

pytestmark = pytest.mark.xdist_group("update")  # one worker: they share what is calibrated

BOARD = paper_board()
NOISE_PX = 0.05
MOVED = np.array([0.8, -0.5])
PLACES = np.array([[50.0, -50.0], [225, -200], [300, -300], [100, -350], [400, -100]])
KNOWN = OpticsSection(
    focal_px=(850.0, 5.0),
    gap_mm=(10.0, 0.5),
    thickness_mm=(6.0, 0.1),
    glass_index=(1.49, 0.001),
    water_index=(1.331, 0.0002),
    **EXACT_BOARD,
)


@pytest.fixture(autouse=True)
def without_tables(monkeypatch: pytest.MonkeyPatch) -> None:
    """Uncertainties computed pixel by pixel, as the tables have them (test_pixeltable.py).

    Tables for every index that is tried take longer than the marks of one picture.
    """
    monkeypatch.setattr(physical, "pixel_table", lambda *_: None)


def _reading(view: View, seed: int) -> BoardReading:
    return read_board(BOARD, view.project, NOISE_PX, np.random.default_rng(seed))


def _enlarged(view: View, factor: float) -> BoardReading:
    """A picture of the board as if all lengths of it were so many times as long."""
    return read_board(
        BOARD, lambda xz: view.project(xz * factor), NOISE_PX, np.random.default_rng(5)
    )


@examples(30)
@given(
    scale=st.floats(-0.1, 0.1),
    shift=st.tuples(st.floats(-5, 5), st.floats(-5, 5)),
    middle=st.tuples(st.floats(-300, 300), st.floats(-300, 300)),
)
def test_a_correction_undoes_the_error_it_is_made_for(
    scale: float, shift: tuple[float, float], middle: tuple[float, float]
) -> None:
    """To rounding, 1e-9 mm of some 300; lengths shrink with their sigmas by 1 + scale."""
    wrong = np.array(middle) + (PLACES - np.array(middle)) * (1 + scale) + np.array(shift)
    modes = np.random.default_rng(1).normal(size=(len(PLACES), 2, 3))
    given_ = Estimate(wrong, (modes**2).sum(axis=2), modes)
    correction = SheetCorrection(middle_mm=np.array(middle), scale=scale, shift_mm=np.array(shift))
    found = correction.apply(given_)
    np.testing.assert_allclose(found.xz_mm, PLACES, atol=1e-9)
    np.testing.assert_allclose(found.variance_mm2, given_.variance_mm2 / (1 + scale) ** 2)
    assert found.modes_mm is not None
    np.testing.assert_allclose((found.modes_mm**2).sum(axis=2), found.variance_mm2)


def test_a_correction_adds_its_uncertainty() -> None:
    """By propagation: sigma_scale times the arm, and the shift's own, each by itself."""
    correction = SheetCorrection(
        middle_mm=np.array([200.0, -200.0]),
        scale_sigma=1e-3,
        shift_sigma_mm=np.array([0.3, 0.4]),
    )
    bare = Estimate(PLACES, np.zeros(PLACES.shape), np.zeros((len(PLACES), 2, 0)))
    arm = 1e-3 * (PLACES - [200.0, -200.0])
    expected = np.hypot(arm, [0.3, 0.4])
    corrected = correction.apply(bare)
    np.testing.assert_allclose(np.sqrt(corrected.variance_mm2), expected)
    assert corrected.modes_mm is not None  # all points share them: they are modes, and all of it
    np.testing.assert_allclose(np.linalg.norm(corrected.modes_mm, axis=2), expected)
    without = correction.apply(Estimate(PLACES, np.zeros(PLACES.shape)))  # as a graticule has it
    np.testing.assert_array_equal(without.modes_mm, corrected.modes_mm)
    np.testing.assert_allclose(np.sqrt(without.variance_mm2), expected)


def test_a_scale_is_corrected_and_then_agrees() -> None:
    """A lens refocused by 0.4 %: lengths come out within 4 of the sigmas that the file states."""
    calibration = calibrate(_reading(BARREL, 1), "spline")
    reading = _enlarged(BARREL, 1.004)
    found = check_calibration(calibration, reading)
    assert found.reasons == ("scale",) and fitting_corrections(found) == ("scale",)
    assert found.index is None
    better = corrected_calibration(calibration, reading, ("scale",))
    assert check_calibration(better, _enlarged(BARREL, 1.004)).agrees
    points = better.plane_map.to_plane(BARREL.project(1.004 * PLACES))
    known_ = points.status == Status.OK
    length = np.hypot(*np.diff(points.xz_mm[known_], axis=0).T)
    true = np.hypot(*np.diff(PLACES[known_], axis=0).T)
    assert (np.abs(length - true) < 4 * np.hypot(*points.sigma_mm.max(axis=0))).all()


def test_a_shift_is_corrected_where_the_placing_is_known() -> None:
    calibration = calibrate(_reading(BARREL, 1), "polynomial-5")
    moved = read_board(
        BOARD, lambda xz: BARREL.project(xz + MOVED), NOISE_PX, np.random.default_rng(6)
    )
    found = check_calibration(calibration, moved, placed_mm=0.05)
    assert "shift" in found.reasons and fitting_corrections(found)[-1] == "shift"
    better = corrected_calibration(calibration, moved, ("shift",), placed_mm=0.05)
    again = check_calibration(better, moved, placed_mm=0.05)
    assert "shift" not in again.reasons
    points = better.plane_map.to_plane(BARREL.project(PLACES + MOVED))
    known_ = points.status == Status.OK
    assert (np.abs(points.xz_mm - PLACES)[known_] < 4 * points.sigma_mm[known_]).all()
    assert (points.sigma_mm[known_] >= 0.05).all()


def test_what_does_not_mend_it_is_not_proposed() -> None:
    """Of a picture cropped elsewhere an index of 1.31 leaves 150 times what noise explains."""
    calibration, _, _ = _in_sea()
    cropped = replace(View(n_water=1.331), centre_px=(319.5, 209.5))
    found = check_calibration(calibration, _reading(cropped, 2))
    assert "scale" in found.reasons and fitting_corrections(found) == ()


def test_an_index_that_no_water_has_is_not_proposed() -> None:
    """The board of another rig say: it fits best with an index of 1.39, and a scale is off."""
    found = _found_in_sea()
    assert found.index is not None and fitting_corrections(found) == ("index",)
    glass = replace(found, index=replace(found.index, index=1.392))
    assert fitting_corrections(glass) == ("scale",)


@cache
def _in_sea() -> tuple[Calibration, View, BoardReading]:
    """A refractive calibration in tap water, and the same rig and board in sea water."""
    tap = View(n_water=1.331)
    sea = replace(tap, n_water=1.339)
    calibration = calibrate(_reading(tap, 1), "refractive", KNOWN)
    return calibration, sea, _reading(sea, 2)


@cache
def _found_in_sea() -> CalibrationCheck:
    calibration, _, reading = _in_sea()
    return check_calibration(calibration, reading)


@cache
def _corrected_in_sea() -> AnyCalibration:
    calibration, _, reading = _in_sea()
    return corrected_calibration(calibration, reading, ("index",))


def test_another_water_is_found_and_corrected(tmp_path: Path) -> None:
    _, sea, _ = _in_sea()
    found = _found_in_sea()
    assert not found.agrees and fitting_corrections(found) == ("index",)
    assert found.index is not None
    assert abs(found.index.index - 1.339) < 4 * found.index.sigma
    assert found.index.sigma < 0.002
    better = _corrected_in_sea()  # by what was proposed
    assert check_calibration(better, _reading(sea, 3)).agrees
    points = better.plane_map.to_plane(sea.project(PLACES))
    assert (np.abs(points.xz_mm - PLACES) < 4 * points.sigma_mm).all()
    save_calibration(tmp_path / "better.json", better)
    again, size = load_plane_map(tmp_path / "better.json")
    assert size == (640, 480)
    np.testing.assert_array_equal(again.to_plane(sea.project(PLACES)).xz_mm, points.xz_mm)


def test_lengths_are_known_where_the_index_is_not() -> None:
    """Of a calibration that knows its water to 0.003 only, a picture in the sea finds the index to
    no better than that, and with it the scale of the picture, which is all that lengths need."""
    tap, sea = View(n_water=1.331), View(n_water=1.339)
    vague = KNOWN.model_copy(update={"water_index": (1.333, 0.003), "focal_px": (850.0, 80.0)})
    calibration = calibrate(_reading(tap, 1), "refractive", vague)
    index = check_calibration(calibration, _reading(sea, 2)).index
    assert index is not None and 0.002 < index.sigma < 0.005
    better = corrected_calibration(calibration, _reading(sea, 2), ("index",))
    points = better.plane_map.to_plane(sea.project(PLACES))
    assert points.modes_mm is not None
    modes = np.linalg.norm(points.modes_mm[1:, 0] - points.modes_mm[0, 0], axis=1)
    error = points.xz_mm[1:, 0] - points.xz_mm[0, 0] - (PLACES[1:, 0] - PLACES[0, 0])
    assert (modes < 0.1).all() and (np.abs(error) < 4 * modes).all()


def test_a_stated_water_explains_the_difference() -> None:
    """The rig of the new picture says that it is in the sea: nothing is left to correct."""
    calibration, _, reading = _in_sea()
    stated = KNOWN.model_copy(update={"water_index": (1.339, 0.0002)})
    found = check_calibration(calibration, reading, optics=stated)
    assert found.agrees and fitting_corrections(found) == ()
    spline = calibrate(calibration.reading, "spline", KNOWN)
    with pytest.raises(InputError, match="cannot be carried"):
        check_calibration(spline, reading, optics=stated)


def test_a_map_without_water_has_no_index_to_correct() -> None:
    calibration = calibrate(_reading(BARREL, 1), "polynomial-5")
    with pytest.raises(InputError, match="index of the water"):
        corrected_calibration(calibration, _reading(BARREL, 2), ("index",))


def _dots_in_sheet(index: float) -> BoardReading:
    """The paper rig's own sheet with the paper board in it, seen through water of that index."""
    rig = paper_rig()
    port = rig.camera.port
    assert port is not None
    camera = replace(rig.camera, port=replace(port, water_index=index))
    truth = rig.truth
    origin = truth.meet(truth.origin_px[None])[0]

    def seen(xz_mm: Floats) -> Floats:
        local = 0.9 * (xz_mm - [225.0, -225.0])  # a smaller board, wholly in view
        return project(camera, origin + local @ truth.axes[:, [0, 2]].T)

    reading = read_board(BOARD, seen, NOISE_PX, np.random.default_rng(4))

    def smaller(marks: Marks) -> Marks:
        return replace(marks, board_mm=0.9 * marks.board_mm)

    rulers = tuple(replace(ruler, marks=smaller(ruler.marks)) for ruler in reading.rulers)
    return replace(reading, grid=smaller(reading.grid), rulers=rulers)


def test_a_metric_calibration_is_checked_and_corrected(tmp_path: Path) -> None:
    rig = paper_rig()
    views = views_of(rig, poses(rig, np.random.default_rng(3)))
    calibration = calibrate_metric(views, known(rig), SIZE)
    assert check_calibration(calibration, _dots_in_sheet(1.3313)).agrees
    sea = _dots_in_sheet(1.339)
    found = check_calibration(calibration, sea)
    assert not found.agrees and fitting_corrections(found) == ("index",)
    better = corrected_calibration(calibration, sea, ("index",))
    save_calibration(tmp_path / "better.json", better)
    assert check_calibration(load_any(tmp_path / "better.json"), sea).agrees
    with pytest.raises(InputError, match=r"placed_mm.*one picture"):
        check_calibration(calibration, sea, placed_mm=0.1)
    with pytest.raises(InputError, match=r"placed_mm.*one picture"):
        corrected_calibration(calibration, sea, ("shift",))
    assert calibration.plane_map.name == "metric"


@pytest.mark.slow
def test_an_index_is_sought_where_indices_are() -> None:
    """A window in air is a port with an index of 1, below which there is none."""
    dry = replace(BARREL, n_water=1.0)
    in_air = KNOWN.model_copy(update={"water_index": (1.0, 0.0)})
    found = check_calibration(calibrate(_reading(dry, 1), "refractive", in_air), _reading(dry, 2))
    assert found.agrees and found.index is not None
    assert 1.0 <= found.index.index < 1.0 + 4 * found.index.sigma


@pytest.mark.slow
def test_a_correction_of_the_index_does_not_blind_the_next_check() -> None:
    """What the marks seen through fresh water miss by in the sea is no fault of the map's form.

    So a lens refocused by 0.5 % on the corrected rig shows in the scale and in the shape.
    """
    _, sea, _ = _in_sea()
    better = _corrected_in_sea()
    refocused = _reading(replace(sea, focal_px=1.005 * sea.focal_px), 4)
    assert check_calibration(better, refocused).reasons == ("scale", "shape")


def test_what_no_correction_can_be_made_of_is_refused() -> None:
    calibration = calibrate(_reading(BARREL, 1), "polynomial-5")
    reading = _reading(BARREL, 2)
    with pytest.raises(InputError, match=r"placed_mm: a shift"):
        corrected_calibration(calibration, reading, ("shift",))
    with pytest.raises(InputError, match="image size"):
        corrected_calibration(calibration, replace(reading, image_size=(320, 240)), ("scale",))

    def half(marks: Marks) -> Marks:
        return replace(marks, board_mm=marks.board_mm / 2)

    rulers = tuple(replace(ruler, marks=half(ruler.marks)) for ruler in reading.rulers)
    other = replace(reading, grid=half(reading.grid), rulers=rulers)
    with pytest.raises(MeasurementError, match=r"off by \+100 %"):
        corrected_calibration(calibration, other, ("scale",))
