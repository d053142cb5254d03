"""The one solver of camera and boards: its derivatives, and its outliers."""

from dataclasses import replace

import numpy as np
import pytest
from metricviews import paper_rig, poses, views_of

from lscan.calibration.readings import found_on
from lscan.camera.boards import POSE, PosedBoards, parameter_derivatives
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


@pytest.mark.parametrize("water", [False, True])
def test_derivatives_agree_with_differences(water: bool) -> None:
    boards, marks = drawn(water)
    free = np.ones(COUNT, dtype=bool)

    def picture(some: PosedBoards) -> np.ndarray:
        return some.project(marks.board_mm, marks.board)

    by_own = parameter_derivatives(picture, boards, free)
    rng = np.random.default_rng(4)
    for _ in range(5):
        step = rng.standard_normal(len(boards.theta)) * 1e-6
        after, before = (picture(replace(boards, theta=boards.theta + w * step)) for w in (1, -1))
        own = np.column_stack(
            [np.tile(step[:COUNT], (len(marks.board), 1)), step[COUNT:].reshape(3, -1)[marks.board]]
        )
        expected = np.einsum("ndp,np->nd", by_own, own)
        # Rounding of a projection is 1e-12 px in a difference of some 1e-4.
        np.testing.assert_allclose((after - before) / 2, expected, rtol=1e-4, atol=1e-8)


def test_held_parameters_have_no_derivative() -> None:
    boards, marks = drawn(water=True)
    free = np.zeros(COUNT, dtype=bool)
    free[0] = True
    by_own = parameter_derivatives(
        lambda some: some.project(marks.board_mm, marks.board), boards, free
    )
    assert by_own.shape == (len(marks.board), 2, COUNT + len(POSE))
    assert (by_own[:, :, 1:COUNT] == 0).all()
    assert (by_own[:, :, 0] != 0).any()


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
