"""Pictures side by side, as one wide picture: what goes by columns takes all in one step.

To begin a step takes NumPy longer than that step does for the columns of one picture.
"""

from collections.abc import Callable, Hashable, Sequence
from typing import TypeVar

import numpy as np

from lscan.records import Stripe, select

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
_Work = Callable[[Sequence[_Item]], list[_Result]]


def in_one(
    work: _Work[_Item, _Result], items: Sequence[_Item], kind: Callable[[_Item], Hashable]
) -> list[_Result]:
    """What ``work`` makes of each of the items: in one call if they are alike, else one by one.

    Parameters
    ----------
    work : callable, from items of one kind to a result for each
    items : sequence, one or more
    kind : callable, of an item: equal for those that are alike
    """
    if len(set(map(kind, items))) == 1:
        return work(items)
    return [result for item in items for result in work([item])]


def joined(stripes: Sequence[Stripe]) -> Stripe:
    """One stripe of the entries of all.

    Parameters
    ----------
    stripes : sequence of Stripe, px, of one axis, without flux
    """
    each = [(one.centre_px, one.sigma_px, one.peak, one.status) for one in stripes]
    return Stripe(stripes[0].axis, *map(np.concatenate, zip(*each, strict=True)))


def parted(stripe: Stripe, count: int) -> list[Stripe]:
    """The stripes that :func:`joined` made one of.

    Parameters
    ----------
    stripe : Stripe, px
    count : int, of parts of the same length
    """
    length = len(stripe.status) // count
    return [select(stripe, slice(k * length, (k + 1) * length)) for k in range(count)]
