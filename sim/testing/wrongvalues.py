"""Values that a field of a file must refuse, told from its type and its stated limits alone."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from datetime import date
from typing import Any, Literal, get_args, get_origin

from lscan.config.allowed import Kind, fields, kinds, plain_number

A_DAY = date(1979, 5, 27)
TOO_LARGE = 10**400
"""A whole number beyond what a float holds, 1.8e308."""


def wrong_values(annotation: Any, value: Any) -> Iterator[Any]:
    """Values that no kind the annotation allows may hold, of every type TOML has.

    value: what stands there now, from which lists of a wrong length are made.  What a kind may
    hold is never among them: a whole number for a number, any text for a free text, any list
    for a list of any length.
    """
    allowed = kinds(annotation)
    plain = set().union(*(kind.plain for kind in allowed))
    is_list = any(get_origin(kind.type) in (tuple, list) for kind in allowed)
    is_table = any(kind.is_table or dict in (kind.type, get_origin(kind.type)) for kind in allowed)
    yield A_DAY
    if not any(kind.type is str for kind in allowed):
        yield from ("wrong", "12", "")
    if not plain & {int, float}:
        yield from (12345.678, 1, 0)
    if bool not in plain:
        yield from (True, False)
    if not is_list:
        yield from ([], ["wrong"], [1.5])
    if not is_table:
        yield {"wrong": 1}
    if plain & {int, float}:
        yield from (math.nan, math.inf, -math.inf, TOO_LARGE, -TOO_LARGE)
    if int in plain and float not in plain:
        yield from (1.5, 20.0)
    for kind in allowed:
        yield from (v for v in _outside(kind) if not any(_holds(k, v) for k in allowed))
        yield from _of_wrong_length(kind, value) if isinstance(value, list) else ()


def _of_wrong_length(kind: Kind, value: list[Any]) -> Iterator[list[Any]]:
    """Lists of the items of ``value``, each an item too short or too long, and an empty one."""
    if get_origin(kind.type) not in (tuple, list):
        return
    least, most = kind.limits.get("min_length", 0), kind.limits.get("max_length", math.inf)
    if get_origin(kind.type) is tuple and get_args(kind.type)[-1] is not Ellipsis:
        least = most = len(get_args(kind.type))
    if least > 0:
        yield from ([], value[: least - 1])
    if most < math.inf and value:
        yield [*value, *value[-1:] * (most + 1 - len(value))]


def words_wanted(annotation: Any) -> list[str]:
    """What a message must say of what is allowed: every limit, choice and key there is."""
    wanted: list[str] = []
    for kind in kinds(annotation):
        wanted += [plain_number(v) for k, v in kind.limits.items() if k in ("ge", "gt", "le", "lt")]
        if get_origin(kind.type) is Literal:
            wanted += [repr(value) for value in get_args(kind.type)]
        if kind.is_table:
            table = fields(kind.type)
            wanted += ["kind"] if "kind" in table else list(table)
        if float in kind.plain or int in kind.plain:
            wanted.append("whole number" if int in kind.plain else "number")
        if kind.type is bool:
            wanted.append("true or false")
        if kind.type is str:
            wanted.append(kind.words or "text")
        if get_origin(kind.type) in (tuple, list):
            lengths = [kind.limits[k] for k in ("min_length", "max_length") if k in kind.limits]
            fixed = get_args(kind.type)[-1] is not Ellipsis
            wanted += ["list of" if fixed else "list", *map(str, lengths)]
    return wanted


def _outside(kind: Kind) -> Iterator[Any]:
    """The nearest values beyond each limit, the limit itself where it is excluded."""
    limits, whole = kind.limits, int in kind.plain
    for name, way in (("ge", -math.inf), ("le", math.inf)):
        if name in limits:
            edge = limits[name]
            step = 1 if way > 0 else -1
            yield edge + step if whole else math.nextafter(edge, way)
    yield from (limits[name] for name in ("gt", "lt") if name in limits)
    if kind.type is str and limits.get("min_length"):
        yield ""
    if "pattern" in limits:
        yield from (text for text in ("", "?", "wrong") if not re.search(limits["pattern"], text))


def _holds(kind: Kind, value: Any) -> bool:
    """Whether a kind's type and limits let a number or a text pass."""
    limits = kind.limits
    if isinstance(value, str):
        short = len(value) < limits.get("min_length", 0)
        fits = re.search(limits.get("pattern", ""), value) is not None
        return kind.type is str and fits and not short
    if not kind.plain & {int, float}:
        return False
    above = limits.get("ge", -math.inf) <= value and limits.get("gt", -math.inf) < value
    below = value <= limits.get("le", math.inf) and value < limits.get("lt", math.inf)
    return bool(above and below)
