"""The three first dots: a dot, the one beneath and the one to its right (Fig. 12, #1 to #3).

The paper picks them by hand; they may be given so here too.  Otherwise the board file gives
how large a dot is beside the pitch, so for each size of dot a picture could show, the blobs of
that size are looked through for dots with a neighbour at about the pitch on all four sides.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from lscan.board.blobs import find_blobs
from lscan.board.picture import Image
from lscan.config.board import Board
from lscan.errors import BoardNotFound, InputError
from lscan.records import Floats, Mask

SMALLEST_RADIUS_PX = 1.2
SIZE_STEP = 1.26  # between sizes tried: a third of an octave
PITCH_RANGE = (0.6, 1.6)  # of the pitch expected from the dot's size: blur and foreshortening
LEAN = 0.5  # tangent of the most a row may lean against a column's square: 26 degrees
UNEVEN = 0.15  # of the pitch: most by which opposite neighbours may miss being opposite
NEIGHBOURS = 24
PROPOSALS = 3


@dataclass(frozen=True)
class Crosses:
    """N blobs with four neighbours like a dot inside a grid.

    Attributes
    ----------
    seeds : (N, 3, 2) array, px, (u, v) of the blob, the one beneath, the one to its right
    uneven : (N,) array, by how much opposite neighbours miss being opposite, as a part of the pitch
    strength : (N,) array, grey values, of the blob
    """

    seeds: Floats
    uneven: Floats
    strength: Floats


def propose_seeds(bright: Image, board: Board, noise: float) -> list[Floats]:
    """Seeds to begin with, each (3, 2) px, regular ones, the one nearest the middle first.

    Parameters
    ----------
    bright : (H, W) array, grey values, marks bright
    board : Board, mm
    noise : float, standard deviation of a grey value

    Raises
    ------
    BoardNotFound
        Where no nine dots look like a grid.
    """
    grid = board.grid
    ratio = grid.pitch_mm / grid.dot_diameter_mm
    largest = min(bright.shape) / 2 / ratio / 2  # three dots must fit in the picture
    count = int(np.log(max(largest / SMALLEST_RADIUS_PX, 1)) / np.log(SIZE_STEP)) + 1
    best, best_weight = None, 0.0
    for radius in SMALLEST_RADIUS_PX * SIZE_STEP ** np.arange(count):
        blobs = find_blobs(bright, float(radius), noise)
        crosses = find_crosses(blobs.points, blobs.strength, float(2 * radius * ratio))
        weight = float(crosses.strength.sum())
        if weight > best_weight:
            best, best_weight = crosses, weight
    if best is None:
        raise BoardNotFound(
            f"no grid of {board.marks} dots in the picture: light and sharpen the board, or "
            "check marks, pitch_mm and dot_diameter_mm in the board file"
        )
    regular = best.seeds[
        np.argsort(best.uneven, kind="stable")[: max(PROPOSALS, len(best.seeds) // 5)]
    ]
    middle = np.array(bright.shape[::-1]) / 2
    order = np.argsort(np.linalg.norm(regular[:, 0] - middle, axis=1), kind="stable")
    return list(regular[order[:PROPOSALS]])


def find_crosses(points: Floats, strength: Floats, pitch: float) -> Crosses:
    """The points that have neighbours at about ``pitch`` px right, left, beneath and above.

    Parameters
    ----------
    points : (N, 2) array, px, of (u, v)
    strength : (N,) array, grey values
    pitch : float, px
    """
    if len(points) < 5:
        return Crosses(np.empty((0, 3, 2)), np.empty(0), np.empty(0))
    low, high = PITCH_RANGE[0] * pitch, PITCH_RANGE[1] * pitch
    count = min(NEIGHBOURS, len(points))
    found = cKDTree(points).query(points, k=count, distance_upper_bound=high)
    distance, index = (np.asarray(array) for array in found)
    usable: Mask = np.less(index, len(points)) & (distance >= low)
    enough = usable.sum(axis=1) >= 4  # most blobs of a wrong size end here
    usable, index = usable[enough], index[enough]
    neighbours = points[np.where(usable, index, 0)]
    points, strength = points[enough], strength[enough]
    away = neighbours - points[:, None]  # (N, count, 2)
    turn = _turn_to_upright(away, usable)
    away = away @ turn
    right = _nearest(away, usable & (np.abs(away[..., 1]) < LEAN * away[..., 0]))
    left = _nearest(away, usable & (np.abs(away[..., 1]) < -LEAN * away[..., 0]))
    beneath = _nearest(away, usable & (np.abs(away[..., 0]) < LEAN * away[..., 1]))
    above = _nearest(away, usable & (np.abs(away[..., 0]) < -LEAN * away[..., 1]))
    scale = (np.linalg.norm(right, axis=1) + np.linalg.norm(beneath, axis=1)) / 2
    misses = np.stack([right + left, beneath + above])
    uneven = np.sqrt((misses**2).sum(axis=2)) / scale
    good: Mask = np.all(uneven < UNEVEN, axis=0)  # False where a neighbour is missing (NaN)
    back = turn.transpose(0, 2, 1)
    beneath, right = ((step[:, None] @ back)[:, 0] for step in (beneath, right))
    seeds = np.stack([points, points + beneath, points + right], axis=1)
    return Crosses(seeds[good], uneven.sum(axis=0)[good], strength[good])


def _turn_to_upright(away: Floats, usable: Mask) -> Floats:
    """(N, 2, 2) rotations, by 45 degrees at most, that bring the nearest neighbour to an axis."""
    nearest = _nearest(away, usable)
    angle = np.arctan2(nearest[:, 1], nearest[:, 0])
    lean = np.nan_to_num(angle - np.rint(angle / (np.pi / 2)) * (np.pi / 2))
    cos, sin = np.cos(lean), np.sin(lean)
    return np.stack([cos, -sin, sin, cos], axis=1).reshape(-1, 2, 2)


def _nearest(away: Floats, wanted: Mask) -> Floats:
    """(N, 2) first wanted vector of each row, which are sorted by length; NaN where none."""
    first = wanted.argmax(axis=1)
    vector = np.take_along_axis(away, first[:, None, None], axis=1)[:, 0]
    return np.where(np.any(wanted, axis=1, keepdims=True), vector, np.nan)


def check_seeds(seeds: Floats, size: tuple[int, int]) -> Floats:
    """The seeds given by hand as (3, 2) floats, px of dots #1, #2 and #3.

    Parameters
    ----------
    seeds : (3, 2) array, px, of (u, v)
    size : tuple of int, (width, height) of the picture, px

    Raises
    ------
    InputError
        For another shape, a seed outside the picture, or seeds that do not lie as dot, beneath,
        right.
    """
    points = np.asarray(seeds, dtype=float)

    def refusal(what: str, allowed: str) -> InputError:
        return InputError(what, where="seeds", value=points.tolist(), allowed=allowed)

    if points.shape != (3, 2) or not np.isfinite(points).all():
        raise refusal("not three seeds", "three points (u, v)")
    width, height = size
    if (points < 0).any() or (points > np.array([width - 1, height - 1])).any():
        raise refusal("seed outside the picture", f"u 0 to {width - 1}, v 0 to {height - 1}")
    beneath, right = points[1:] - points[0]
    lengths = np.linalg.norm([beneath, right], axis=1)
    turn = beneath[1] * right[0] - beneath[0] * right[1]  # positive: right-handed in the picture
    if turn < 0.3 * lengths.prod() or lengths.max() > 3 * lengths.min() or lengths.min() < 3:
        raise refusal(
            "seeds do not lie as a grid's corner",
            "#1 the upper-left dot, #2 the dot beneath it, #3 the dot to its right",
        )
    return points
