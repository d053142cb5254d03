"""Which dot is which: the map from board to picture, outliers, evidence that it is the board."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import label, map_coordinates, maximum_filter
from scipy.spatial import cKDTree

from lscan.board.loops import disc_shifts, local_polynomials
from lscan.board.picture import BLUR_PX, BoardPicture
from lscan.board.search import Nodes, expected_places, local_pitch, mean_beside
from lscan.config.board import Board, Grid
from lscan.errors import BoardNotFound
from lscan.records import BoardReading, Floats, Mark, Marks, Mask, RingPoints, Status

# Which dot is which, the local map from board to picture, and dots that do not belong.

NEAREST = 20  # control points that carry a local polynomial of six coefficients
OUTLIER = 0.01  # of the pitch: smallest miss that can make a dot an outlier
OUTLIER_SIGMAS = 8.0
OUTLIER_SPOILS = 7  # nodes on a side, about an outlier, whose miss may be its doing
SPREAD = 6  # nodes within which a dot carries the polynomials of others, at a corner too
FREE = 1e-12  # of the diagonal's product: determinant of equations that do not fix all
RIM_EVIDENCE = 2  # nodes that must be seen to be empty beyond the rim of the board
ALL = slice(None)


@dataclass(frozen=True)
class Expansion:
    """The local map about M places of the board.

    Attributes
    ----------
    image_px : (M, 2) array, px, of (u, v)
    jacobian : (M, 2, 2) array, px per mm, its derivative by (x, z)
    bend : (M, 2, 2, 2) array, px per mm², second derivatives of u and v, by (x, z), by (x, z)
    leverage : (M,) array, variance of image_px where each control point's is 1; large beyond the
        rim
    """

    image_px: Floats
    jacobian: Floats
    bend: Floats
    leverage: Floats

    @property
    def scale(self) -> Floats:
        """(M,) px per mm, geometric mean over the directions."""
        (xx, xz), (zx, zz) = np.moveaxis(self.jacobian, 0, 2)
        return np.sqrt(np.abs(xx * zz - xz * zx))


@dataclass(frozen=True)
class LocalMap:
    """A smooth map from board to picture, through the N control points found.

    At each place a second-order polynomial in (x, z) is fitted to the nearest control points:
    within them the third order of a wide-angle lens is some 0.1 px, enough to know where to
    look for a mark.

    Attributes
    ----------
    board_mm : (N, 2) array, mm, (x, z) of the control points
    image_px : (N, 2) array, px, (u, v) of the control points
    pitch_mm : float, mm, spacing of the grid
    """

    board_mm: Floats
    image_px: Floats
    pitch_mm: float

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.board_mm)

    def misfit(self, which: Mask | slice = ALL) -> Floats:
        """Distance in px between control points and where those around each predict it.

        At the rim the prediction is less certain: a miss is divided by its standard deviation for
        errors of 1 px of each point, the square root of 1 + leverage.

        Parameters
        ----------
        which : mask or slice, of the control points asked for; by default all
        """
        predicted = self.expansion(self.board_mm[which], skip=1)
        miss = np.linalg.norm(predicted.image_px - self.image_px[which], axis=1)
        return miss / np.sqrt(1 + predicted.leverage)

    def expansion(self, board_mm: Floats, skip: int = 0) -> Expansion:
        """The map about places of the board to second order.

        Parameters
        ----------
        board_mm : (M, 2) array, mm, of (x, z)
        skip : int, how many of the control points nearest to each place are left out
        """
        count = min(NEAREST + skip, len(self.board_mm))
        nearest = np.asarray(self._tree.query(board_mm, k=count)[1])
        left, right, solved, size = local_polynomials(
            self.board_mm,
            self.image_px,
            np.ascontiguousarray(nearest[:, skip:]),
            np.ascontiguousarray(board_mm),
            self.pitch_mm,
        )
        # On a narrow board the nearest points may leave a coefficient free; it is then 0.
        if (free := ~(size > FREE)).any():
            solved[free] = np.linalg.pinv(left[free], rcond=1e-9, hermitian=True) @ right[free]
        solved, leverage = solved[..., :2], solved[:, 0, 2]
        xx, xz, zz = 2 * solved[:, 3], solved[:, 4], 2 * solved[:, 5]
        bend = np.stack([xx, xz, xz, zz], axis=-1).reshape(-1, 2, 2, 2)
        jacobian = solved[:, 1:3].transpose(0, 2, 1)
        bend = bend / self.pitch_mm**2
        return Expansion(solved[:, 0], jacobian / self.pitch_mm, bend, leverage)


def dot_part(grid: Grid) -> float:
    """A control dot's diameter as a part of the pitch.

    Parameters
    ----------
    grid : Grid, mm
    """
    return grid.dot_diameter_mm / grid.pitch_mm


def grid_points_mm(shape: tuple[int, ...], pitch_mm: float) -> Floats:
    """(R, C, 2) of (x, z) mm of a grid's nodes, the top left one at the origin.

    Parameters
    ----------
    shape : tuple of int, (R, C)
    pitch_mm : float, mm
    """
    column, row = np.meshgrid(np.arange(shape[1]), np.arange(shape[0]))
    return np.stack([column, -row], axis=-1).astype(float) * pitch_mm


def local_map(points: Floats, pitch_mm: float) -> LocalMap:
    """The map through all nodes that are known, origin at node (0, 0).

    Parameters
    ----------
    points : (R, C, 2) array, px, (u, v) of the nodes; NaN where none
    pitch_mm : float, mm
    """
    board = grid_points_mm(points.shape[:2], pitch_mm)
    known = np.isfinite(points[..., 0])
    return LocalMap(board[known], points[known], pitch_mm)


def complete_nodes(nodes: Nodes, pitch_mm: float) -> Floats:
    """(R, C, 2) px of all nodes: the dots found, and where the others would be.

    Next to a dot found, the local polynomials give it; further out equal steps are taken,
    which never fold back into the picture as a polynomial far outside does.

    Parameters
    ----------
    nodes : Nodes, px
    pitch_mm : float, mm
    """
    points = nodes.points.copy()
    beside = ~nodes.found & np.isfinite(mean_beside(nodes.height))
    board = grid_points_mm(points.shape[:2], pitch_mm)
    points[beside] = local_map(nodes.points, pitch_mm).expansion(board[beside]).image_px
    while (empty := np.isnan(points[..., 0])).any():
        points[empty] = expected_places(points)[empty]
    return points


def drop_outliers(nodes: Nodes, pitch_mm: float) -> None:
    """Take out the dots that do not lie where those around them predict.

    An outlier misses by more than eight robust sigmas and a hundredth of the pitch.  It
    spoils what is expected of those around it, so the worst thereabouts goes first and the
    others are judged again without it.  Fewer than nine dots are not judged.

    Parameters
    ----------
    nodes : Nodes, px, changed in place
    pitch_mm : float, mm
    """
    misfit = np.full(nodes.found.shape, np.nan)
    doubtful = nodes.found
    while (found := nodes.found).sum() >= 9:
        pitch_px = float(np.nanmedian(local_pitch(nodes.points)))
        misfit[doubtful] = local_map(nodes.points, pitch_mm).misfit(doubtful[found])
        worst, usual = float(misfit[found].max()), float(np.median(misfit[found]))
        limit = max(OUTLIER_SIGMAS * 1.4826 * usual, OUTLIER * pitch_px)
        if worst <= limit:
            return
        around = maximum_filter(np.where(found, misfit, 0.0), OUTLIER_SPOILS)
        outlier = found & (misfit > limit) & (misfit >= around)
        nodes.values[outlier] = np.nan
        doubtful = nodes.found & maximum_filter(outlier, 2 * SPREAD + 1)


def drop_islands(nodes: Nodes) -> None:
    """Take out all dots but the largest set in which each is beside another.

    The search goes from a dot to the one beside it, so whatever else is left was reached through
    dots that have proved to be none, and only its own dots speak for it.

    Parameters
    ----------
    nodes : Nodes, px, changed in place
    """
    island, count = label(nodes.found)
    if count > 1:
        dots = np.bincount(island[nodes.found])
        nodes.values[island != dots.argmax()] = np.nan


def place_on_board(picture: BoardPicture, nodes: Nodes, grid: Grid, radius_px: float) -> Nodes:
    """The cropped nodes on the board: (rows, columns) of it, or of what is seen if not whole.

    Where a whole board is cut by the picture, the place follows from a rim of the board that is
    seen: a rim is where the next row or column would be in view and is not there.

    Parameters
    ----------
    picture : BoardPicture, levelled
    nodes : Nodes, px, cropped
    grid : Grid, mm, of the board
    radius_px : float, px, of a control dot

    Raises
    ------
    BoardNotFound
        Where neither the one rim nor the opposite one is seen.
    """
    axes = [*zip(nodes.height.shape, (grid.rows, grid.columns), ("rows", "columns"), strict=True)]
    for found, most, what in axes:
        if found > most:
            raise BoardNotFound(
                f"the picture shows {found} {what} of dots, more than the {most} of the board file"
            )
    if not grid.whole:
        return nodes
    part = []
    for axis, (found, most, what) in enumerate(axes):
        p = np.moveaxis(nodes.points, axis, 0)
        beyond = (2 * p[0] - p[1], 2 * p[-1] - p[-2])  # NaN beside a missing dot
        seen = (picture.wholly_in_view(points, 2 * radius_px).sum() for points in beyond)
        first, last = (int(count) >= RIM_EVIDENCE for count in seen)
        start = _first(most - found, first, last, what, most, found)
        part.append(slice(start, start + found))
    placed = Nodes.empty(grid.rows, grid.columns)
    placed.values[tuple(part)] = nodes.values
    return placed


def _first(spare: int, first: bool, last: bool, what: str, whole: int, found: int) -> int:
    """Index on the board of the first row or column found."""
    if spare == 0 or (first and not last):
        return 0
    if last and not first:
        return spare
    if first and last:
        raise BoardNotFound(
            f"only {found} of the {whole} {what} of dots were found although both ends are in "
            "view: check the board file, or give the seeds by hand"
        )
    raise BoardNotFound(
        f"{found} of the {whole} {what} of dots are in view and neither end of them is, so "
        "which is the first is not known: give the seeds by hand"
    )


# How far a disc's centre, as seen, lies from the image of the disc's centre.
#
# Perspective and distortion do not keep middles: the near half of a tilted disc covers more of the
# picture than the far half.  The centre of a mark is found as the maximum of the smoothed picture
# (picture.py), so the same is done here with the disc as the local map draws it: its first and
# second derivatives, J and Q, place the disc's points at J x + Q(x, x) / 2 with the area det(J + Q
# x).  To leading order the shift grows as Q times the square of the radius (Heikkilä, IEEE Trans.
# PAMI 22, 10, 2000, gives that of the ellipse's centre under perspective).


def shift_of_discs(map_there: Expansion, radius_mm: Floats | float, sigma_px: Floats) -> Floats:
    """(N, 2) px from the image of each disc's centre to the maximum of its smoothed image.

    Parameters
    ----------
    map_there : Expansion, px and mm, the local map about the N centres
    radius_mm : (N,) array or float, mm, of the discs
    sigma_px : (N,) array, px, of the smoothing (``window_sigma``); the picture's own blur of 0.7 px
        adds to it
    """
    radius, variance = np.full(len(sigma_px), radius_mm), sigma_px**2 + BLUR_PX**2
    return disc_shifts(np.ascontiguousarray(map_there.jacobian), map_there.bend, radius, variance)


# By how much dots scatter about a smooth lattice more than the noise of pixels explains.
#
# A coder's quantisation and the interpolation of a colour filter's pixels displace dots as noise
# does, but are not seen where the picture is even.  They are seen in the lattice itself: seen by a
# lens through a port it is smooth, and its fifth differences next to nothing.


_Marked = TypeVar("_Marked", Mark, Marks, RingPoints)

FIFTH = np.array([1.0, -5.0, 10.0, -10.0, 5.0, -1.0])
"""Differences that leave nothing of a polynomial of the fourth degree: of six dots in a row over a
tenth of the picture's width a lens leaves 1e-3 px of them, over the norm 16 1e-4 px."""
FEWEST = 40  # differences, many of which share dots: their spread is known to a fifth
CHANCE = 1.5  # times what is expected; below it is taken for chance, or for edges that are coarse


def lattice_scatter(nodes: Nodes) -> float:
    """The scatter of a lattice's fifth differences over what its sigmas make of it; 1 or more.

    Robust: half of the dots may lie anywhere.  Below CHANCE, and with too few dots in rows of
    six, it is 1.

    Parameters
    ----------
    nodes : Nodes, px, with their standard uncertainties

    References
    ----------
    Birge, The calculation of errors by the method of least squares, Phys. Rev. 40, 207 (1932): an
    uncertainty is enlarged by the ratio of what is seen to what was stated.
    """
    points, variance = nodes.points, nodes.sigma_px**2
    each = (points[..., 0], points[..., 1])
    ratios = [_ratios(values, variance, axis) for values in each for axis in (0, 1)]
    found = np.abs(np.concatenate(ratios))
    found = found[np.isfinite(found)]
    if len(found) < FEWEST:
        return 1.0
    scatter = float(np.median(found)) / 0.6745
    return scatter if scatter > CHANCE else 1.0


def less_sure(reading: BoardReading, times: float) -> BoardReading:
    """The reading with all its uncertainties so many times larger: all marks share their cause.

    Parameters
    ----------
    reading : BoardReading
    times : float
    """

    def of(mark: _Marked) -> _Marked:
        return replace(mark, sigma_px=times * mark.sigma_px)

    return replace(
        reading,
        grid=of(reading.grid),
        rulers=tuple(replace(ruler, marks=of(ruler.marks)) for ruler in reading.rulers),
        dots={name: of(dot) for name, dot in reading.dots.items()},
        rings={name: of(ring) for name, ring in reading.rings.items()},
    )


def _ratios(values: Floats, variance: Floats, axis: int) -> Floats:
    """Fifth differences of (R, C) values along an axis, in their standard deviations."""
    if values.shape[axis] < len(FIFTH):
        return np.empty(0)
    differences = sliding_window_view(values, len(FIFTH), axis=axis) @ FIFTH
    expected = sliding_window_view(variance, len(FIFTH), axis=axis) @ FIFTH**2
    return np.asarray(differences / np.sqrt(expected)).ravel()


# Checks that the dots found are those of the board, and that its other marks bear them out.


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
    expected = int(picture.wholly_in_view(complete_nodes(part, grid.pitch_mm), radius_px).sum())
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
    nearest, lost, total = cKDTree(reading.grid.board_mm), [], 0
    for kind, marks in others.items():
        beside = nearest.query(np.reshape([place for place, _ in marks], (-1, 2)))[1]
        counts = reading.grid.found[beside]
        seen = [found for (_, found), known in zip(marks, counts, strict=True) if known]
        missing = seen.count(False)
        if missing > FEWEST_PART * len(seen):
            lost.append(f"{missing} of {len(seen)} {kind}")
            total += missing
    return " and ".join(lost) if total >= FEWEST_LOST else ""
