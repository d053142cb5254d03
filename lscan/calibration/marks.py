"""The marks of a board reading that a plane map is solved from, and the region that they cover.

One rule for all maps: a pixel is covered where it lies in the convex hull of the control points
that the map rests on, or outside it by no more than a twentieth of the spacing of neighbouring
control points.  On the paper's board that margin is 2.5 mm, a dot's radius. Elsewhere a map gives
OUT_OF_BOARD and no number: it never extrapolates.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from lscan.calibration.fields import STRICT, Matrix, NotNegative
from lscan.camera.resection import BoardMarks
from lscan.errors import BoardNotFound, MeasurementError
from lscan.records import BoardReading, Floats, Marks, Mask, Status

MARGIN = 0.05  # of the spacing of neighbouring control points


@dataclass(frozen=True)
class Region:
    """A convex polygon in the picture, grown by a margin.

    Attributes
    ----------
    outline_px : (K, 2) array, px, corners (u, v), each edge's inside on its left in a frame with u
        to the right and v up
    margin_px : float, px, how far outside an edge still counts as inside; below 0, how far within
        it a pixel must lie
    """

    __pydantic_config__ = STRICT
    outline_px: Matrix
    margin_px: NotNegative

    def __post_init__(self) -> None:
        """Raise ValueError unless the outline is a convex polygon turning left."""
        if self.outline_px.ndim != 2 or self.outline_px.shape[1] != 2 or len(self.outline_px) < 3:
            raise ValueError("outline_px must be at least three corners (u, v)")
        edge = np.roll(self.outline_px, -1, axis=0) - self.outline_px
        after = np.roll(edge, -1, axis=0)
        if np.any(edge[:, 0] * after[:, 1] - edge[:, 1] * after[:, 0] <= 0):
            raise ValueError("outline_px must be a convex polygon")

    @cached_property
    def _outward(self) -> Floats:
        edge = np.roll(self.outline_px, -1, axis=0) - self.outline_px
        normal = np.column_stack([edge[:, 1], -edge[:, 0]])
        return normal / np.linalg.norm(normal, axis=1)[:, None]

    @property
    def bounds_px(self) -> tuple[Floats, Floats]:
        """(2,) px, the least and the greatest (u, v) in the region."""
        return (
            self.outline_px.min(axis=0) - self.margin_px,
            self.outline_px.max(axis=0) + self.margin_px,
        )

    def covers(self, image_px: Floats) -> Mask:
        """(N,) mask of the pixels that lie in the region.

        Parameters
        ----------
        image_px : (N, 2) array, px, of (u, v), finite
        """
        outwards = np.full(len(image_px), -np.inf)
        u, v = image_px.T
        for (by_u, by_v), (at_u, at_v) in zip(self._outward, self.outline_px, strict=True):
            np.maximum(outwards, by_u * (u - at_u) + by_v * (v - at_v), out=outwards)
        return outwards <= self.margin_px


def covered_region(reading: BoardReading, used: Mask) -> Region:
    """The region covered by the control points that a map rests on.

    Parameters
    ----------
    reading : BoardReading, px, of N control points
    used : (N,) mask, over ``reading.grid``

    Raises
    ------
    BoardNotFound
        Where they do not span an area or where no two are neighbours.
    """
    points = reading.grid.image_px[used]
    try:
        return region_around(points, MARGIN * spacing_px(reading))
    except MeasurementError as error:
        raise BoardNotFound(f"{len(points)} control points found: they span no area") from error


def region_around(image_px: Floats, margin_px: float = 0.0) -> Region:
    """The convex hull of pixels.

    Parameters
    ----------
    image_px : (N, 2) array, px, of (u, v)
    margin_px : float, px, grown by; below 0: made smaller by

    Raises
    ------
    MeasurementError
        Where they span no area.
    """
    try:
        hull = ConvexHull(image_px)
    except (QhullError, ValueError) as error:
        raise MeasurementError("the marks and the line span no area of the picture") from error
    return Region(image_px[hull.vertices], margin_px)


def spacing_px(reading: BoardReading) -> float:
    """Median distance in px of neighbouring control points that were found.

    Parameters
    ----------
    reading : BoardReading, px

    Raises
    ------
    BoardNotFound
        Where no two neighbours were found.
    """
    lattice = reading.grid.image_px.reshape(*reading.shape, 2)
    steps = [np.diff(lattice, axis=axis).reshape(-1, 2) for axis in (0, 1)]
    distances = np.linalg.norm(np.vstack(steps), axis=1)
    known = distances[np.isfinite(distances)]
    if not len(known):
        raise BoardNotFound("no two neighbouring control points were found")
    return float(np.median(known))


# The marks of a board reading, control points and rulers together.


LEAST_SIGMA_PX = 0.002  # a quarter of what is reached in an 8-bit picture; ours


def all_marks(reading: BoardReading) -> list[Marks]:
    """The control points, then the marks of each ruler.

    Parameters
    ----------
    reading : BoardReading, px and mm
    """
    return [reading.grid, *(ruler.marks for ruler in reading.rulers)]


def joined_marks(reading: BoardReading) -> Marks:
    """``all_marks`` as one, N of them.

    Parameters
    ----------
    reading : BoardReading, px and mm
    """
    columns = zip(*(vars(marks).values() for marks in all_marks(reading)), strict=True)
    return Marks(*map(np.concatenate, columns))


def with_marks(reading: BoardReading, marks: Marks) -> BoardReading:
    """The reading with other marks on its board.

    Parameters
    ----------
    reading : BoardReading
    marks : Marks, N of them, in the order of ``joined_marks``
    """
    ends = np.cumsum([len(own.status) for own in all_marks(reading)])[:-1]
    grid, *on_rulers = map(Marks, *(np.split(column, ends) for column in vars(marks).values()))
    pairs = zip(reading.rulers, on_rulers, strict=True)
    rulers = tuple(replace(ruler, marks=own) for ruler, own in pairs)
    return replace(reading, grid=grid, rulers=rulers)


def found_marks(several: Sequence[Marks]) -> tuple[Floats, Floats, Floats]:
    """board_mm (N, 2), image_px (N, 2) and sigma_px (N,) of all marks found, in order.

    Parameters
    ----------
    several : sequence of Marks, mm and px
    """
    return (
        np.vstack([marks.board_mm[marks.found] for marks in several]),
        np.vstack([marks.image_px[marks.found] for marks in several]),
        np.concatenate([marks.sigma_px[marks.found] for marks in several]),
    )


def found_on(several: Sequence[Marks], board: Sequence[int]) -> BoardMarks:
    """The marks that were found in several readings, each of the board of that number.

    Parameters
    ----------
    several : sequence of Marks, one a reading; sigma_px below LEAST_SIGMA_PX counts as that
    board : sequence of int, number of each reading's board
    """
    board_mm, image_px, sigma_px = found_marks(several)
    numbers = np.repeat(board, [int(marks.found.sum()) for marks in several])
    return BoardMarks(board_mm, image_px, np.maximum(sigma_px, LEAST_SIGMA_PX), numbers)


def without(reading: BoardReading, left_out: Mask) -> BoardReading:
    """The reading as if some of its marks were not found.

    Parameters
    ----------
    reading : BoardReading, of N marks
    left_out : (N,) mask, in the order of ``all_marks``
    """
    marks = joined_marks(reading)
    hide = left_out & marks.found
    marks = replace(
        marks,
        image_px=np.where(hide[:, None], np.nan, marks.image_px),
        sigma_px=np.where(hide, np.nan, marks.sigma_px),
        status=np.where(hide, int(Status.NOT_FOUND), marks.status),
    )
    return with_marks(reading, marks)
