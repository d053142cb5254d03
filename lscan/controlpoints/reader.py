"""Reading the whole calibration board from one picture, stage by stage."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lscan.board import Board, Grid
from lscan.controlpoints.evidence import fault_of
from lscan.controlpoints.features import Contrast, mark_status, read_dot, read_ruler
from lscan.controlpoints.lattice import (
    LocalMap,
    completed,
    dot_part,
    drop_strays,
    grid_points_mm,
    local_map,
    place_on_board,
)
from lscan.controlpoints.picture import Image, Picture, bright_marks, noise_of, prepare
from lscan.controlpoints.rings import read_ring
from lscan.controlpoints.search import Nodes, grow
from lscan.controlpoints.seeds import check_seeds, propose_seeds
from lscan.errors import BoardNotFound, InputError
from lscan.records import BoardReading, Floats, Marks
from lscan.rig import Channel


def read_board(
    image: NDArray[Any],
    board: Board,
    *,
    seeds: Floats | None = None,
    channel: Channel = "grey",
) -> BoardReading:
    """All marks of the calibration board found in one picture (Sec. III.1 and III.3).

    image: (H, W), or (H, W, 3) RGB, integer or float grey values.
    board: which marks there are.  With ``grid.whole`` False the origin is the upper left node
        of those seen, and the reading has as many rows and columns as are seen.
    seeds: (3, 2) of (u, v) px of dots #1 (the upper left one), #2 (beneath it) and #3 (to its
        right), each good to a third of the pitch; found in the picture where None.  Dots
        above and to the left of #1 are not looked for.
    channel: of a colour picture.

    Raises InputError for what is no picture, for seeds that are no corner of a grid, and for
    rulers, dots or rings on a board with ``whole`` False unless seeds say where O is.  Raises
    BoardNotFound where there is no board, too little of it, or no telling which dot is O.
    """
    bright = bright_marks(image, channel, board.marks)
    if seeds is None:
        _check_origin_known(board)
        picture, nodes = _search_from_anywhere(bright, board)
    else:
        picture, nodes = _search_from(bright, board, check_seeds(seeds, bright.shape[::-1]))
    mapping = local_map(completed(nodes, board.grid.pitch_mm), board.grid.pitch_mm)
    contrast = Contrast.of(nodes, mapping, board.grid.dot_diameter_mm)
    return BoardReading(
        image_size=picture.size,
        pitch_mm=board.grid.pitch_mm,
        shape=(nodes.height.shape[0], nodes.height.shape[1]),
        grid=_grid_marks(picture, nodes, mapping, board.grid),
        rulers=tuple(read_ruler(picture, mapping, contrast, ruler) for ruler in board.ruler),
        dots={dot.name: read_dot(picture, mapping, contrast, dot) for dot in board.dot},
        rings={ring.name: read_ring(picture, mapping, contrast, ring) for ring in board.ring},
    )


def _check_origin_known(board: Board) -> None:
    if not board.grid.whole and (board.ruler or board.dot or board.ring):
        raise InputError(
            "rulers, dots and rings cannot be placed where the origin is whichever dot is seen",
            where="board",
            allowed="grid.whole = true, seeds that say which dot is O, or control points alone",
        )


def _search_from_anywhere(bright: Image, board: Board) -> tuple[Picture, Nodes]:
    """The dots found from the first automatic seeds that lead to a board."""
    grid = board.grid
    faults = []
    for seeds in propose_seeds(bright, board, noise_of(bright)):
        radius_px = _dot_radius(seeds, grid)
        picture = prepare(bright, radius_px)
        shape = (2 * grid.rows + 1, 2 * grid.columns + 1)  # the seed may be any dot of the board
        nodes = grow(picture, seeds, shape, (grid.rows, grid.columns), dot_part(grid))
        drop_strays(nodes, grid.pitch_mm)
        fault = fault_of(picture, nodes, grid)
        if fault is None:
            part = nodes.part(nodes.extent())
            return picture, place_on_board(picture, part, grid, radius_px)
        faults.append((int(nodes.found.sum()), fault))
    most = max(faults, key=lambda found: found[0])
    raise BoardNotFound(f"the board was not found: {most[1]}")


def _search_from(bright: Image, board: Board, seeds: Floats) -> tuple[Picture, Nodes]:
    """The dots found from seeds given by hand, the first of which is the origin."""
    grid = board.grid
    picture = prepare(bright, _dot_radius(seeds, grid))
    nodes = grow(picture, seeds, (grid.rows, grid.columns), (0, 0), dot_part(grid))
    drop_strays(nodes, grid.pitch_mm)
    fault = fault_of(picture, nodes, grid)
    if fault is not None:
        given = np.round(seeds, 1).tolist()
        raise BoardNotFound(f"the board was not found from the seeds {given}: {fault}")
    if grid.whole:
        return picture, nodes
    rows, columns = nodes.extent()
    return picture, nodes.part((slice(0, rows.stop), slice(0, columns.stop)))


def _dot_radius(seeds: Floats, grid: Grid) -> float:
    """Radius of a control dot, px, from the distances of the seeds."""
    pitch_px = float(np.linalg.norm(seeds[1:] - seeds[0], axis=1).mean())
    return pitch_px * dot_part(grid) / 2


def _grid_marks(picture: Picture, nodes: Nodes, mapping: LocalMap, grid: Grid) -> Marks:
    board = grid_points_mm(nodes.height.shape, grid.pitch_mm).reshape(-1, 2)
    radius = mapping.scale(board) * grid.dot_diameter_mm / 2
    in_view = picture.wholly_in_view(mapping(board), radius)
    return Marks(
        board_mm=board,
        image_px=nodes.points.reshape(-1, 2),
        sigma_px=nodes.sigma_px.ravel(),
        status=mark_status(nodes.found.ravel(), in_view),
    )
