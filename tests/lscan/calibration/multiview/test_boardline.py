"""The line is used out to the board's edge, where that is known."""

import numpy as np
from metricviews import COLUMNS, PITCH_MM, ROWS, marks_of, paper_rig, poses

from lscan.calibration.metric.views import EDGE_PX, line_on_board
from lscan.camera import project
from lscan.records import Status, Stripe

MARGIN_MM = 20.0
OUTLINE_MM = (
    -MARGIN_MM,
    (COLUMNS - 1) * PITCH_MM + MARGIN_MM,
    -(ROWS - 1) * PITCH_MM - MARGIN_MM,
    MARGIN_MM,
)


def test_the_line_reaches_to_the_boards_edge_and_no_further() -> None:
    """A line through the board's middle, parallel to its rows, in every column of the picture."""
    rig = paper_rig(water=False)
    for pose in poses(rig, np.random.default_rng(1)):
        marks = marks_of(rig, pose)
        reach = np.linspace(-400, 400, 4001)
        places = pose.place_mm + reach[:, None] * pose.rotation[:, 0]
        u, v = project(rig.camera, places).T
        columns = np.arange(640.0)
        stripe = Stripe(
            "columns", np.interp(columns, u, v), np.full(640, 0.1), np.full(640, 100.0),
            np.full(640, int(Status.OK)),
        )  # fmt: skip
        on_marks, on_board = line_on_board(stripe, marks), line_on_board(stripe, marks, OUTLINE_MM)
        half_mm = (COLUMNS - 1) * PITCH_MM / 2
        for line, end_mm in ((on_marks, half_mm), (on_board, half_mm + MARGIN_MM)):
            ends = np.interp([-end_mm, end_mm], reach, u)
            inner = line.image_px[[0, -1], 0] * [1, -1] - ends * [1, -1]
            # Never beyond; short of it by the edge kept clear (slanted by 30 degrees at most),
            # a pixel of rounding, and twice what a homography misses of this lens: 2.5 px.
            assert (inner >= 0).all()
            assert (inner < EDGE_PX / np.cos(np.radians(30)) + 1 + 5).all()


def test_without_the_boards_size_its_marks_are_the_limit() -> None:
    rig = paper_rig()
    pose = poses(rig, np.random.default_rng(2))[0]
    marks = marks_of(rig, pose)
    v = np.full(640, marks.image_px[:, 1].mean())
    stripe = Stripe("columns", v, np.full(640, 0.1), v, np.full(640, int(Status.OK)))
    line = line_on_board(stripe, marks)
    assert np.ptp(line.image_px[:, 0]) <= np.ptp(marks.image_px[:, 0])
