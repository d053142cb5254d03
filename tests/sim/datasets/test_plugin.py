"""The fixture `tank`: scenes rendered in a test, each once."""

import numpy as np
import pytest

from lscan.board import read_board
from lscan.errors import InputError
from lscan.records import Status
from lscan.stripe import extract_stripe

SMALL = {
    "camera": {"width_px": 64, "height_px": 80},
    "lens": {"centre_px": [159.5, -112.5]},
    "render": {"samples": 1, "scatter_samples": 0},
}


def test_a_scene_is_rendered_once_and_its_line_found(tank):
    """Of a few samples a pixel the line is good to a tenth of one."""
    case = tank("paper/groove", SMALL)
    assert tank("paper/groove", SMALL) is case
    assert tank("paper/groove", {**SMALL, "sensor": {"seed": 7}}) is not case
    found = extract_stripe(case.picture, case.settings)
    both = (found.status == Status.OK) & (case.truth.status == Status.OK)
    assert both.sum() > 20
    assert np.median(np.abs(found.centre_px - case.truth.centre_px)[both]) < 0.5


def test_a_board_is_a_case_of_the_board(tank):
    case = tank("paper/board", {"render": {"samples": 16}})
    reading = read_board(case.picture, case.board)
    off = reading.grid.image_px - case.marks.image_px[:100]
    assert np.abs(np.nanmean(off, axis=0)).max() < 0.02
    assert len(case.map_px) == 625


def test_a_scene_that_is_none_is_refused(tank):
    with pytest.raises(InputError, match="nobodys"):
        tank("nobodys/scene")
    with pytest.raises(InputError, match=r"camera\.width_px"):
        tank("paper/groove", {"camera": {"width_px": -1}})
