"""What a picture must show of a board, against the reader itself on parts of one picture."""

import numpy as np
import pytest
from places import SCENES

from lscan.board import read_board
from lscan.config.documents import merge
from lscan.config.rig import load_rig, parse_rig
from lscan.errors import BoardNotFound, MeasurementError
from lscan.records import Floats
from sim.render.tank import Tank
from sim.scene import Scene, load_scene, scene_of
from sim.sensor import Webcam
from sim.studies.design.search import require_rim

pytestmark = pytest.mark.xdist_group("board_in_view")  # one worker: they share a fixture

# Left, top, right, bottom, px.  Rows lie at v of 23 to 456, columns at u of 73 to 566: beyond the
# columns there is room for one more, beyond the rows there is none.
WINDOWS = {
    "whole": ((0, 0, 640, 480), ""),
    "without its left": ((200, 0, 640, 480), ""),
    "without both sides": ((160, 0, 480, 480), "columns"),
    "without top and bottom": ((0, 160, 640, 300), "rows"),
}


def cut(window: tuple[int, int, int, int]) -> Scene:
    left, top, right, bottom = window
    base = load_rig(SCENES / "paper" / "board.toml").document
    u, v = base["lens"]["centre_px"]
    part = {
        "camera": {"width_px": right - left, "height_px": bottom - top},
        "lens": {"centre_px": [u - left, v - top]},
    }
    return scene_of(parse_rig(merge(base, part), source="cut", trusted=True))


@pytest.fixture(scope="module")
def picture() -> Floats:
    """Without noise and rounding."""
    scene = load_scene("paper/board")
    electrons = Webcam(scene).mean_electrons(Tank(scene).render(0.0, 4), 10.0)
    return electrons.reshape(480, 640, -1)[..., 0]


@pytest.mark.parametrize(("window", "cannot"), WINDOWS.values(), ids=WINDOWS)
def test_a_rim_is_required_where_the_reader_needs_one(
    picture: Floats, window: tuple[int, int, int, int], cannot: str
) -> None:
    left, top, right, bottom = window
    scene, part = cut(window), np.ascontiguousarray(picture[top:bottom, left:right])
    if cannot:
        with pytest.raises(BoardNotFound, match=cannot):
            read_board(part, scene.board())
        with pytest.raises(MeasurementError, match=f"{cannot} of dots are in view and neither"):
            require_rim(scene)
    else:
        read_board(part, scene.board())
        require_rim(scene)


def test_a_board_that_is_part_of_a_larger_one_needs_none() -> None:
    scene = cut(WINDOWS["without top and bottom"][0])
    grid = scene.board().grid.model_copy(update={"whole": False})
    board = scene.board().model_copy(update={"grid": grid})
    document = merge(scene.document, {"board": board.model_dump()})
    require_rim(scene_of(parse_rig(document, source="part", trusted=True)))
