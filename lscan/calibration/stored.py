"""Arrays and numbers as a calibration file holds them: lists of finite JSON numbers.

The dataclasses that maps are made of use these types for their fields, so that one
declaration serves the program and the strict reading of its files.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Annotated, Any

import numpy as np
from pydantic import (
    AfterValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    PlainValidator,
    TypeAdapter,
    WrapValidator,
)

from lscan.camera.posedboards import LIMITS
from lscan.records import Floats

STRICT = ConfigDict(extra="forbid")
Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0)]
Count = Annotated[int, Field(strict=True, ge=0)]


_LISTS_OF: dict[int, tuple[TypeAdapter[Any], str]] = {
    1: (TypeAdapter(list[Number]), "a list of finite numbers"),
    2: (TypeAdapter(list[list[Number]]), "rows of finite numbers, all of one length"),
}
_LISTS_WITH_GAPS: TypeAdapter[Any] = TypeAdapter(list[Number | None] | list[list[Number | None]])


def _read(lists: TypeAdapter[Any], value: Any, allowed: str) -> Floats:
    """An array of what JSON holds; ValueError where it is not as allowed, or rows differ."""
    try:
        return np.array(lists.validate_python(value), dtype=float)
    except (ValueError, OverflowError) as error:
        raise ValueError(f"must be {allowed}") from error


def _numbers(value: Any, dimensions: int) -> Floats:
    lists, allowed = _LISTS_OF[dimensions]
    array = value if isinstance(value, np.ndarray) else _read(lists, value, allowed)
    if array.ndim != dimensions or not np.isfinite(array).all():
        raise ValueError(f"must be {allowed}")
    return array


def of_length(count: int) -> AfterValidator:
    """The rule for a field that its array holds so many numbers, or rows.

    Parameters
    ----------
    count : int, how many
    """

    def check(array: Floats) -> Floats:
        if len(array) != count:
            raise ValueError(f"must be of length {count}, not {len(array)}")
        return array

    return AfterValidator(check)


def none_negative(array: Floats) -> Floats:
    """The array, which must hold no number below 0.

    Parameters
    ----------
    array : (...) array, NaN for a gap

    Raises
    ------
    ValueError
        Where it does.
    """
    if (array < 0).any():
        raise ValueError("must hold no number below 0")
    return array


def _with_gaps(value: Any) -> Floats:
    """Like the others, but ``null`` stands for NaN."""
    if isinstance(value, np.ndarray):
        return value
    return _read(_LISTS_WITH_GAPS, value, "finite numbers or nulls, all rows of one length")


def _nan_for_none(value: Any, read: Callable[[Any], float]) -> float:
    return np.nan if value is None or value != value else read(value)


def _none_for_nan(value: float) -> float | None:
    return None if np.isnan(value) else value


def _plain_with_gaps(array: Floats) -> list[Any]:
    plain = array.astype(object)
    plain[np.isnan(array)] = None
    return plain.tolist()


_LISTS = PlainSerializer(np.ndarray.tolist)
Vector = Annotated[Floats, PlainValidator(partial(_numbers, dimensions=1)), _LISTS]
Matrix = Annotated[Floats, PlainValidator(partial(_numbers, dimensions=2)), _LISTS]
Place = Annotated[Vector, of_length(2)]
Pair = Annotated[Place, AfterValidator(none_negative)]
NotNegativeOrNaN = Annotated[
    NotNegative, WrapValidator(_nan_for_none), PlainSerializer(_none_for_nan)
]
"""``null`` in the file for NaN."""
Gaps = Annotated[Floats, PlainValidator(_with_gaps), PlainSerializer(_plain_with_gaps)]
Sigmas = Annotated[Gaps, AfterValidator(none_negative)]


def check_covariance(covariance: Floats, count: int) -> None:
    """Refuse what is no covariance.

    Parameters
    ----------
    covariance : array, to be symmetric, without a negative variance
    count : int, number of rows and of columns it must have

    Raises
    ------
    ValueError
        Says what is wrong with it.
    """
    if covariance.shape != (count, count):
        raise ValueError(f"covariance must be {count} by {count}, got {covariance.shape}")
    scale = np.abs(covariance).max(initial=0.0)
    if np.abs(covariance - covariance.T).max(initial=0.0) > 1e-9 * scale:
        raise ValueError("covariance must be symmetric")
    if covariance.diagonal().min(initial=0.0) < 0:
        raise ValueError("covariance must have no negative variance")


def check_theta(theta: dict[str, float], names: Sequence[str]) -> dict[str, float]:
    """The parameters of a camera, which must have the right names and ranges.

    Parameters
    ----------
    theta : dict of float, by name
    names : sequence of str, those it must have, in order

    Raises
    ------
    ValueError
        Where a name differs, or a value lies outside the camera's LIMITS.
    """
    if tuple(theta) != tuple(names):
        raise ValueError(f"theta must hold {', '.join(names)}")
    for name, (low, high) in LIMITS.items():
        if not low <= theta[name] <= high:
            raise ValueError(f"theta.{name} must be {low:g} to {high:g}")
    return theta
