"""The laser line on a board: the points that lie in one straight line."""

from functools import partial

import numpy as np

from lscan.calibration.multiview.views import LinePoints
from lscan.camera.posedboards import PosedBoards
from lscan.camera.resection import PIXEL_STEP, Locate
from lscan.records import Floats, Mask, select

FEWEST_POINTS = 10  # of a line; a straight line has two unknowns
TRIED = 40  # points of a line that are joined in pairs to find it among outliers
WRONG = 6.0  # sigmas: beyond them a point is an outlier
MEDIAN = 0.6745  # of the magnitude of a normal variable of unit variance


def distance_mm(points_mm: Floats, q_per_mm: Floats) -> Floats:
    """(K,) signed distances of points from the plane q . X = 1.

    Parameters
    ----------
    points_mm : (K, 3) array, mm, camera frame
    q_per_mm : (3,) array, 1/mm, camera frame
    """
    distances: Floats = (points_mm @ q_per_mm - 1) / np.linalg.norm(q_per_mm)
    return distances


def straight(boards: PosedBoards, line: LinePoints, board: int) -> Mask:
    """(K,) mask of the points that lie in one straight line of a board.

    Of the lines through pairs of points the one of least median distance decides.

    Parameters
    ----------
    boards : PosedBoards, camera and poses
    line : LinePoints, px, of K points
    board : int, number of the board

    References
    ----------
    Rousseeuw, "Least median of squares regression", J. Am. Stat. Assoc. 79 (1984) 871.
    """
    locate = partial(boards.locate, board=board)
    plane = locate(line.image_px)
    seen: Mask = np.asarray(np.isfinite(plane).all(axis=1))
    mask = np.zeros(len(plane), dtype=bool)
    if seen.sum() < FEWEST_POINTS:
        return mask
    places = plane[seen]
    some = places[np.unique(np.linspace(0, len(places) - 1, TRIED).astype(int))]
    first, second = np.triu_indices(len(some), 1)
    along = some[second] - some[first]
    length = np.linalg.norm(along, axis=1)
    if not length.any():
        return mask
    normal = np.column_stack([-along[:, 1], along[:, 0]])[length > 0] / length[length > 0, None]
    offset = (normal * some[first][length > 0]).sum(axis=1)
    away = np.abs(places @ normal.T - offset)
    best = np.median(away, axis=0).argmin()
    across = across_mm(locate, select(line, seen))
    sigma = np.abs(across @ normal[best]) * line.sigma_px[seen]
    usual = max(1.0, float(np.median(away[:, best] / sigma)) / MEDIAN)
    mask[seen] = away[:, best] <= WRONG * usual * sigma
    return mask


def across_mm(locate: Locate, line: LinePoints) -> Floats:
    """(K, D) mm that a point moves when its pixel moves by one across the line.

    Parameters
    ----------
    locate : callable, (K, D) places in mm of pixels (K, 2)
    line : LinePoints, px, of K points
    """
    step = PIXEL_STEP * line.across
    return (locate(line.image_px + step) - locate(line.image_px - step)) / (2 * PIXEL_STEP)


def line_ends(points: Floats) -> Floats:
    """(2, 3) mm, the ends of the straight line of least squares through points.

    Parameters
    ----------
    points : (K, 3) array, mm, camera frame
    """
    middle = points.mean(axis=0)
    along = np.linalg.svd(points - middle, full_matrices=False)[2][0]
    reach = (points - middle) @ along
    return middle + np.array([[reach.min()], [reach.max()]]) * along
