"""The marks of a board reading, control points and rulers together."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lscan.camera.resection import BoardMarks
from lscan.records import BoardReading, Floats, Marks, Mask, Status

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
    return with_marks(reading, _hidden(joined_marks(reading), left_out))


def _hidden(marks: Marks, hide: Mask) -> Marks:
    hide = hide & marks.found
    return replace(
        marks,
        image_px=np.where(hide[:, None], np.nan, marks.image_px),
        sigma_px=np.where(hide, np.nan, marks.sigma_px),
        status=np.where(hide, int(Status.NOT_FOUND), marks.status),
    )
