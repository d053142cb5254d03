"""The one solver of camera and boards: its derivatives, and its outliers."""

import numpy as np
from metricviews import paper_rig, poses, views_of

from lscan.calibration.readings import found_on
from lscan.camera.boards import PosedBoards
from lscan.camera.fit import BoardMarks, sound_marks
from lscan.camera.parameters import CAMERA
from lscan.camera.start import posed_boards

COUNT = len(CAMERA)


def drawn(water: bool) -> tuple[PosedBoards, BoardMarks]:
    """Three boards before the paper's camera, near where they are, and their marks."""
    rig = paper_rig(water)
    views = views_of(rig, poses(rig, np.random.default_rng(3), 3))
    marks = found_on([view.marks for view in views if view.marks is not None], range(3))
    boards = posed_boards(rig.truth.theta, rig.truth.port, marks)
    assert boards is not None
    return boards, marks


def test_a_pixel_located_on_a_board_is_projected_back() -> None:
    """Each board has its own pose; to Newton's 1e-10 tangents, some 1e-7 px of 850."""
    boards, marks = drawn(water=True)
    for number in range(3):
        image = marks.image_px[marks.board == number]
        back = boards.project(boards.locate(image, number), number)
        np.testing.assert_allclose(back, image, rtol=0, atol=1e-6)


def test_outliers_are_judged_by_the_usual_residual() -> None:
    """Where all residuals are ten times what they should be, 6 sigmas are usual."""
    lengths = np.abs(np.random.default_rng(5).standard_normal((200, 2))) @ np.array([0.5, 0.5])
    lengths[17] = 8.0
    for size in (1.0, 10.0):
        assert np.flatnonzero(~sound_marks(size * lengths)).tolist() == [17]
