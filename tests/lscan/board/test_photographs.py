"""Real photographs: a dot board that must be read, and chessboards that must not."""

import numpy as np
import pytest
from dot_photographs import BOARD, photograph

from lscan.board import read_board
from lscan.errors import BoardNotFound

DOTS = 4380  # that lie wholly in the picture


def test_the_dot_board_is_read() -> None:
    reading = read_board(photograph("dots/dot_pattern_05.jpg"), BOARD)
    found = reading.grid.found
    assert found.sum() >= DOTS
    pixels = reading.grid.image_px[found]
    # Each dot once: the dots are 15 px apart, so no two of the reading may be within 10 px.
    lattice = reading.grid.image_px.reshape(*reading.shape, 2)
    for axis in (0, 1):
        steps = np.linalg.norm(np.diff(lattice, axis=axis), axis=-1)
        assert np.nanmin(steps) > 10 and np.nanmax(steps) < 20
    assert (np.diff(lattice[..., 0], axis=1) > 0)[
        np.isfinite(np.diff(lattice[..., 0], axis=1))
    ].all()
    # Plain blob centroids leave 0.036 px on held-out dots of this picture, with the same fifth
    # order.  A wrong index would leave a pitch, 15 px.
    board = reading.grid.board_mm[found]
    at = (board - board.mean(axis=0)) / np.abs(board - board.mean(axis=0)).max(axis=0)
    terms = [(i, j) for i in range(6) for j in range(6 - i)]
    design = np.column_stack([at[:, 0] ** i * at[:, 1] ** j for i, j in terms])
    held_out = np.arange(len(board)) % 2 == 1
    solved = np.linalg.lstsq(design[~held_out], pixels[~held_out], rcond=None)[0]
    miss = np.linalg.norm(design[held_out] @ solved - pixels[held_out], axis=1)
    assert np.sqrt(np.mean(miss**2)) <= 0.036


@pytest.mark.parametrize("number", [10, 11])
def test_a_chessboard_is_no_dot_board(number: int) -> None:
    with pytest.raises(BoardNotFound):
        read_board(photograph(f"webcam/frame{number}.jpg"), BOARD)


def test_a_bust_is_no_dot_board() -> None:
    with pytest.raises(BoardNotFound):
        read_board(photograph("webcam/bust_laser_off.png"), BOARD)
