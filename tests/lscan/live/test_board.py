"""What the live page says of a board: residuals, and how far it is from the sheet."""

import json

import numpy as np
import pytest
from planeviews import EXACT_BOARD, View, paper_board, read_board, with_noise
from scipy.spatial.transform import Rotation

import lscan.live.analysis as boardview
from lscan.calibration.calibrate import calibrate
from lscan.config.rig import (
    CalibrationSection,
    CameraSection,
    OpticsSection,
    Rig,
    SheetSection,
    TrackSection,
)
from lscan.errors import BoardNotFound
from lscan.live.analysis import NO_PLACE, UNCALIBRATED, board_json, read_live_board

IMAGE = np.zeros((480, 640), dtype=np.uint8)
BOARD = paper_board()
VIEW = View(water=False, k1=0.0, k2=0.0)
MIDDLE_MM = np.array([225.0, -225.0])


def rig(**sections):
    return Rig(
        camera=CameraSection(driver="fake"),
        track=TrackSection(driver="fake"),
        calibration=CalibrationSection(plane_map="projective"),
        **sections,
    )


def sheet():
    camera_mm = tuple(float(x) for x in VIEW.eye_mm())
    return SheetSection(thickness_mm=1.0, camera_mm=camera_mm, apex_mm=(225.0, 0.0, 500.0))


def moved(turn, shift_mm):
    """The projection of the board turned about its middle and shifted by (x, y, z)."""

    def project(xz_mm):
        arm = np.column_stack([xz_mm - MIDDLE_MM, np.zeros(len(xz_mm))])[:, [0, 2, 1]]
        place = np.array([MIDDLE_MM[0], 0.0, MIDDLE_MM[1]]) + shift_mm
        seen = (turn.apply(arm) + place - VIEW.eye_mm()) @ VIEW.axes()
        return VIEW.focal_px * seen[:, :2] / seen[:, 2:] + np.array(VIEW.centre_px)

    return project


@pytest.fixture
def seen(monkeypatch):
    """Set what the reader of boards finds in the picture."""

    def show(result):
        def read(image, board, channel):
            if isinstance(result, Exception):
                raise result
            return result

        monkeypatch.setattr(boardview, "read_board", read)

    return show


def solved_map():
    exact = OpticsSection(**EXACT_BOARD)
    return calibrate(read_board(BOARD, VIEW.project), "projective", exact).plane_map


def test_a_picture_without_a_board_says_why(seen):
    seen(BoardNotFound("the board was not found: too dark"))
    board = read_live_board(IMAGE, BOARD, rig(), None)
    document = board_json(board, 0.5)
    assert (document["found"], document["expected"], document["age_s"]) == (0, 100, 0.5)
    assert "too dark" in document["message"]
    assert document["marks_px"] == []
    assert document["residual_rms_px"] is document["offset"] is None


def test_without_a_calibration_the_residuals_are_the_rigs_own_maps(seen):
    reading = with_noise(read_board(BOARD, VIEW.project), 0.1, np.random.default_rng(6))
    seen(reading)
    board = read_live_board(IMAGE, BOARD, rig(), None)
    solved = calibrate(reading, "projective")
    assert board.residual_px[0] == pytest.approx(solved.rms_px)
    assert board.residual_mm == pytest.approx((solved.rms_mm, solved.max_mm))
    assert (board.offset, board.offset_message) == (None, UNCALIBRATED)


def test_without_the_cameras_place_it_says_which_key_to_add(seen):
    seen(read_board(BOARD, moved(Rotation.identity(), [0.0, 0.0, 1.0])))
    board = read_live_board(IMAGE, BOARD, rig(), solved_map())
    assert (board.offset, board.offset_message) == (None, NO_PLACE)
    assert "camera_mm" in NO_PLACE
    # Up by 1 mm in the sheet, which is nobody's fault but the board's.
    assert board.residual_mm == pytest.approx((1.0, 1.0), abs=1e-6)


def test_the_offset_of_a_board_from_the_sheet_has_its_sign(seen):
    turn = Rotation.from_euler("x", 0.5, degrees=True)
    seen(read_board(BOARD, moved(turn, [0.3, 2.0, -0.4])))
    board = read_live_board(IMAGE, BOARD, rig(sheet=sheet()), solved_map())
    document = board_json(board, 0.0)
    json.dumps(document, allow_nan=False)
    assert document["found"] == document["expected"] == 100
    assert document["offset"]["distance_mm"] == pytest.approx(2.0, abs=1e-3)
    assert document["offset"]["tilt_x_deg"] == pytest.approx(0.5, abs=1e-3)
    swing = 225 * np.sin(np.radians(0.5))
    expected = [2 - swing, 2 - swing, 2 + swing, 2 + swing]  # upper pair, then lower pair
    assert document["offset"]["corners_mm"] == pytest.approx(expected, abs=2e-3)
    # The place of the camera, 10 mm in 866 mm, makes about 1.2 % of 2 mm.
    assert 0.02 < document["offset"]["sigma_mm"] < 0.05
    # What the pose explains is no residual.
    assert document["residual_rms_px"] < 1e-3


def test_too_few_marks_in_the_calibrated_part_are_reported(seen):
    seen(read_board(BOARD, moved(Rotation.identity(), [600.0, 0.0, 0.0])))
    board = read_live_board(IMAGE, BOARD, rig(sheet=sheet()), solved_map())
    assert board.offset is None
    assert "needed to determine the board's distance" in board.offset_message
