"""Checks that the dots found are those of the board."""

import numpy as np
from scipy.ndimage import map_coordinates

from lscan.board.lattice import completed, dot_part, local_map
from lscan.board.picture import BoardPicture
from lscan.board.search import Nodes, local_pitch
from lscan.config.board import Grid
from lscan.records import Floats

FEWEST_DOTS = 9  # three rows of three
FEWEST_PART = 0.5  # of the dots in view
INSIDE, OUTSIDE = 0.5, 1.75  # of the dot's radius: on the dot, and clear of it
DARKEST_INSIDE, BRIGHTEST_OUTSIDE = 0.5, 0.5  # of the grey value at the middle
DIRECTIONS = 16
UNEVEN = 0.03  # of the pitch: a board's dots miss a smooth grid by less than 0.01


def fault_of(picture: BoardPicture, nodes: Nodes, grid: Grid) -> str | None:
    """The first check that the dots fail as the board's, in words, or None.

    Parameters
    ----------
    picture : BoardPicture, levelled
    nodes : Nodes, px, the dots found
    grid : Grid, mm, of the board
    """
    count = int(nodes.found.sum())
    if count < 3:
        return "the first three dots are not three round dots alike"
    if count < FEWEST_DOTS:
        return f"only {count} dots were found one from another, {FEWEST_DOTS} are needed"
    part = nodes.part(nodes.extent())
    if min(part.height.shape) < 3:
        return f"the {count} dots found lie in fewer than three rows or columns"
    radius_px = float(np.nanmedian(local_pitch(part.points))) * dot_part(grid) / 2
    expected = int(picture.wholly_in_view(completed(part, grid.pitch_mm), radius_px).sum())
    if count < FEWEST_PART * expected:
        return f"only {count} of the {expected} dots that should be in view were found"
    misfit = float(np.median(local_map(part.points, grid.pitch_mm).misfit()))
    if misfit > UNEVEN * 2 * radius_px / dot_part(grid):
        return f"the marks found miss a smooth grid by {misfit:.1f} px"
    if not _are_discs(picture, part.points, dot_part(grid)):
        return "the marks found are not dots of the size the board file gives"
    if not _is_finest(picture, part.points):
        return "there are more dots between those at the pitch"
    return None


def _are_discs(picture: BoardPicture, points: Floats, part: float) -> bool:
    """Whether most marks are bright half-way to a dot's edge, and end beyond it, all around."""
    pitch = local_pitch(points)
    known = np.isfinite(points[..., 0]) & np.isfinite(pitch)
    radius = pitch[known] * part / 2
    clear = np.minimum(OUTSIDE * radius, pitch[known] / 2)
    middle = _grey_around(picture, points[known], 0 * radius).mean(axis=1)
    inside = _grey_around(picture, points[known], INSIDE * radius).min(axis=1)
    outside = _grey_around(picture, points[known], clear).max(axis=1)
    fits = (inside > DARKEST_INSIDE * middle) & (outside < BRIGHTEST_OUTSIDE * middle)
    return bool(fits.mean() > 0.5)


def _grey_around(picture: BoardPicture, points: Floats, radius: Floats) -> Floats:
    """(N, directions) grey values on circles about the points (N, 2)."""
    angle = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    u = points[:, :1] + radius[:, None] * np.cos(angle)
    v = points[:, 1:] + radius[:, None] * np.sin(angle)
    return np.asarray(map_coordinates(picture.flat, [v, u], order=1), dtype=float)


def _is_finest(picture: BoardPicture, points: Floats) -> bool:
    """Whether there are no dots half-way between those found.

    Every other dot of a grid, or the black squares of a chessboard, would have some.
    """
    across = (points[:, 1:] + points[:, :-1]) / 2
    down = (points[1:] + points[:-1]) / 2
    cell = (across[1:] + across[:-1]) / 2
    limit = 0.5 * np.median(_smooth_at(picture, points))
    between = [_smooth_at(picture, middle) for middle in (across, down, cell)]
    return all(len(grey) == 0 or np.median(grey) < limit for grey in between)


def _smooth_at(picture: BoardPicture, points: Floats) -> Floats:
    known = points[np.isfinite(points[..., 0])]
    column, row = np.rint(known).astype(np.int64).T
    return picture.smooth[row, column].astype(float)
