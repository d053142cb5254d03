"""Checks that the dots found are those of the board, and that its other marks bear them out."""

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from lscan.board.lattice import completed, dot_part, local_map
from lscan.board.picture import BoardPicture
from lscan.board.search import Nodes, local_pitch
from lscan.config.board import Board, Grid
from lscan.records import BoardReading, Floats, Status

FEWEST_DOTS = 9  # three rows of three
FEWEST_PART = 0.5  # of the dots in view
INSIDE, OUTSIDE = 0.5, 1.75  # of the dot's radius: on the dot, and clear of it
DARKEST_INSIDE, BRIGHTEST_OUTSIDE = 0.5, 0.5  # of the grey value at the middle
DIRECTIONS = 16
FEWEST_LOST = 3  # other marks that speak against a board file: fewer may be dirty
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
        return (
            "the marks found are not dots of the size the board file gives"
            f"{_size_seen(picture, part.points, grid)}"
        )
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


def _size_seen(picture: BoardPicture, points: Floats, grid: Grid) -> str:
    """How wide marks are at half their height, as the median, beside what the board file says."""
    pitch = local_pitch(points)
    known = np.isfinite(points[..., 0]) & np.isfinite(pitch)
    radii = np.linspace(0.0, 0.5, 26)  # of the pitch
    grey = [_grey_around(picture, points[known], r * pitch[known]).mean(axis=1) for r in radii]
    profile = np.median(np.array(grey) / np.maximum(grey[0], 1e-9), axis=1)
    width = 2 * radii[np.argmax(profile < (1 + profile.min()) / 2)] * grid.pitch_mm
    return f": they are about {width:.2g} mm wide, dot_diameter_mm is {grid.dot_diameter_mm:g}"


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


def lost_marks(reading: BoardReading, board: Board) -> str:
    """The kinds of other marks most of which are not where the board file has them, in words.

    Empty where most of every kind were found, or fewer than three marks are lost.  Only marks
    whose nearest control point was found count: the picture shows their place.

    Parameters
    ----------
    reading : BoardReading, of a picture
    board : Board, mm, of the board file
    """
    rulers = zip(board.ruler, reading.rulers, strict=True)
    others = {
        "rulers": [
            (ruler.points_mm().mean(axis=0), float(np.mean(seen.marks.found)) >= FEWEST_PART)
            for ruler, seen in rulers
        ],
        "named dots": [
            ((dot.x_mm, dot.z_mm), reading.dots[dot.name].status == Status.OK) for dot in board.dot
        ],
        "rings": [
            ((ring.x_mm, ring.z_mm), len(reading.rings[ring.name].sigma_px) > 0)
            for ring in board.ring
        ],
    }
    nearest = cKDTree(reading.grid.board_mm)
    lost, total = [], 0
    for kind, marks in others.items():
        seen = [found for place, found in marks if reading.grid.found[nearest.query(place)[1]]]
        missing = seen.count(False)
        if missing > FEWEST_PART * len(seen):
            lost.append(f"{missing} of {len(seen)} {kind}")
            total += missing
    return " and ".join(lost) if total >= FEWEST_LOST else ""
