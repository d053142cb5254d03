"""The adaptive search from dot to dot (Sec. III.1, Fig. 12).

The displacement from one dot to the next predicts the one after; a box about the predicted
place is searched, and so on until no dot is left.  All dots at the rim of what has been found
are searched at once, so a board of thousands of dots takes some tens of rounds.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from lscan.board.centre import Centres, fit_centres, window_sigma
from lscan.board.picture import BoardPicture
from lscan.records import Floats, Ints, Mask

BOX = 0.22  # half side of the search box, of the pitch: keeps out what lies between the dots
SEED_BOX = 0.34  # the same for seeds given by hand, which are rough
FAINTEST = 0.5  # of the height of the dots beside it
NOISE_LIMIT = 6.0  # sigmas above the ground
ELSEWHERE = 0.1  # of the box: a mark expected less far away would have been seen before
SEARCH_STEPS = 4  # of Newton's: 1e-6 px from half a pixel away
NEXT = ((0, 1), (0, -1), (1, 0), (-1, 0))


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
    where, pitch = seeded(corner, seeds)
    centres = look(picture, seeds, SEED_BOX * pitch, window_sigma(dot * pitch / 2))
    alike = centres.height > FAINTEST * np.median(centres.height)
    nodes.put(where, centres, centres.round & alike)
    spread(nodes, seek, BOX, in_view)
    return nodes


def seeded(corner: tuple[int, int], seeds: Floats) -> tuple[tuple[Ints, Ints], Floats]:
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
        found = seen.points[accepted]
        # A row that has strayed finds the dots of another once more: each belongs to one node.
        every = cKDTree(np.vstack([part.points[part.found], found]))
        apart = np.asarray(every.query(found, k=2)[0])[:, 1]
        accepted[accepted] = apart > box * pitch[todo][accepted]
        part.put(np.nonzero(todo), seen, accepted)
        more = accepted.any()


def look(picture: BoardPicture, expected: Floats, half_box: Floats, sigma: Floats) -> Centres:
    """Centres of the marks in boxes about the expected places, N of each.

    A mark no higher than the noise is not round.

    Parameters
    ----------
    picture : BoardPicture, levelled
    expected : (N, 2) array, px, of (u, v)
    half_box : (N,) array, px
    sigma : (N,) array, px, the window for the mark's size
    """
    start = _brightest(picture, expected, half_box)
    centres = fit_centres(picture.flat, start, sigma, picture.noise, SEARCH_STEPS)
    # White noise smoothed by a Gaussian: n / (2 sqrt(pi) sigma).
    noise = picture.noise_at(start)
    visible = centres.height > NOISE_LIMIT * noise / (2 * np.sqrt(np.pi) * sigma)
    return Centres(centres.points, centres.height, centres.sigma_px, centres.round & visible)


def _brightest(picture: BoardPicture, expected: Floats, half_box: Floats) -> Floats:
    """(N, 2) brightest pixel of the smoothed picture in each box."""
    if len(expected) == 0:
        return expected
    width, height = picture.size
    middle = np.rint(expected).astype(np.int64)
    reach = int(np.ceil(half_box.max()))
    span = np.arange(-reach, reach + 1)
    u, v = middle[:, :1] + span, middle[:, 1:] + span
    allowed = np.abs(span) <= np.maximum(np.round(half_box), 1)[:, None]
    use_u, use_v = allowed & (u >= 0) & (u < width), allowed & (v >= 0) & (v < height)
    window = picture.smooth[
        np.clip(v, 0, height - 1)[:, :, None], np.clip(u, 0, width - 1)[:, None, :]
    ]
    usable = use_v[:, :, None] & use_u[:, None, :]
    best = np.where(usable, window, -np.inf).reshape(len(middle), -1).argmax(axis=1)
    row, column = np.divmod(best, len(span))
    return np.column_stack([middle[:, 0] + span[column], middle[:, 1] + span[row]]).astype(float)


def expected_places(points: Floats) -> Floats:
    """(R, C, 2) px where each node should be, from those known; NaN where no neighbour is known.

    The mean of the paper's step (the last displacement again) from each side and of the
    parallelogram that completes each neighbouring cell.

    Parameters
    ----------
    points : (R, C, 2) array, px, (u, v) of the nodes known; NaN where none
    """
    p = points
    guesses = [2 * moved(p, r, c) - moved(p, 2 * r, 2 * c) for r, c in NEXT]
    for r, c in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        guesses.append(moved(p, r, 0) + moved(p, 0, c) - moved(p, r, c))
    return _mean_of_known(guesses)


def mean_beside(values: Floats) -> Floats:
    """(R, C) mean of what is known at the four nodes beside each.

    Parameters
    ----------
    values : (R, C) array, NaN where nothing is known
    """
    return _mean_of_known([moved(values, r, c) for r, c in NEXT])


def local_pitch(points: Floats) -> Floats:
    """(R, C) mean distance px from each of the nodes to its neighbours; NaN if none.

    Parameters
    ----------
    points : (R, C, 2) array, px, (u, v) of the nodes
    """
    u, v = points[..., 0], points[..., 1]
    axes = []
    for r, c in NEXT[::2]:
        step = np.hypot(u - moved(u, r, c), v - moved(v, r, c))
        axes.append(_mean_of_known([step, moved(step, -r, -c)]))
    return _mean_of_known(axes)


def moved(array: Floats, rows: int, columns: int) -> Floats:
    """The array with each node holding what is some rows and columns away; NaN outside.

    Parameters
    ----------
    array : (R, C, ...) array, of the nodes
    rows, columns : int, how far away
    """
    found = np.full_like(array, np.nan)  # some thousand calls a board: np.pad takes 8 times as long
    height, width = array.shape[:2]
    there = _overlap(rows, height), _overlap(columns, width)
    found[_overlap(-rows, height), _overlap(-columns, width)] = array[there]
    return found


def _overlap(shift: int, length: int) -> slice:
    """What is left of an axis once it has been shifted against itself."""
    return slice(max(shift, 0), max(length + min(shift, 0), 0))


def _mean_of_known(values: list[Floats]) -> Floats:
    """Mean over the list of what is not NaN; NaN where nothing is known."""
    stack = np.stack(values)
    known = np.isfinite(stack)
    count = known.sum(axis=0)
    total = np.where(known, stack, 0).sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
