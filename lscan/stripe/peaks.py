"""Which columns of a picture have a line in them, and at which pixel it peaks."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from lscan.config.rig import StripeSection
from lscan.records import Floats, GreyValues, Ints, Mask, Status, Stripe, has_value
from lscan.stripe.ranks import crests, ranked

_Value = TypeVar("_Value", bound=np.generic)


@dataclass(frozen=True)
class Peaks:
    """The columns that have a whole line in them: K of W.

    Attributes
    ----------
    columns : (K,) array, their indices
    rows : (K,) array, px, row of the nominal peak
    base : (K,) array, DN, the column's background, its median
    """

    columns: Ints
    rows: Ints
    base: Floats


def nominal_peaks(pictures: Sequence[GreyValues], settings: StripeSection) -> tuple[Stripe, Peaks]:
    """A stripe with peaks and statuses but no centres yet, and the columns that have a line.

    A column has a line where its highest value, the first maximum from the top, exceeds its
    median by more than ``threshold_dn``: NO_PEAK otherwise, AT_BORDER where ``span_px`` to
    either side do not fit the picture.

    Parameters
    ----------
    pictures : sequence of (W, H) array, DN, one column of a picture a row; of one size, side by
        side as one picture
    settings : StripeSection, threshold and span

    References
    ----------
    Sec. V.B of the paper.
    """
    height = pictures[0].shape[1]
    places = [crests(columns) for columns in pictures]
    rows = np.concatenate(places)
    base = np.concatenate([ranked(columns, height // 2) for columns in pictures])
    each = zip(pictures, places, strict=True)
    peak = np.concatenate([columns[np.arange(len(row)), row] for columns, row in each]) - base
    width = len(rows)
    border = (rows < settings.span_px) | (rows >= height - settings.span_px)
    status = np.full(width, int(Status.OK), dtype=np.int64)
    status[border] = Status.AT_BORDER
    status[peak <= settings.threshold_dn] = Status.NO_PEAK
    empty = np.full(width, np.nan)
    stripe = Stripe("columns", empty, empty.copy(), peak, status)
    found = np.flatnonzero(status == Status.OK)
    return stripe, Peaks(found, rows[found], base[found])


def all_windows(columns: NDArray[_Value], length: int) -> NDArray[_Value]:
    """(W, H - n + 1, n) view of all windows of n pixels, in a tenth of the time of NumPy's own.

    Parameters
    ----------
    columns : (W, H) array, one column of the picture a row
    length : int, n, at most H
    """
    columns = np.ascontiguousarray(columns)
    (width, height), (across, along) = columns.shape, columns.strides
    shape, strides = (width, height - length + 1, length), (across, along, along)
    every = np.ndarray(shape, columns.dtype, columns.data, strides=strides)
    every.flags.writeable = False
    return every


def windows(columns: NDArray[Any], at: Ints, rows: Ints, steps: Ints | int) -> Floats:
    """Pixels (K, n) of some columns about a row of each; beyond an edge its pixel is repeated.

    Parameters
    ----------
    columns : (W, H) array, one column of the picture a row, of any type; of a mask 0 and 1 come
    at : (K,) array, indices of the columns
    rows : (K,) array, px, the middle row of each
    steps : (n,) array or int, px, from the middle row; an integer: up to so many to either side
    """
    height = columns.shape[1]
    if isinstance(steps, int):
        begin, end = rows - steps, rows + steps
        if len(rows) and begin.min() >= 0 and end.max() < height:
            every = all_windows(columns, 2 * steps + 1)
            return every[at, begin].astype(np.float64, copy=False)
        steps = np.arange(-steps, steps + 1)
    inside = np.minimum(np.maximum(rows[:, None] + steps, 0), height - 1)
    inside += height * at[:, None]
    return columns.reshape(-1).take(inside).astype(np.float64, copy=False)


def windows_beside(
    pictures: Sequence[NDArray[Any]], at: Ints, rows: Ints, steps: Ints | int
) -> Floats:
    """The :func:`windows` of pictures side by side as one picture.

    Parameters
    ----------
    pictures : sequence of (W, H) array, of one size
    at : (K,) array, indices of the columns of all, rising
    rows, steps : as :func:`windows` takes them
    """
    first = np.arange(len(pictures)) * len(pictures[0])
    begin = np.searchsorted(at, first)
    parts = zip(pictures, np.split(at, begin[1:]), np.split(rows, begin[1:]), first, strict=True)
    return np.concatenate([windows(one, here - k, row, steps) for one, here, row, k in parts])


def centred(stripe: Stripe, peaks: Peaks, offset: Floats, sigma_px: Floats, kept: Mask) -> Stripe:
    """The stripe with centres beside the peaks, NO_PEAK where they are not kept.

    Parameters
    ----------
    stripe : Stripe, px, of W entries
    peaks : Peaks, of K columns
    offset : (K,) array, px, of the centre from the peak
    sigma_px : (K,) array, px, standard uncertainty of the centre
    kept : (K,) mask, of the columns that have a centre
    """
    centre_px, sigma = stripe.centre_px.copy(), stripe.sigma_px.copy()
    status = stripe.status.copy()
    at = peaks.columns[kept]
    status[peaks.columns[~kept]] = Status.NO_PEAK
    centre_px[at] = (peaks.rows + offset)[kept]
    sigma[at] = sigma_px[kept]
    return replace(stripe, centre_px=centre_px, sigma_px=sigma, status=status)


def clipped_near(stripe: Stripe, clipped: Mask, span_px: int) -> Ints:
    """Indices of the stripe's entries that have a clipped pixel near the centre.

    Parameters
    ----------
    stripe : Stripe, px, of N entries
    clipped : (N, L) mask, of the pixels along the line's normal of each entry
    span_px : int, px, to either side of the centre
    """
    if not clipped.any():
        return np.zeros(0, dtype=np.int64)
    valued = np.flatnonzero(has_value(stripe.status))
    middle = np.rint(stripe.centre_px[valued]).astype(int)
    return valued[windows(clipped, valued, middle, span_px).any(axis=1)]
