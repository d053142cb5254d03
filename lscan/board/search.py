"""The adaptive search from dot to dot (Sec. III.1, Fig. 12).

The displacement from one dot to the next predicts the one after; a box about the predicted
place is searched, and so on until no dot is left.  All dots at the rim of what has been found
are searched at once, so a board of thousands of dots takes some tens of rounds.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.distance import cdist

from lscan.board.loops import brightest, crosses, means_of_known, round_peaks
from lscan.board.picture import (
    WORKING_RADIUS_PX,
    BoardPicture,
    Centres,
    Image,
    fit_centres,
    shrink,
    window_sigma,
)
from lscan.config.board import Board
from lscan.errors import BoardNotFound, InputError
from lscan.records import Floats, Ints, Mask

BOX = 0.22  # half side of the search box, of the pitch: keeps out what lies between the dots
SEED_BOX = 0.34  # the same for seeds given by hand, which are rough
FAINTEST = 0.5  # of the height of the dots beside it
NOISE_LIMIT = 6.0  # sigmas above the ground
ELSEWHERE = 0.1  # of the box: a mark expected less far away would have been seen before
SEARCH_STEPS = 4  # of Newton's: 1e-6 px from half a pixel away
NEXT = ((0, 1), (0, -1), (1, 0), (-1, 0))
STEPS_ON = [  # as loops.means_of_known takes them
    *((r, c, r, c, 2 * r, 2 * c) for r, c in NEXT),
    *((r, 0, 0, c, r, c) for r in (1, -1) for c in (1, -1)),
]

Seek = Callable[[Floats, Floats, Floats], tuple[Centres, Mask]]
"""From where N marks are expected (N, 2), px, the pitch there (N,), px, and the mean height and
uncertainty (N, 2) of the marks beside, to what is seen there and the mask of what is a mark."""


@dataclass(frozen=True)
class Nodes:
    """The nodes of a grid of R rows by C columns, filled in as dots are found.

    Attributes
    ----------
    values : (R, C, 4) array, u and v in px, height in grey values, and standard uncertainty of u
        and of v in px; NaN where no dot
    """

    values: Floats

    @classmethod
    def empty(cls, rows: int, columns: int) -> "Nodes":
        """A grid without dots.

        Parameters
        ----------
        rows, columns : int, of the grid
        """
        return cls(np.full((rows, columns, 4), np.nan))

    @property
    def points(self) -> Floats:
        """(R, C, 2) px."""
        return self.values[..., :2]

    @property
    def height(self) -> Floats:
        """(R, C) grey values."""
        return self.values[..., 2]

    @property
    def sigma_px(self) -> Floats:
        """(R, C) standard uncertainty of u and of v."""
        return self.values[..., 3]

    @property
    def found(self) -> Mask:
        """(R, C) mask of the nodes with a dot."""
        return np.isfinite(self.height)

    def put(self, where: tuple[Ints, ...], centres: Centres, accepted: Mask) -> None:
        """Enter the accepted dots.

        Parameters
        ----------
        where : tuple of array, (N,) rows and (N,) columns of the nodes
        centres : Centres, px, of N dots
        accepted : (N,) mask, of the dots to enter
        """
        row, column = (index[accepted] for index in where)
        found = np.column_stack([centres.points, centres.height, centres.sigma_px])
        self.values[row, column] = found[accepted]

    def part(self, window: tuple[slice, slice]) -> "Nodes":
        """The same nodes, seen through a window: what is entered there is entered here.

        Parameters
        ----------
        window : tuple of slice, of rows and of columns
        """
        return Nodes(self.values[window])

    def extent(self) -> tuple[slice, slice]:
        """From the first to the last row and column that hold a dot."""
        row, column = np.nonzero(self.found)
        return slice(row.min(), row.max() + 1), slice(column.min(), column.max() + 1)


def grow(
    picture: BoardPicture,
    seeds: Floats,
    shape: tuple[int, int],
    corner: tuple[int, int],
    dot: float,
) -> Nodes:
    """All dots that can be reached from the seeds.

    Fewer than three dots where the seeds do not sit on dots.

    Parameters
    ----------
    picture : BoardPicture, levelled
    seeds : (3, 2) array, px, (u, v) of dots #1, #2 (beneath) and #3 (to the right), good to a third
        of the pitch
    shape : tuple of int, (rows, columns) of the grid to fill
    corner : tuple of int, (row, column) of dot #1
    dot : float, the dot's diameter as a part of the pitch

    References
    ----------
    Sec. III.1 and Fig. 12 of the paper.
    """

    def in_view(points: Floats, pitch: Floats) -> Mask:
        return picture.wholly_in_view(points, dot * pitch / 2)

    def seek(expected: Floats, pitch: Floats, beside: Floats) -> tuple[Centres, Mask]:
        box = BOX * pitch
        centres = look(picture, expected, box, window_sigma(dot * pitch / 2))
        near = np.abs(centres.points - expected).max(axis=1) <= box + 1
        alike = centres.height >= FAINTEST * beside[:, 0]
        return centres, centres.round & in_view(centres.points, pitch) & near & alike

    nodes = Nodes.empty(*shape)
    where, pitch = seed_nodes(corner, seeds)
    centres = look(picture, seeds, SEED_BOX * pitch, window_sigma(dot * pitch / 2))
    alike = centres.height > FAINTEST * np.median(centres.height)
    nodes.put(where, centres, centres.round & alike)
    spread(nodes, seek, BOX, in_view)
    return nodes


def seed_nodes(corner: tuple[int, int], seeds: Floats) -> tuple[tuple[Ints, Ints], Floats]:
    """Rows and columns (3,) of the three seeds, and the pitch there (3,), px.

    Parameters
    ----------
    corner : tuple of int, (row, column) of the first
    seeds : (3, 2) array, px, (u, v) of it, of the one beneath and of the one to its right
    """
    row, column = corner
    pitch = np.full(3, np.linalg.norm(seeds[1:] - seeds[0], axis=1).mean())
    return (np.array([row, row + 1, row]), np.array([column, column, column + 1])), pitch


def spread(
    nodes: Nodes, seek: Seek, box: float, in_view: Callable[[Floats, Floats], Mask] | None = None
) -> None:
    """Fill in all marks that can be reached from those found, if these are three or more.

    Parameters
    ----------
    nodes : Nodes, px, changed in place
    seek : callable, which looks for marks at places
    box : float, half side of the box in which it does, of the pitch
    in_view : callable, optional, which of the places (R, C, 2) with their pitch (R, C) can be
        looked at; all by default
    """
    vain = np.full_like(nodes.points, np.nan)
    more = nodes.found.sum() >= 3
    while more:
        rows, columns = (slice(max(s.start - 1, 0), s.stop + 1) for s in nodes.extent())
        part, tried = nodes.part((rows, columns)), vain[rows, columns]
        expected, pitch = expected_places(part.points), mean_beside(local_pitch(part.points))
        todo = ~part.found & np.isfinite(expected[..., 0]) & np.isfinite(pitch)
        if in_view is not None:
            todo &= in_view(expected, pitch)
        # A node is searched again only once it is expected elsewhere.
        todo &= ~(np.linalg.norm(expected - tried, axis=2) < ELSEWHERE * box * pitch)
        tried[todo] = expected[todo]
        beside = mean_beside(part.values[..., 2:])[todo]
        seen, accepted = seek(expected[todo], pitch[todo], beside)
        # A row that has strayed finds the dots of another once more: each belongs to one node.
        found = seen.points[accepted]
        apart = cdist(found, np.vstack([found, part.points[part.found]]))
        np.fill_diagonal(apart, np.inf)
        accepted[accepted] = apart.min(axis=1) > box * pitch[todo][accepted]
        part.put(np.nonzero(todo), seen, accepted)
        more = accepted.any()


def look(
    picture: BoardPicture,
    expected: Floats,
    half_box: Floats,
    sigma: Floats,
    kind: Ints | None = None,
) -> Centres:
    """Centres of the marks in boxes about the expected places, N of each.

    A mark no higher than the noise is not round.

    Parameters
    ----------
    picture : BoardPicture, levelled
    expected : (N, 2) array, px, of (u, v)
    half_box : (N,) array, px
    sigma : (N,) array, px, the window for the mark's size
    kind : (N,) array, optional, as for ``fit_centres``
    """
    half = np.maximum(np.round(half_box), 1).astype(np.int64)
    start = brightest(picture.smooth, np.rint(expected).astype(np.int64), half).astype(float)
    centres = fit_centres(picture.flat, start, sigma, picture.noise, SEARCH_STEPS, kind=kind)
    # White noise smoothed by a Gaussian: n / (2 sqrt(pi) sigma).
    noise = picture.noise_at(start)
    visible = centres.height > NOISE_LIMIT * noise / (2 * np.sqrt(np.pi) * sigma)
    return Centres(centres.points, centres.height, centres.sigma_px, centres.round & visible)


def expected_places(points: Floats) -> Floats:
    """(R, C, 2) px where each node should be, from those known; NaN where no neighbour is known.

    The mean of the paper's step (the last displacement again) from each side and of the
    parallelogram that completes each neighbouring cell.

    Parameters
    ----------
    points : (R, C, 2) array, px, (u, v) of the nodes known; NaN where none
    """
    return _means(points, STEPS_ON)


def mean_beside(values: Floats) -> Floats:
    """(R, C, ...) mean of what is known at the four nodes beside each.

    Parameters
    ----------
    values : (R, C, ...) array, NaN where nothing is known
    """
    return _means(values, [step * 3 for step in NEXT])


def local_pitch(points: Floats) -> Floats:
    """(R, C) mean distance px from each of the nodes to its neighbours; NaN if none.

    Parameters
    ----------
    points : (R, C, 2) array, px, (u, v) of the nodes
    """
    across, down = (
        _means(np.linalg.norm(points - shift_by(points, *step), axis=2), [(0, 0) * 3, back * 3])
        for step, back in (NEXT[:2], NEXT[2:])
    )
    both = np.where(np.isnan(down), across, (across + down) / 2)
    return np.where(np.isnan(across), down, both)


def shift_by(array: Floats, rows: int, columns: int) -> Floats:
    """The array with each node holding what is some rows and columns away; NaN outside.

    Parameters
    ----------
    array : (R, C, ...) array, of the nodes
    rows, columns : int, how far away
    """
    return _means(array, [(rows, columns) * 3])


def _means(values: Floats, guesses: Sequence[tuple[int, ...]]) -> Floats:
    """``means_of_known`` of values (R, C, ...)."""
    several = values.reshape(*values.shape[:2], int(np.prod(values.shape[2:])))
    return means_of_known(np.ascontiguousarray(several), np.array(guesses)).reshape(values.shape)


# Round marks of one size anywhere in a picture: where the search may begin.


LONGEST = 4.0  # ratio of the curvatures along and across a blob
FEWEST = 9  # a board shows at least three by three dots
WEAKEST = 0.45  # of the ninth strongest: admits dots in light 2:1 darker
MOST = 30_000  # blobs of one size; more is texture


def find_blobs(bright: Image, radius_px: float, noise: float) -> tuple[Floats, Floats]:
    """The bright round marks of about one radius, strongest first.

    They are the maxima of the negative Laplacian of Gaussian with sigma = radius / sqrt(2),
    which answers most strongly to a disc of that radius; slopes of the light do not change it.

    Parameters
    ----------
    bright : (H, W) array, grey values, marks bright
    radius_px : float, px, of the marks
    noise : float, standard deviation of a grey value

    Returns
    -------
    tuple of array
        (N, 2) px, their (u, v) to about half a pixel, and (N,) grey values, their strength.

    References
    ----------
    Lindeberg, "Feature detection with automatic scale selection", IJCV 30 (1998).
    """
    reduction = max(1, int(radius_px / WORKING_RADIUS_PX))
    small = shrink(bright, reduction)
    sigma = radius_px / reduction / np.sqrt(2)
    smooth = np.asarray(cv2.GaussianBlur(small, (0, 0), sigma), dtype=np.float32)
    laplacian = cv2.Laplacian(smooth, cv2.CV_32F, ksize=1, scale=-1)
    response = np.asarray(laplacian, dtype=np.float32)
    # White noise n answers with n / (sqrt(2 pi) sigma); averaging has divided it already.
    floor = NOISE_LIMIT * noise / reduction / (np.sqrt(2 * np.pi) * sigma)
    peaks = round_peaks(smooth, response, floor / sigma**2, LONGEST)
    strength = sigma**2 * response.ravel()[peaks].astype(float)
    if len(peaks) >= FEWEST:
        peaks = peaks[(clear := strength >= WEAKEST * np.partition(strength, -FEWEST)[-FEWEST])]
        strength = strength[clear]
    order = np.argsort(-strength, kind="stable")[:MOST]
    row, column = np.divmod(peaks[order], small.shape[1])
    return (np.column_stack([column, row]) + 0.5) * reduction - 0.5, strength[order]


# The three first dots: a dot, the one beneath and the one to its right (Fig. 12, #1 to #3).
#
# The paper picks them by hand; they may be given so here too.  Otherwise the board file gives how
# large a dot is beside the pitch, so for each size of dot a picture could show, the blobs of that
# size are looked through for dots with a neighbour at about the pitch on all four sides.


SMALLEST_RADIUS_PX = 1.2
SIZE_STEP = 1.26  # between sizes tried: a third of an octave
PITCH_RANGE = (0.6, 1.6)  # of the pitch expected from the dot's size: blur and foreshortening
LEAN = 0.5  # tangent of the most a row may lean against a column's square: 26 degrees
UNEVEN = 0.15  # of the pitch: most by which opposite neighbours may miss being opposite
NEIGHBOURS = 23
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
        several = find_crosses(*blobs, float(2 * radius * ratio))
        weight = float(several.strength.sum())
        if weight > best_weight:
            best, best_weight = several, weight
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
    low, high = PITCH_RANGE[0] * pitch, PITCH_RANGE[1] * pitch
    steps = crosses(np.ascontiguousarray(points), low, high, NEIGHBOURS, LEAN)
    right, left, beneath, above = steps.reshape(-1, 4, 2).swapaxes(0, 1)
    scale = (np.linalg.norm(right, axis=1) + np.linalg.norm(beneath, axis=1)) / 2
    misses = np.stack([right + left, beneath + above])
    uneven = np.sqrt((misses**2).sum(axis=2)) / scale
    good: Mask = np.all(uneven < UNEVEN, axis=0)  # False where a neighbour is missing (NaN)
    seeds = np.stack([points, points + beneath, points + right], axis=1)
    return Crosses(seeds[good], uneven.sum(axis=0)[good], strength[good])


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
