"""Values of a rank in the columns of a picture: the highest, and the median."""

import cv2
import numpy as np

from lscan.records import Floats, GreyValues, Ints, Singles

_SPARSE = 8  # a first guess is made of every eighth pixel of every eighth column


def crests(columns: GreyValues) -> Ints:
    """(W,) row of the highest value of each column, the first of several equal ones.

    Parameters
    ----------
    columns : (W, H) array, DN, one column of the picture a row

    Examples
    --------
    >>> crests(np.array([[7, 3, 200, 200]], dtype=np.uint8))
    array([2])
    """
    # NumPy finds the place of the highest float sooner than that of the highest integer.
    floats = columns if columns.dtype == np.float64 else columns.astype(np.float32)
    return floats.argmax(axis=1)


def ranked(columns: GreyValues, rank: int) -> Floats:
    """(W,) DN, of each column the value that ``rank`` of its pixels come before in rising order.

    Parameters
    ----------
    columns : (W, H) array, DN, one column of the picture a row; floats are rounded to single
        precision, in which a camera's grey values are exact
    rank : int, 0 for the lowest, below H

    Examples
    --------
    >>> ranked(np.array([[7, 3, 200, 3]], dtype=np.uint8), 2)
    array([7.])
    """
    if not np.issubdtype(columns.dtype, np.integer):
        return _ranked_floats(columns.astype(np.float32, copy=False), rank)
    # To count the pixels up to a grey value takes a thirtieth of a partial sort.  The search begins
    # at a value that most columns are near to, and goes from there in steps twice as long each.
    sample = columns[::_SPARSE, ::_SPARSE].ravel()
    place = rank * sample.size // columns.shape[1]
    start = int(np.partition(sample, place)[place])
    middle, step = np.full(len(columns), start), 1
    least, most = (np.full(len(columns), int(end)) for end in (columns.min(), columns.max()))
    while True:
        up_to = (columns <= middle.astype(columns.dtype)[:, None]).view(np.uint8)
        enough = cv2.reduce(up_to, 1, cv2.REDUCE_SUM, dtype=cv2.CV_32S)[:, 0] > rank
        least, most = np.where(enough, least, middle + 1), np.where(enough, middle, most)
        if (least >= most).all():
            return least.astype(np.float64)
        half = (least + most) // 2
        near = np.where(enough, np.maximum(most - step, half), np.minimum(least + step - 1, half))
        middle, step = near, 2 * step


def _ranked_floats(columns: Singles, rank: int) -> Floats:
    """The same of floats: of columns that hold grey values alone by counting these."""
    with np.errstate(invalid="ignore"):
        grey = columns.astype(np.uint8 if columns.min() >= 0 else np.int16)
    whole = (grey == columns).all(axis=1)
    values, others = np.empty(len(columns)), columns[~whole]
    values[~whole] = np.partition(others, rank, axis=1)[:, rank]
    if whole.any():
        values[whole] = ranked(grey[whole], rank)
    return values


def medians(columns: GreyValues) -> Floats:
    """(W,) DN, the median of each column, of two in the middle their mean.

    Parameters
    ----------
    columns : (W, H) array, DN, as :func:`ranked` takes them

    Examples
    --------
    >>> medians(np.array([[7, 3, 200, 3]], dtype=np.uint8))
    array([5.])
    """
    if not np.issubdtype(columns.dtype, np.integer):
        columns = columns.astype(np.float32)
    half = columns.shape[1] // 2
    upper = ranked(columns, half)
    if columns.shape[1] % 2:
        return upper
    below = columns < upper.astype(columns.dtype)[:, None]
    apart = np.flatnonzero(np.count_nonzero(below, axis=1) == half)  # the lower one is less
    lower = upper.copy()
    lower[apart] = np.where(below[apart], columns[apart], columns.min()).max(axis=1)
    return (lower + upper) / 2
