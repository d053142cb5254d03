"""The corners of chessboards and of ChArUco boards, each with its uncertainty.

OpenCV finds the corners, and the picture decides which they are; their places are measured here as
saddles of a polynomial weighted by a Gaussian (picture.py), which also gives their uncertainty.

An ideal corner lies in the same place under windows of any size.  A real one does not: the
paper bends, ink spreads, movement and coding smear the squares by unlike amounts.  What two
windows disagree by, all corners together, is added to what noise does.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from lscan.board.lattice import grid_points_mm
from lscan.board.picture import (
    SMALLEST_SIGMA_PX,
    Centres,
    Image,
    bright_marks,
    fit_centres,
    noise_of,
)
from lscan.board.search import NEXT, Nodes, find_crosses, local_pitch, seed_nodes, shift_by, spread
from lscan.config.rig import Channel
from lscan.errors import BoardNotFound, InputError
from lscan.records import Bytes, Floats, Ints, Marks, Mask, Status

# A chessboard's corners found one from another, as the dots of a board are (search.py).
#
# Every saddle of the smoothed picture may be a corner.  One with four others about it, like the
# middle of a cross, begins; the displacement from corner to corner predicts the next, where a
# saddle is looked for, until none is left.  So all corners of the board are found, those that
# slivers of further squares make at its rim included.


SCALES_PX = (1.5, 3.0, 6.0)  # of the smoothing: squares of 8 to 200 px show in one of them
WEAKEST = 0.25  # of the ninth sharpest saddle: slanting light and noise, but not what an edge makes
FEWEST_SADDLES, MOST_SADDLES = 9, 4000  # saddles: three by three corners; more is texture
SQUARES = 5.0 * 1.26 ** np.arange(11)  # widths tried, of the smoothing: a third of an octave apart
SEEDS = 3  # tried at each scale
SADDLE_WINDOW = 0.15  # Gaussian sigma under which a saddle is fitted, of a square
LARGEST_SADDLE_SIGMA_PX = 6.0  # of it: corners are sharp, and larger windows cost more
BOX = 0.2  # of a square: how far off its place a corner may be
FAINTEST = 4.0  # times the uncertainty of those beside it: a saddle of noise has far more


def corner_lattices(grey: Image, most: int) -> Iterator[Floats]:
    """(R, C, 2) px of lattices of corners, NaN where one is missing, the likeliest first.

    Parameters
    ----------
    grey : (H, W) array, grey values
    most : int, rows and columns that a lattice may have
    """
    noise = np.full_like(grey, noise_of(grey))
    for scale in SCALES_PX:
        points, strength = _saddles(grey, scale)
        found = [find_crosses(points, strength, float(width * scale)) for width in SQUARES]
        best = max(found, key=lambda several: float(several.strength.sum()))
        # Up to three: a corner, the one beneath and the one to its right.
        for seeds in best.seeds[np.argsort(best.uneven, kind="stable")[:SEEDS]]:
            nodes = _grow_lattice(grey, noise, seeds, most)
            if nodes.found.sum() >= FEWEST_SADDLES:
                yield nodes.part(nodes.extent()).points


def _saddles(grey: Image, scale_px: float) -> tuple[Floats, Floats]:
    """(N, 2) px of the saddles of the smoothed picture, and (N,) how sharp they are."""
    smooth = cv2.GaussianBlur(grey, (0, 0), scale_px)
    uu, vv = (cv2.Sobel(smooth, cv2.CV_32F, *by, ksize=3) for by in ((2, 0), (0, 2)))
    uv = cv2.Sobel(smooth, cv2.CV_32F, 1, 1, ksize=3)
    sharp = np.sqrt(np.maximum(uv**2 - uu * vv, 0))
    peak = (sharp >= cv2.dilate(sharp, np.ones((5, 5), np.uint8))) & (sharp > 0)
    row, column = np.nonzero(peak)
    strength = sharp[row, column].astype(float)
    order = np.argsort(-strength, kind="stable")[:MOST_SADDLES]
    if len(order) >= FEWEST_SADDLES:
        order = order[strength[order] >= WEAKEST * strength[order[FEWEST_SADDLES - 1]]]
    return np.column_stack([column, row])[order].astype(float), strength[order]


def _grow_lattice(grey: Image, noise: Image, seeds: Floats, most: int) -> Nodes:
    """All corners that can be reached from the seeds."""
    last = np.array(grey.shape[::-1]) - 1

    def seek(expected: Floats, square: Floats, beside: Floats) -> tuple[Centres, Mask]:
        sigma = np.clip(SADDLE_WINDOW * square, SMALLEST_SIGMA_PX, LARGEST_SADDLE_SIGMA_PX)
        corners = fit_centres(grey, expected, sigma, noise, saddles=True)
        near = np.linalg.norm(corners.points - expected, axis=1) <= BOX * square + 1
        inside = ((corners.points >= 0) & (corners.points <= last)).all(axis=1)
        sharp = corners.sigma_px <= FAINTEST * beside[:, 1]
        return corners, corners.round & near & inside & sharp

    nodes = Nodes.empty(2 * most + 1, 2 * most + 1)
    where, square = seed_nodes((most, most), seeds)
    nodes.put(where, *seek(seeds, square, np.full((3, 2), np.inf)))
    spread(nodes, seek, BOX)
    return nodes


# Which corners in a picture are those of a chessboard: three detectors, and what judges them.
#
# OpenCV's two detectors differ in what they miss.  Beside slivers of further squares at the rim of
# a board the newer one may skip a row, and it draws at random.  So its numbers are drawn from one
# seed, the older one is asked where the newer one's answer is not perfect, and where neither has
# one the corners are sought from one to the next (above).  An answer counts only if the
# picture bears it out: the steps from corner to corner are even, and the squares between the
# corners and about them are dark and bright in turn.


DETECTORS = (  # the newer, then the older
    (cv2.findChessboardCornersSB, cv2.CALIB_CB_EXHAUSTIVE),
    (cv2.findChessboardCorners, cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE),
)
SEED = 1
UNEVEN = 0.3  # of a step, its change to the next: perspective makes 0.1, a skipped row 1
PATCH = 0.12  # Gaussian sigma, of a step, under which a square's grey value is taken
SIDE = 0.3  # of a step, from the middle of a square towards its sides
CLEAR_SQUARES = 0.25  # of the usual difference between squares, by which one must differ
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
    for detect in (_corners_by_opencv, _corners_by_saddles):
        for corners in detect(picture, columns, rows):
            seen = _best_lattice(picture, corners)
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


def _corners_by_opencv(picture: Bytes, columns: int, rows: int) -> Iterator[Floats]:
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


def _corners_by_saddles(picture: Bytes, columns: int, rows: int) -> Iterator[Floats]:
    """Every complete part of that size of the lattices of saddles, either way up."""
    for lattice in corner_lattices(picture.astype(np.float32), 2 * max(rows, columns)):
        for turned in (lattice, np.rot90(lattice)):
            spare = turned.shape[0] - rows, turned.shape[1] - columns
            for down, across in np.ndindex(max(spare[0] + 1, 0), max(spare[1] + 1, 0)):
                part = turned[down : down + rows, across : across + columns]
                if np.isfinite(part).all():
                    yield part


def _best_lattice(picture: Bytes, corners: Floats) -> SeenLattice | None:
    """The lattice, or the one a row or column beside it, that the squares speak for; None: none.

    Where further squares show in part the lattice may be found a row off: the whole squares about
    the rim, all of which a board shows, decide.  Where they bear out two lattices the board has
    more corners than were asked for.
    """
    if not _is_even(corners):
        return None
    rows, columns = corners.shape[:2]
    wide = _with_rim(_with_rim(corners))
    middle, whole = _alternating_squares(picture, wide)  # (rows + 3, columns + 3)
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


def _with_rim(corners: Floats) -> Floats:
    """(R + 2, C + 2, 2) the lattice with a rim about it, by equal steps."""
    for axis in (0, 1):
        p = np.moveaxis(corners, axis, 0)
        p = np.concatenate([[2 * p[0] - p[1]], p, [2 * p[-1] - p[-2]]])
        corners = np.moveaxis(p, 0, axis)
    return corners


def _alternating_squares(picture: Bytes, corners: Floats) -> tuple[Mask, Mask]:
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
    around = np.stack([shift_by(in_middle, row, column) for row, column in NEXT])
    known = np.isfinite(around)
    beside = np.where(known, around, 0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    row, column = np.indices(in_middle.shape)
    turn = (-1.0) ** (row + column)
    usual = float(np.nanmedian(((in_middle - beside) * turn)[2:-2, 2:-2]))
    turn *= np.sign(usual)
    sides = [grey(middle + way * SIDE * axis) for axis in (right, down) for way in (1, -1)]
    # A lattice whose squares are not the board's shows as much contrast, but not in turn.
    least = CLEAR_SQUARES * max(abs(usual), float(np.nanstd(np.stack(sides)[:, 2:-2, 2:-2])))
    clear = [(place - beside) * turn > least for place in (in_middle, *sides)]
    return clear[0], np.all(clear, axis=0)


# The corners of chessboards and of ChArUco boards, each with its uncertainty.


CORNER_WINDOW = 0.15  # Gaussian sigma, of the distance between corners: the next weigh nothing
LARGEST_CORNER_SIGMA_PX = 4.0
# Gaussian sigma, of the way to the next marker: what lies beyond weighs 1 % at most.
CLEAR_OF_MARKER = 1 / 3
NARROWER = 1 / 1.6  # of the second window that a corner is seen through
MOST_MOVED = 0.2  # of the distance between corners, from where OpenCV saw it
MOST_CHANGED = 6.0  # standard deviations, from window to window and from the lattice
FOURTH = np.array([1.0, -4.0, 6.0, -4.0, 1.0])  # difference of five in line
FEWEST_CORNERS = 6  # corners of a ChArUco board: a pose needs four, its check two more
LARGEST = (  # dictionaries of which the others are parts
    *(f"DICT_{bits}_1000" for bits in ("4X4", "5X5", "6X6", "7X7")),
    *(f"DICT_{name}" for name in ("ARUCO_ORIGINAL", "ARUCO_MIP_36h12")),
    *(f"DICT_APRILTAG_{name}" for name in ("25h9", "36h11")),
)
FEWEST_MARKERS = 4  # more than noise looks like; four fix a homography
LYING = 0.2  # of a square: by less do four in five markers miss their own layout


def read_chessboard(
    image: NDArray[Any], columns: int, rows: int, square_mm: float, channel: Channel = "grey"
) -> Marks:
    """All inner corners of a chessboard, row by row, the board's upper row first.

    Where columns and rows are both even or both odd the board looks the same turned by half a turn:
    the row that is upper in the picture is then the first.

    Parameters
    ----------
    image : (H, W) or (H, W, 3) array, grey or RGB
    columns, rows : int, inner corners along and down the board, 3 or more; not checked here
    square_mm : float, mm, side of a square, above 0; not checked here
    channel : str, of an RGB image; one that the laser's line does not show in, where it is on

    Returns
    -------
    Marks
        Their board_mm are (rows * columns, 2) of (x, z), mm, the first corner at the origin, x
        right, z up.

    Raises
    ------
    InputError
        For what is no picture.
    BoardNotFound
        Where not all corners are seen, or a row may have been skipped.
    """
    grey = bright_marks(image, channel, "bright")
    seen = find_lattice(_eight_bit(grey), columns, rows)
    # Either end may come first: the upper row is the one higher in the picture.
    if seen[0, :, 1].mean() > seen[-1, :, 1].mean() and (rows + columns) % 2 == 0:
        seen = seen[::-1, ::-1]
    return _measure_corners(grey, seen, square_mm, CORNER_WINDOW)


def charuco_board(
    columns: int, rows: int, square_mm: float, marker_mm: float, dictionary: str
) -> cv2.aruco.CharucoBoard:
    """A ChArUco board as OpenCV has it, its upper left square dark.

    Parameters
    ----------
    columns, rows, square_mm, marker_mm, dictionary : as for :func:`read_charuco`

    Raises
    ------
    InputError
        For markers larger than squares, or no dictionary.
    """
    if not 0 < marker_mm < square_mm:
        allowed = f"above 0, below square_mm = {square_mm:g}"
        raise InputError("bad size", where="marker_mm", value=marker_mm, allowed=allowed)
    size = (columns + 1, rows + 1)
    markers = _dictionary(dictionary, size[0] * size[1] // 2)
    return cv2.aruco.CharucoBoard(size, square_mm, marker_mm, markers)


def read_charuco(
    image: NDArray[Any],
    columns: int,
    rows: int,
    square_mm: float,
    marker_mm: float,
    dictionary: str,
    channel: Channel = "grey",
) -> Marks:
    """The inner corners of a ChArUco board, row by row; those not seen have the status NOT_FOUND.

    Parameters
    ----------
    image : (H, W) or (H, W, 3) array, grey or RGB
    columns, rows : int, inner corners, one less than the squares, 2 or more; not checked here
    square_mm, marker_mm : float, mm, sides of a square and of a marker
    dictionary : str, of the markers, as OpenCV calls it: "DICT_4X4_50"
    channel : str, as for :func:`read_chessboard`

    Returns
    -------
    Marks
        As of :func:`read_chessboard`, the first corner beside the board's upper left square.

    Raises
    ------
    InputError
        For what is no picture, markers larger than squares, or no dictionary.
    BoardNotFound
        Where fewer than six corners are seen.
    """
    board = charuco_board(columns, rows, square_mm, marker_mm, dictionary)
    size = (columns + 1, rows + 1)
    grey = bright_marks(image, channel, "bright")
    picture = _eight_bit(grey)
    corners, numbers = _charuco_corners(picture, board)
    if len(numbers) < FEWEST_CORNERS:
        raise BoardNotFound(
            f"only {len(numbers)} corners of the ChArUco board were found, "
            f"{FEWEST_CORNERS} are needed: " + _markers_in_words(picture, size, dictionary)
        )
    seen = np.full((rows, columns, 2), np.nan)
    seen[np.divmod(numbers, columns)] = corners
    # A marker lies in the middle of its square: its corner is nearest, along the diagonal.
    clear = CLEAR_OF_MARKER * (1 - marker_mm / square_mm) / np.sqrt(2)
    return _measure_corners(grey, seen, square_mm, min(CORNER_WINDOW, clear))


def _charuco_corners(picture: Bytes, board: cv2.aruco.CharucoBoard) -> tuple[Floats, Ints]:
    """(K, 2) px of a ChArUco board's corners, to about a pixel, and their numbers (K,).

    Before version 4.6 OpenCV began boards of an even number of rows with a white square, as other
    makers still do: of the two layouts the one that more corners bear out.
    """
    best: tuple[Floats, Ints] = np.empty((0, 2)), np.empty(0, dtype=np.int64)
    for legacy in (False, True):
        board.setLegacyPattern(legacy)
        corners, numbers, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(picture)
        if numbers is not None and len(numbers) > len(best[1]):
            best = np.reshape(corners, (-1, 2)).astype(float), np.ravel(numbers)
    return best


def _markers_in_words(picture: Bytes, size: tuple[int, int], dictionary: str) -> str:
    """Which markers are seen in a picture without a board of ``size`` squares, and what to do."""
    views = {
        "": picture,
        " in the mirror image, so the picture is mirrored": picture[:, ::-1],
        " in the negative, so they are printed white on black": 255 - picture,
    }
    for name in (dictionary, *LARGEST):
        for view, pixels in views.items():
            middles, numbers = _markers(np.ascontiguousarray(pixels), name)
            if len(numbers) < FEWEST_MARKERS:
                continue
            fits = (
                f"{len(numbers)} markers of {name} (numbers up to {numbers.max()}) are seen{view}"
            )
            if name != dictionary:
                fits += f", none of {dictionary}"
            layout = _layout(middles, numbers)
            if layout and layout != (size[0] - 1, size[1] - 1):
                fits += (
                    f"; they lie as on a board of columns = {layout[0]}, rows = {layout[1]} or more"
                )
            return fits
    return "no markers of any dictionary are seen: bring them into view, lit and sharp"


def _markers(picture: Bytes, dictionary: str) -> tuple[Floats, Ints]:
    """(K, 2) px of the middles of the markers seen, and their numbers (K,)."""
    known = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    corners, numbers, _ = cv2.aruco.ArucoDetector(known).detectMarkers(picture)
    if numbers is None:
        return np.empty((0, 2)), np.empty(0, dtype=np.int64)
    return np.reshape(corners, (-1, 4, 2)).mean(axis=1).astype(float), np.ravel(numbers)


def _layout(middles: Floats, numbers: Ints) -> tuple[int, int] | None:
    """(columns, rows) of inner corners of the ChArUco board on which markers lie so; None if none.

    Rows beneath the last marker seen are not counted.
    """
    markers = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_1000)
    missed: dict[tuple[int, int], float] = {}
    for columns in range(3, 41):
        rows = 2 * (int(numbers.max()) + 1) // columns  # every other square holds a marker
        for size in ((columns, max(rows + more, 3)) for more in (0, 1)):
            board = cv2.aruco.CharucoBoard(size, 1.0, 0.7, markers)
            for legacy in (False, True):
                board.setLegacyPattern(legacy)
                middle = np.array(board.getObjPoints()).mean(axis=1)[:, :2]
                if len(middle) <= numbers.max():
                    continue
                matrix, _ = cv2.findHomography(middles, middle[numbers], cv2.LMEDS)
                if matrix is not None:
                    miss = cv2.perspectiveTransform(middles[None], matrix)[0] - middle[numbers]
                    far = float(np.percentile(np.linalg.norm(miss, axis=1), 80))
                    missed[size] = min(far, missed.get(size, np.inf))
    best = min(missed, key=lambda size: missed[size], default=None)
    return (best[0] - 1, best[1] - 1) if best and missed[best] < LYING else None


def _dictionary(name: str, needed: int) -> cv2.aruco.Dictionary:
    """The dictionary of that name; InputError where there is none or it has too few markers."""
    known = sorted(key for key in dir(cv2.aruco) if key.startswith("DICT_"))
    if name not in known:
        allowed = ", ".join(known)
        raise InputError("no such dictionary", where="dictionary", value=name, allowed=allowed)
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
    if len(dictionary.bytesList) < needed:
        what = f"has {len(dictionary.bytesList)} markers, the board {needed}"
        allowed = "a larger dictionary, or fewer columns and rows"
        raise InputError(what, where="dictionary", value=name, allowed=allowed)
    return dictionary


def _eight_bit(grey: Image) -> Bytes:
    low, high = float(grey.min()), float(grey.max())
    if low >= 0 and high > 1 and high <= 255:
        return np.rint(grey).astype(np.uint8)
    return np.rint((grey - low) * (255 / max(high - low, 1e-6))).astype(np.uint8)


def _measure_corners(grey: Image, lattice: Floats, square_mm: float, window: float) -> Marks:
    """The corners ``lattice`` (rows, columns, 2) px, NaN where not seen, measured anew.

    window: Gaussian sigma they are seen through, of the distance between corners.
    """
    seen, pitch = lattice.reshape(-1, 2), local_pitch(lattice).ravel()
    known = np.isfinite(seen[:, 0]) & np.isfinite(pitch)
    sigma = np.clip(window * pitch[known], SMALLEST_SIGMA_PX, LARGEST_CORNER_SIGMA_PX)
    noise = np.full_like(grey, noise_of(grey))
    corners = fit_centres(grey, seen[known], sigma, noise, saddles=True)
    moved = np.linalg.norm(corners.points - seen[known], axis=1)
    height, width = grey.shape
    inside = ((corners.points >= 0) & (corners.points <= [width - 1, height - 1])).all(axis=1)
    good = corners.round & inside & (moved <= MOST_MOVED * pitch[known])
    floor, alone = _disagreement(grey, corners.points[good], sigma[good], noise)
    good[good] = alone
    image, sigma_px = np.full_like(seen, np.nan), np.full(len(seen), np.nan)
    found = np.flatnonzero(known)[good]
    image[found] = corners.points[good]
    sigma_px[found] = np.hypot(corners.sigma_px[good], floor)
    out = _off_the_lattice(image.reshape(lattice.shape), sigma_px.reshape(lattice.shape[:2]))
    image[out.ravel()] = sigma_px[out.ravel()] = np.nan
    found = np.flatnonzero(np.isfinite(sigma_px))
    status = np.full(len(seen), int(Status.NOT_FOUND), dtype=np.int64)
    status[found] = int(Status.OK)
    return Marks(grid_points_mm(lattice.shape, square_mm).reshape(-1, 2), image, sigma_px, status)


def _off_the_lattice(image: Floats, sigma_px: Floats) -> Mask:
    """(rows, columns) mask of corners that lie off their row and off their column.

    image: (rows, columns, 2) px, NaN where not found; sigma_px: (rows, columns).  Along a row or a
    column of a flat board the corners' pixels are smooth: of five in line the fourth difference is
    noise, sqrt(70) times that of one.  A wrong corner stands out in both, its neighbours in one.
    """
    change = np.full((2, *sigma_px.shape), np.nan)
    for axis in (0, 1):
        lines = np.moveaxis(image, axis, 0)
        if len(lines) >= len(FOURTH):
            fives = sliding_window_view(lines, len(FOURTH), axis=0)
            length = np.linalg.norm(fives @ FOURTH, axis=-1) / np.linalg.norm(FOURTH)
            nearest = np.clip(np.arange(len(lines)) - len(FOURTH) // 2, 0, len(fives) - 1)
            np.moveaxis(change[axis], axis, 0)[:] = length[nearest]
    # The line that spoils one corner of each column spoils one row: the other way tells the noise.
    usual = min(
        (np.median(some[np.isfinite(some)]) for some in change if np.isfinite(some).any()),
        default=0.0,
    )
    return np.fmin(*change) > MOST_CHANGED * np.fmax(sigma_px, usual / np.sqrt(2 * np.log(2)))


def _disagreement(grey: Image, points: Floats, sigma: Floats, noise: Image) -> tuple[float, Mask]:
    """Root mean square of a coordinate's change, px, when corners are seen through less.

    And (N,) which corners change no more than the others do: a laser's line, a reflection or dirt
    beside a corner draws the wider window farther.

    points: (N, 2) px found with windows of ``sigma`` (N,) px.  What noise makes of it is taken
    off: the errors in the narrower window are the larger and nearly hold those in the wider.
    The median keeps out the corners at which the narrower window sees something else.
    """
    narrow = np.maximum(NARROWER * sigma, SMALLEST_SIGMA_PX)
    again = fit_centres(grey, points, narrow, noise, saddles=True)
    if not again.round.any():
        return 0.0, np.ones(len(points), dtype=bool)
    square = ((again.points - points) ** 2).sum(axis=1)
    # Of a normal error in u and in v the squared length has the median 2 ln 2 variances.
    variance = float(np.median(square[again.round])) / (2 * np.log(2))
    own = float(np.median(again.sigma_px[again.round])) ** 2
    alike = square <= MOST_CHANGED**2 * np.maximum(variance, again.sigma_px**2)
    return float(np.sqrt(max(variance - own, 0.0))), ~again.round | alike
