"""Which corners in a picture are those of a chessboard: three detectors, and what judges them.

OpenCV's two detectors differ in what they miss.  Beside slivers of further squares at the rim of a
board the newer one may skip a row, and it draws at random.  So its numbers are drawn from one
seed, the older one is asked where the newer one's answer is not perfect, and where neither has one
the corners are sought from one to the next (saddles.py).  An answer counts only if the picture
bears it out: the steps from corner to corner are even, and the squares between the
corners and about them are dark and bright in turn.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import map_coordinates

from lscan.board.saddles import corner_lattices
from lscan.board.search import NEXT, moved
from lscan.errors import BoardNotFound
from lscan.records import Bytes, Floats, Mask

DETECTORS = (  # the newer, then the older
    (cv2.findChessboardCornersSB, cv2.CALIB_CB_EXHAUSTIVE),
    (cv2.findChessboardCorners, cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE),
)
SEED = 1
UNEVEN = 0.3  # of a step, its change to the next: perspective makes 0.1, a skipped row 1
PATCH = 0.12  # Gaussian sigma, of a step, under which a square's grey value is taken
SIDE = 0.3  # of a step, from the middle of a square towards its sides
CLEAR = 0.25  # of the usual difference between squares, by which one must differ
FEWEST_RIGHT = 0.6  # of the squares in each row and column: a laser's line or glare may hide some


@dataclass(frozen=True)
class SeenLattice:
    """A lattice of corners, and how many squares speak for it.

    Attributes
    ----------
    corners : (R, C, 2) array, px, to about a pixel
    right : int, squares that are dark and bright in turn, of (R + 1) (C + 1)
    """

    corners: Floats
    right: int

    @property
    def whole(self) -> bool:
        """Whether all squares, those about the rim too, are as they should be."""
        rows, columns = self.corners.shape[:2]
        return self.right == (rows + 1) * (columns + 1)


def find_lattice(picture: Bytes, columns: int, rows: int) -> Floats:
    """(rows, columns, 2) px of the inner corners of a chessboard, to about a pixel.

    The same for the same picture, whatever was looked for before.

    Parameters
    ----------
    picture : (H, W) array, grey values
    columns, rows : int, inner corners along and down the board, 3 or more

    Raises
    ------
    BoardNotFound
        Where no detector finds the corners, or the picture does not bear out what they find.
    """
    best, doubted = None, False
    for detect in (_by_opencv, _by_saddles):
        for corners in detect(picture, columns, rows):
            seen = _judged(picture, corners)
            doubted |= seen is None
            if seen is not None and (best is None or seen.right > best.right):
                best = seen
            if best is not None and best.whole:
                return best.corners
        if best is not None:
            return best.corners
    if doubted:
        raise BoardNotFound(
            f"corners were found, but they are no even lattice of {columns} by {rows} between "
            "squares dark and bright in turn: count the inner corners again, and cover what shows "
            "of further squares at the board's rim"
        )
    raise BoardNotFound(
        f"no chessboard of {columns} by {rows} inner corners in the picture: all of them "
        "must be in view, with a bright rim about the board"
    )


def _by_opencv(picture: Bytes, columns: int, rows: int) -> Iterator[Floats]:
    """What OpenCV's detectors find, with random numbers from one seed, drawn by one thread."""
    threads = cv2.getNumThreads()
    for detect, flags in DETECTORS:
        cv2.setNumThreads(1)
        cv2.setRNGSeed(SEED)
        try:
            found, corners = detect(picture, (columns, rows), flags=flags)
        finally:
            cv2.setNumThreads(threads)
        if found:
            yield np.asarray(corners, dtype=float).reshape(rows, columns, 2)


def _by_saddles(picture: Bytes, columns: int, rows: int) -> Iterator[Floats]:
    """Every complete part of that size of the lattices of saddles, either way up."""
    for lattice in corner_lattices(picture.astype(np.float32), 2 * max(rows, columns)):
        for turned in (lattice, np.rot90(lattice)):
            spare = turned.shape[0] - rows, turned.shape[1] - columns
            for down, across in np.ndindex(max(spare[0] + 1, 0), max(spare[1] + 1, 0)):
                part = turned[down : down + rows, across : across + columns]
                if np.isfinite(part).all():
                    yield part


def _judged(picture: Bytes, corners: Floats) -> SeenLattice | None:
    """The lattice, or the one a row or column beside it, that the squares speak for; None: none.

    Where further squares show in part the lattice may be found a row off: the whole squares about
    the rim, all of which a board shows, decide.  Where they bear out two lattices the board has
    more corners than were asked for.
    """
    if not _is_even(corners):
        return None
    rows, columns = corners.shape[:2]
    wide = _extended(_extended(corners))
    middle, whole = _in_turn(picture, wide)  # (rows + 3, columns + 3)
    seen = []
    for down, across in np.ndindex(3, 3):
        window = np.s_[down : down + rows + 1, across : across + columns + 1]
        squares, inner = whole[window].copy(), middle[window][1:-1, 1:-1]
        squares[1:-1, 1:-1] = inner
        fewest = min(inner.mean(axis=0).min(), inner.mean(axis=1).min())
        part = wide[down + 1 : down + 1 + rows, across + 1 : across + 1 + columns]
        # A lattice beside the one found must have more than a square more to show for itself.
        ahead = 1 if (down, across) == (1, 1) else 0
        if fewest >= FEWEST_RIGHT:
            lattice = SeenLattice(part, int(squares.sum()))
            seen.append((lattice.right + ahead, lattice))
    if not seen or sum(lattice.whole for _, lattice in seen) > 1:
        return None
    return max(seen, key=lambda scored: scored[0])[1]


def _is_even(corners: Floats) -> bool:
    """Whether steps from corner to corner change no more than perspective and lens make them."""
    for axis in (0, 1):
        step = np.diff(corners, axis=axis)
        length = np.linalg.norm(step, axis=2)
        for way in (0, 1):
            change = np.linalg.norm(np.diff(step, axis=way), axis=2)
            shorter = np.minimum(np.delete(length, 0, way), np.delete(length, -1, way))
            if (change > UNEVEN * shorter).any():
                return False
    return True


def _extended(corners: Floats) -> Floats:
    """(R + 2, C + 2, 2) the lattice with a rim about it, by equal steps."""
    for axis in (0, 1):
        p = np.moveaxis(corners, axis, 0)
        p = np.concatenate([[2 * p[0] - p[1]], p, [2 * p[-1] - p[-2]]])
        corners = np.moveaxis(p, 0, axis)
    return corners


def _in_turn(picture: Bytes, corners: Floats) -> tuple[Mask, Mask]:
    """(R - 1, C - 1) masks of the squares that are dark or bright as their turn is.

    In the middle, and also towards all four sides, as a sliver of a square is not.
    """
    p, q, r, s = corners[:-1, :-1], corners[:-1, 1:], corners[1:, :-1], corners[1:, 1:]
    middle, right, down = (p + q + r + s) / 4, (q + s - p - r) / 2, (r + s - p - q) / 2
    step = float(np.median(np.linalg.norm(right, axis=2)))
    smooth = cv2.GaussianBlur(picture.astype(np.float32), (0, 0), max(PATCH * step, 0.5))

    def grey(place: Floats) -> Floats:
        at = [place[..., 1], place[..., 0]]
        return np.asarray(map_coordinates(smooth, at, order=1, cval=np.nan), dtype=float)

    in_middle = grey(middle)
    around = np.stack([moved(in_middle, row, column) for row, column in NEXT])
    known = np.isfinite(around)
    beside = np.where(known, around, 0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    row, column = np.indices(in_middle.shape)
    turn = (-1.0) ** (row + column)
    usual = float(np.nanmedian(((in_middle - beside) * turn)[2:-2, 2:-2]))
    turn *= np.sign(usual)
    sides = [grey(middle + way * SIDE * axis) for axis in (right, down) for way in (1, -1)]
    # A lattice whose squares are not the board's shows as much contrast, but not in turn.
    least = CLEAR * max(abs(usual), float(np.nanstd(np.stack(sides)[:, 2:-2, 2:-2])))
    clear = [(place - beside) * turn > least for place in (in_middle, *sides)]
    return clear[0], np.all(clear, axis=0)
