"""Which dot is which, the local map from board to picture, and dots that do not belong."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import label, maximum_filter
from scipy.spatial import cKDTree

from lscan.board.picture import BoardPicture
from lscan.board.search import Nodes, expected_places, local_pitch, mean_beside
from lscan.config.board import Grid
from lscan.errors import BoardNotFound
from lscan.records import Floats, Mask

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
        return np.sqrt(np.abs(np.linalg.det(self.jacobian)))


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

    def misfit(self, which: Mask | slice = ALL) -> Floats:
        """Distance in px between control points and where those around each predict it.

        At the rim the prediction is less certain: a miss is divided by its standard deviation for
        errors of 1 px of each point, the square root of 1 + leverage.

        Parameters
        ----------
        which : mask or slice, of the control points asked for; by default all
        """
        predicted = self.expanded(self.board_mm[which], skip=1)
        miss = np.linalg.norm(predicted.image_px - self.image_px[which], axis=1)
        return miss / np.sqrt(1 + predicted.leverage)

    def expanded(self, board_mm: Floats, skip: int = 0) -> Expansion:
        """The map about places of the board to second order.

        Parameters
        ----------
        board_mm : (M, 2) array, mm, of (x, z)
        skip : int, how many of the control points nearest to each place are left out
        """
        count = min(NEAREST + skip, len(self.board_mm))
        nearest = cKDTree(self.board_mm).query(board_mm, k=count)[1]
        index = np.asarray(nearest)[:, skip:]
        x, z = np.moveaxis((self.board_mm[index] - board_mm[:, None]) / self.pitch_mm, -1, 0)
        design = np.stack([np.ones_like(x), x, z, x * x, x * z, z * z], axis=-1)
        across = design.transpose(0, 2, 1)
        at_place = np.broadcast_to(np.eye(6, 1), (len(index), 6, 1))
        right = np.concatenate([across @ self.image_px[index], at_place], axis=2)
        solved = _solved(across @ design, right)  # (M, 6, 3)
        solved, leverage = solved[..., :2], solved[:, 0, 2]
        xx, xz, zz = 2 * solved[:, 3], solved[:, 4], 2 * solved[:, 5]
        bend = np.stack([xx, xz, xz, zz], axis=-1).reshape(-1, 2, 2, 2)
        jacobian = solved[:, 1:3].transpose(0, 2, 1)
        bend = bend / self.pitch_mm**2
        return Expansion(solved[:, 0], jacobian / self.pitch_mm, bend, leverage)


def _solved(left: Floats, right: Floats) -> Floats:
    """Solutions (M, 6, K) of M normal equations, left (M, 6, 6), right (M, 6, K).

    On a narrow board the nearest points may leave a coefficient free; it is then 0.
    """
    scale = np.einsum("mii->mi", left).prod(axis=1)
    free = np.linalg.det(left) <= FREE * scale
    regular = np.where(free[:, None, None], np.eye(6), left)
    solved: Floats = np.linalg.solve(regular, right).astype(np.float64)
    solved[free] = np.linalg.pinv(left[free], rcond=1e-9, hermitian=True) @ right[free]
    return solved


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


def completed(nodes: Nodes, pitch_mm: float) -> Floats:
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
    points[beside] = local_map(nodes.points, pitch_mm).expanded(board[beside]).image_px
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
