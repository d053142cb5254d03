"""The corners of chessboards and of ChArUco boards, each with its uncertainty.

OpenCV finds the corners, and the picture decides which they are (chesslattice.py); their places
are measured here as saddles of a polynomial weighted by a Gaussian (centre.py), which also gives
their uncertainty.

An ideal corner lies in the same place under windows of any size.  A real one does not: the
paper bends, ink spreads, movement and coding smear the squares by unlike amounts.  What two
windows disagree by, all corners together, is added to what noise does.
"""

from typing import Any

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from lscan.board.centre import SMALLEST_SIGMA_PX, fit_centres
from lscan.board.chesslattice import find_lattice
from lscan.board.lattice import grid_points_mm
from lscan.board.picture import Image, bright_marks, noise_of
from lscan.board.search import local_pitch
from lscan.config.rig import Channel
from lscan.errors import BoardNotFound, InputError
from lscan.records import Bytes, Floats, Ints, Marks, Mask, Status

WINDOW = 0.15  # Gaussian sigma, of the distance between corners: the next weigh nothing
LARGEST_SIGMA_PX = 4.0
CLEAR = 1 / 3  # Gaussian sigma, of the way to the next marker: what lies beyond weighs 1 % at most
NARROWER = 1 / 1.6  # of the second window that a corner is seen through
MOST_MOVED = 0.2  # of the distance between corners, from where OpenCV saw it
MOST_CHANGED = 6.0  # standard deviations, from window to window and from the lattice
FOURTH = np.array([1.0, -4.0, 6.0, -4.0, 1.0])  # difference of five in line
FEWEST = 6  # corners of a ChArUco board: a pose needs four, its check two more
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
    seen = _find_corners(_eight_bit(grey), columns, rows)
    return _measured(grey, seen, square_mm, WINDOW)


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
    if not 0 < marker_mm < square_mm:
        allowed = f"above 0, below square_mm = {square_mm:g}"
        raise InputError("bad size", where="marker_mm", value=marker_mm, allowed=allowed)
    grey = bright_marks(image, channel, "bright")
    size = (columns + 1, rows + 1)
    markers = _dictionary(dictionary, size[0] * size[1] // 2)
    board = cv2.aruco.CharucoBoard(size, square_mm, marker_mm, markers)
    picture = _eight_bit(grey)
    corners, numbers = _charuco_corners(picture, board)
    if len(numbers) < FEWEST:
        raise BoardNotFound(
            f"only {len(numbers)} corners of the ChArUco board were found, {FEWEST} are needed: "
            + _markers_in_words(picture, size, dictionary)
        )
    seen = np.full((rows, columns, 2), np.nan)
    seen[np.divmod(numbers, columns)] = corners
    # A marker lies in the middle of its square: its corner is nearest, along the diagonal.
    clear = CLEAR * (1 - marker_mm / square_mm) / np.sqrt(2)
    return _measured(grey, seen, square_mm, min(WINDOW, clear))


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
        raise InputError(
            f"has {len(dictionary.bytesList)} markers, the board {needed}",
            where="dictionary",
            value=name,
            allowed="a larger dictionary, or fewer columns and rows",
        )
    return dictionary


def _eight_bit(grey: Image) -> Bytes:
    low, high = float(grey.min()), float(grey.max())
    if low >= 0 and high > 1 and high <= 255:
        return np.rint(grey).astype(np.uint8)
    return np.rint((grey - low) * (255 / max(high - low, 1e-6))).astype(np.uint8)


def _find_corners(picture: Bytes, columns: int, rows: int) -> Floats:
    """(rows, columns, 2) px of the corners to about a pixel."""
    points = find_lattice(picture, columns, rows)
    # Either end may come first: the upper row is the one higher in the picture.
    if points[0, :, 1].mean() > points[-1, :, 1].mean() and (rows + columns) % 2 == 0:
        points = points[::-1, ::-1]
    return points


def _measured(grey: Image, lattice: Floats, square_mm: float, window: float) -> Marks:
    """The corners ``lattice`` (rows, columns, 2) px, NaN where not seen, measured anew.

    window: Gaussian sigma they are seen through, of the distance between corners.
    """
    seen, pitch = lattice.reshape(-1, 2), local_pitch(lattice).ravel()
    known = np.isfinite(seen[:, 0]) & np.isfinite(pitch)
    sigma = np.clip(window * pitch[known], SMALLEST_SIGMA_PX, LARGEST_SIGMA_PX)
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
