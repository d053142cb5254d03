"""Pictures side by side, as one wide picture: what goes by columns takes all in one step.

To begin a step takes NumPy longer than that step does for the columns of one picture.
"""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import fields, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from lscan.records import Stripe, select

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
_Value = TypeVar("_Value", bound=np.generic)


def in_groups(
    work: Callable[[Sequence[_Item]], list[_Result]],
    items: Sequence[_Item],
    kind: Callable[[_Item], Hashable],
) -> list[_Result]:
    """What ``work`` makes of items, all those of a kind in one call; in the items' order.

    Parameters
    ----------
    work : callable, from items of one kind to a result for each
    items : sequence, one or more
    kind : callable, of an item: equal for those that go together
    """
    groups: dict[Hashable, list[int]] = {}
    for place, item in enumerate(items):
        groups.setdefault(kind(item), []).append(place)
    found: dict[int, _Result] = {}
    for places in groups.values():
        results = work([items[place] for place in places])
        found.update(zip(places, results, strict=True))
    return [found[place] for place in range(len(items))]


def beside(parts: Sequence[NDArray[_Value]]) -> NDArray[_Value]:
    """The entries of all arrays one after the other; of a single array itself.

    Parameters
    ----------
    parts : sequence of array, (W, ...) each
    """
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def joined(stripes: Sequence[Stripe]) -> Stripe:
    """One stripe of the entries of all.

    Parameters
    ----------
    stripes : sequence of Stripe, px, of one axis, with or without flux alike
    """
    first, *others = stripes
    if not others:
        return first
    arrays = [one.name for one in fields(first) if isinstance(getattr(first, one.name), np.ndarray)]
    every: dict[str, Any] = {
        name: np.concatenate([getattr(stripe, name) for stripe in stripes]) for name in arrays
    }
    return replace(first, **every)


def parted(stripe: Stripe, count: int) -> list[Stripe]:
    """The stripes that :func:`joined` made one of.

    Parameters
    ----------
    stripe : Stripe, px
    count : int, of parts of the same length
    """
    length = len(stripe.status) // count
    return [select(stripe, slice(k * length, (k + 1) * length)) for k in range(count)]
