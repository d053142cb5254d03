"""Values of a rank in the columns of a picture: the highest, and the median."""

import numpy as np

from lscan.records import Floats, GreyValues, Ints


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
    return _parted(columns, rank)[:, rank].astype(np.float64)


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
    half = columns.shape[1] // 2
    parted = _parted(columns, half)
    upper = parted[:, half].astype(np.float64)
    return upper if columns.shape[1] % 2 else (parted[:, :half].max(axis=1) + upper) / 2


def _parted(columns: GreyValues, rank: int) -> GreyValues:
    """(W, H) each column with the value of the rank in its place, none before it higher."""
    # The types that NumPy sorts fastest.
    kind = np.int16 if np.issubdtype(columns.dtype, np.integer) else np.float32
    return np.partition(columns.astype(kind), rank, axis=1)
