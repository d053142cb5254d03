"""Arrays and numbers as a calibration file holds them: lists of finite JSON numbers.

The dataclasses that maps are made of use these types for their fields, so that one
declaration serves the program and the strict reading of its files.
"""

from collections.abc import Sequence
from functools import partial
from typing import Annotated, Any

import numpy as np
from pydantic import ConfigDict, Field, PlainSerializer, PlainValidator

from lscan.camera.parameters import LIMITS
from lscan.records import Floats

STRICT = ConfigDict(extra="forbid")
Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0)]
Count = Annotated[int, Field(strict=True, ge=0)]


def _numbers(value: Any, dimensions: int) -> Floats:
    if isinstance(value, np.ndarray):
        array = value
    else:
        array = np.array(_checked(value, dimensions), dtype=float)
    if array.ndim != dimensions or not np.isfinite(array).all():
        raise ValueError(f"must be a {dimensions}-D array of finite numbers")
    return array


def _checked(value: Any, dimensions: int) -> list[Any]:
    if not isinstance(value, list):
        raise ValueError("must be a list of numbers")
    if dimensions > 1:
        rows = [_checked(row, dimensions - 1) for row in value]
        if len({len(row) for row in rows}) > 1:
            raise ValueError("must have rows of one length")
        return rows
    if any(isinstance(number, bool) or not isinstance(number, int | float) for number in value):
        raise ValueError("must be a list of numbers")
    return value


def _pair(value: Any) -> Floats:
    array = _numbers(value, 1)
    if array.shape != (2,) or array.min() < 0:
        raise ValueError("must be two numbers not below 0")
    return array


def _with_gaps(value: Any) -> Floats:
    """Like the others, but ``null`` stands for NaN."""
    if isinstance(value, np.ndarray):
        return value
    if not isinstance(value, list):
        raise ValueError("must be a list of numbers or nulls")
    rows = value if all(isinstance(row, list) for row in value) else [value]
    filled = [[np.nan if number is None else number for number in row] for row in rows]
    array = np.array(_checked(filled, 2), dtype=float)
    if np.isinf(array).any() or _literal_nan(rows):
        raise ValueError("must be finite numbers or nulls")
    return array if rows is value else array[0]


def _literal_nan(rows: list[Any]) -> bool:
    return any(isinstance(number, float) and np.isnan(number) for row in rows for number in row)


def _plain_with_gaps(array: Floats) -> list[Any]:
    plain = array.astype(object)
    plain[np.isnan(array)] = None
    return plain.tolist()


_LISTS = PlainSerializer(np.ndarray.tolist)
Vector = Annotated[Floats, PlainValidator(partial(_numbers, dimensions=1)), _LISTS]
Matrix = Annotated[Floats, PlainValidator(partial(_numbers, dimensions=2)), _LISTS]
Pair = Annotated[Floats, PlainValidator(_pair), _LISTS]
Gaps = Annotated[Floats, PlainValidator(_with_gaps), PlainSerializer(_plain_with_gaps)]


def check_covariance(covariance: Floats, count: int) -> None:
    """Raise ValueError unless ``covariance`` is (count, count), symmetric, none negative."""
    if covariance.shape != (count, count):
        raise ValueError(f"covariance must be {count} by {count}, got {covariance.shape}")
    scale = np.abs(covariance).max(initial=0.0)
    if np.abs(covariance - covariance.T).max(initial=0.0) > 1e-9 * scale:
        raise ValueError("covariance must be symmetric")
    if np.diag(covariance).min(initial=0.0) < 0:
        raise ValueError("covariance must have no negative variance")


def check_theta(theta: dict[str, float], names: Sequence[str]) -> None:
    """Raise ValueError unless ``theta`` holds just the names, each within the camera's LIMITS."""
    if tuple(theta) != tuple(names):
        raise ValueError(f"theta must hold {', '.join(names)}")
    for name, (low, high) in LIMITS.items():
        if not low <= theta[name] <= high:
            raise ValueError(f"theta.{name} must be {low:g} to {high:g}")
