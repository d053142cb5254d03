"""Fields of records that a calibration file holds: arrays as lists of finite JSON numbers.

The dataclasses that maps are made of use these types, so that one declaration serves the program
and the strict reading of its files.
"""

from collections.abc import Sequence
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

from lscan.camera.posedboards import LIMITS, NEWER
from lscan.records import Floats

STRICT = ConfigDict(extra="forbid")
Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0)]
Count = Annotated[int, Field(strict=True, ge=0)]


_LISTS: TypeAdapter[Any] = TypeAdapter(list[Number | None] | list[list[Number | None]])
_ALLOWED = {
    1: "a list of finite numbers",
    2: "rows of finite numbers, all of one length",
    None: "finite numbers or nulls, all rows of one length",
}


def _array(value: Any, dimensions: int | None) -> Floats:
    """An array of what JSON holds; dimensions None: 1 or 2, with ``null`` for NaN."""
    try:
        lists = value if isinstance(value, np.ndarray) else _LISTS.validate_python(value)
        array: Floats = np.asarray(lists, dtype=float)
        if dimensions and (array.ndim != dimensions or not np.isfinite(array).all()):
            raise ValueError
    except (ValueError, OverflowError) as error:
        raise ValueError(f"must be {_ALLOWED[dimensions]}") from error
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


def _plain(array: Floats) -> list[Any]:
    """As lists, ``null`` for NaN."""
    plain = array.astype(object)
    plain[np.isnan(array)] = None
    return plain.tolist()


Vector = Annotated[Floats, PlainValidator(partial(_array, dimensions=1)), PlainSerializer(_plain)]
Matrix = Annotated[Floats, PlainValidator(partial(_array, dimensions=2)), PlainSerializer(_plain)]
FloatsWithGaps = Annotated[
    Floats, PlainValidator(partial(_array, dimensions=None)), PlainSerializer(_plain)
]
"""``null`` in the file for NaN."""
NotNegativeOrNaN = Annotated[
    NotNegative,
    WrapValidator(lambda value, read: np.nan if value is None or value != value else read(value)),
    PlainSerializer(lambda value: None if np.isnan(value) else value),
]
"""``null`` in the file for NaN."""
Place = Annotated[Vector, of_length(2)]
Pair = Annotated[Place, AfterValidator(none_negative)]
Sigmas = Annotated[FloatsWithGaps, AfterValidator(none_negative)]


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
    older = [name for name in names if name not in NEWER]
    if list(theta) == older:
        theta = {name: theta.get(name, 0.0) for name in names}
    if tuple(theta) != tuple(names):
        raise ValueError(f"theta must hold {', '.join(names)}")
    if theta.get("fisheye", 0.0) not in (0.0, 1.0):
        raise ValueError("theta.fisheye must be 0 or 1")
    for name, (low, high) in LIMITS.items():
        if not low <= theta[name] <= high:
            raise ValueError(f"theta.{name} must be {low:g} to {high:g}")
    return theta
