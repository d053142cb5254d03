"""The truth of the board picture."""

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from truth_scenes import BOARD, tank

from lscan.errors import InputError
from lscan.records import Status
from sim.scene import Scene, rotation
from sim.truth import board_truth, project
from sim.truth.board import area_centroids

MARKS = {
    **BOARD,
    "ruler": [{"direction": "vertical", "at_mm": 75.0, "first_mm": 0.0, "last_mm": -100.0}],
    "dot": [{"name": "A1", "x_mm": 60.0, "z_mm": -30.0}],
    "ring": [{"name": "E", "x_mm": 30.0, "z_mm": -70.0, "diameter_mm": 28.4}],
}


def board(dot_mm: float = 5.0, floor: float | None = None, **target: object) -> Scene:
    """A scene with a small board about the sheet's origin, seen by a distorting lens."""
    grid = {**BOARD["grid"], "dot_diameter_mm": dot_mm}
    stand = {} if floor is None else {"floor": {"z_mm": floor}}
    return tank(
        board={**MARKS, "grid": grid},
        target={"shape": "board", **target},
        lens={"k1": -0.22, "k2": 0.06},
        **stand,
    )


@examples(25)
@given(
    at=st.tuples(st.floats(-80, 0), st.floats(-40, 40), st.floats(-60, 60)),
    turn=st.floats(-20, 20),
    tilt=st.floats(-20, 20),
    yaw=st.floats(-5, 5),
    position=st.floats(-20, 20),
)
def test_marks_are_the_board_s_places_projected(at, turn, tilt, yaw, position):
    scene = tank(
        board=MARKS,
        target={"shape": "board", "position_mm": list(at), "turn_deg": turn, "tilt_x_deg": tilt},
        head={"yaw_deg": yaw},
    )
    truth = board_truth(scene, position).centres
    x, z = np.meshgrid([0.0, 50, 100, 150], [0.0, -50, -100])
    grid = np.column_stack([x.ravel(), z.ravel()])
    assert np.array_equal(truth.grid.board_mm, grid)

    def direct(xz: np.ndarray) -> np.ndarray:
        flat = np.column_stack([xz[:, 0], 0 * xz[:, 0], xz[:, 1]])
        head = flat @ rotation("ZX", (turn, tilt)).T + at
        # The head has gone on by ``position`` along the track, which it sees at -yaw.
        angle = np.radians(yaw)
        return project(scene, head - position * np.array([np.sin(angle), np.cos(angle), 0]))

    shown = truth.grid.found
    assert np.abs(truth.grid.image_px - direct(grid))[shown].max(initial=0) < 1e-9
    assert np.abs(truth.dots["A1"].image_px - direct(np.array([[60.0, -30.0]]))[0]).max() < 1e-9
    ring = np.array([[30 + 14.2, -70.0], [30.0, -70 + 14.2]])
    assert np.abs(truth.rings["E"].image_px[[0, 18]] - direct(ring)).max() < 1e-9
    marks = truth.rulers[0].marks
    ruler = np.column_stack([np.full(11, 75.0), -10.0 * np.arange(11)])
    assert np.abs(marks.image_px - direct(ruler))[marks.found].max(initial=0) < 1e-9


def test_a_dot_s_centroid_is_off_its_centre_by_the_square_of_its_size():
    small, large = (board_truth(board(dot)) for dot in (5.0, 10.0))
    bias = [
        np.linalg.norm(t.centroids.grid.image_px - t.centres.grid.image_px, axis=1)
        for t in (small, large)
    ]
    assert 1e-4 < bias[0].max() < 0.01  # a dot of 5 px: small, but there
    # Second order in the diameter; the fourth adds some (5 px / 850 px)2 of it.
    assert bias[1] == pytest.approx(4 * bias[0], rel=1e-3)


def test_the_centroid_of_known_areas():
    square = [[0, 0], [2, 0], [2, 2], [0, 2.0]]
    # A triangle, centroid (4, 0.5) / 3, with a spike of no area on top.
    spiked = [[0, 0], [4, 0], [0, 0.5], [0, 4.0]]
    found = area_centroids(np.array([square, square[::-1], spiked]))
    assert found == pytest.approx(np.array([[1, 1], [1, 1], [4 / 3, 0.5 / 3]]), abs=1e-12)


def test_an_outline_with_a_corner_that_has_no_picture_has_no_centroid():
    square = np.array([[0.0, 0], [2, 0], [2, 2], [0, 2]])
    broken = square.copy()
    broken[2] = np.nan
    found = area_centroids(np.array([square, broken, square + 1]))
    assert np.array_equal(found, [[1, 1], [np.nan, np.nan], [2, 2]], equal_nan=True)
    assert np.isnan(area_centroids(np.array([broken]))).all()


def test_marks_outside_the_picture_say_so():
    truth = board_truth(board(position_mm=[150.0, 0.0, 0.0])).centres
    status = truth.grid.status.reshape(3, 4)
    assert np.all(status[:, 0] == Status.OK)
    assert np.all(status[:, -1] == Status.OUT_OF_VIEW)
    assert np.array_equal(np.isnan(truth.grid.image_px[:, 0]), ~truth.grid.found)
    assert np.array_equal(np.isnan(truth.grid.sigma_px), ~truth.grid.found)


def test_marks_beneath_the_floor_are_hidden():
    status = board_truth(board(floor=-75.0)).centres.grid.status.reshape(3, 4)
    assert np.all(status[:2] == Status.OK)
    assert np.all(status[2] == Status.OCCLUDED)


def test_a_mark_is_where_the_head_saw_it_from_in_its_row_s_time():
    moving = {"head": {"speed_mm_s": 80.0}, "sensor": {"readout_ms": 30.0}}
    scene = tank(board=MARKS, target={"shape": "board"}, **moving)
    marks = board_truth(scene, 2.0).centres.grid
    assert marks.found.all()
    for place, pixel in zip(marks.board_mm, marks.image_px, strict=True):
        position = 2.0 + 80.0 * 0.030 * (pixel[1] / 480 - 0.5)
        head = np.array([[place[0], -position, place[1]]])
        assert project(scene, head)[0] == pytest.approx(pixel, abs=1e-9)
    still = board_truth(tank(board=MARKS, target={"shape": "board"}), 2.0).centres.grid
    assert np.abs(marks.image_px - still.image_px).max() > 0.05  # else nothing moved


def test_the_back_of_the_board_shows_no_marks():
    truth = board_truth(board(turn_deg=180.0, position_mm=[75.0, 0.0, 0.0])).centres
    assert np.all(truth.grid.status == Status.OCCLUDED)
    assert np.isnan(truth.dots["A1"].image_px).all()


def test_another_target_is_refused():
    with pytest.raises(InputError, match=r"not the board.*'none'"):
        board_truth(tank())
