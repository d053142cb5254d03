"""The one solver of camera and boards: its Jacobian, and its outliers."""

import numpy as np
from metricviews import paper_rig, poses, views_of

from lscan.calibration.marks import found_on
from lscan.camera.posedboards import PosedBoards, priors_of
from lscan.camera.resection import BoardMarks, _Problem, posed_boards, sound_marks
from lscan.config.rig import OpticsSection


def drawn(water: bool) -> tuple[PosedBoards, BoardMarks]:
    """Three boards before the paper's camera, near where they are, and their marks."""
    rig = paper_rig(water)
    views = views_of(rig, poses(rig, np.random.default_rng(3), 3))
    marks = found_on([view.marks for view in views if view.marks is not None], range(3))
    boards = posed_boards(rig.truth.theta, rig.truth.port, marks)
    assert boards is not None
    return boards, marks


def test_the_jacobian_is_that_of_the_residuals() -> None:
    """Of free parameters alone, each board's pose in its own rows, the priors' rows last.

    Differences of residuals of 1e2 that round at 1e-12, over steps of 1e-5, and ten times that.
    """
    boards, marks = drawn(water=True)
    known = OpticsSection(gap_mm=(30.0, 1.0), water_index=(1.34, 0.0))
    problem = _Problem(boards, marks, priors_of(known, (640, 480)))
    some = boards.theta[problem.free]
    expected = np.empty((len(problem.residuals(some)), len(some)))
    for index, value in enumerate(some):
        step = np.zeros_like(some)
        step[index] = 1e-5 * max(abs(value), 0.1)
        after, before = problem.residuals(some + step), problem.residuals(some - step)
        expected[:, index] = (after - before) / (2 * step[index])
    off = np.abs(problem.jacobian(some) - expected).max(axis=0)
    assert (off <= 1e-6 * np.abs(expected).max(axis=0)).all()


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
