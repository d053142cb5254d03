"""What a field of a file's model may hold: read from the model's types, said in words."""

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from pydantic import BaseModel
from pydantic.fields import FieldInfo

Keys = tuple[str | int, ...]

_LIMITS = ("ge", "gt", "le", "lt", "min_length", "max_length", "pattern")


@dataclass(frozen=True)
class Kind:
    """One of the kinds of value a field may hold.

    type: a plain type, a model, or a ``Literal[...]``, ``tuple[...]``, ``list[...]`` or
    ``dict[...]``.  limits: those stated of "ge", "gt", "le", "lt", "min_length", "max_length"
    and "pattern".  words: how the model itself describes it, "" where it does not.
    """

    type: Any
    limits: dict[str, Any] = field(default_factory=dict)
    words: str = ""

    @property
    def is_table(self) -> bool:
        """Whether it is a table whose keys are known: a model or a dataclass."""
        known = isinstance(self.type, type) and issubclass(self.type, BaseModel)
        return known or dataclasses.is_dataclass(self.type)

    def item(self, index: int) -> Any:
        """The annotation of the item of a list; None where there is none such."""
        origin, parts = get_origin(self.type), get_args(self.type)
        if origin is list or (origin is tuple and parts[-1] is Ellipsis):
            return parts[0]
        return parts[index] if origin is tuple and 0 <= index < len(parts) else None


@cache
def fields(table: Any) -> dict[str, Any]:
    """The annotation of each field of a model or dataclass, with all that is stated about it."""
    hints = get_type_hints(table, include_extras=True)
    if dataclasses.is_dataclass(table):
        return {field.name: hints[field.name] for field in dataclasses.fields(table)}
    return {name: hints[name] for name in table.model_fields}


def kinds(annotation: Any) -> list[Kind]:
    """The kinds of value an annotation allows, through unions and constraints; None left out."""
    return [kind for kind in _kinds(annotation, {}, "") if kind.type is not NoneType]


def _kinds(annotation: Any, limits: dict[str, Any], words: str) -> Iterator[Kind]:
    origin = get_origin(annotation)
    if origin is Annotated:
        info = FieldInfo.from_annotation(annotation)
        stated = [(name, getattr(note, name, None)) for note in info.metadata for name in _LIMITS]
        limits = limits | {name: limit for name, limit in stated if limit is not None}
        yield from _kinds(info.annotation, limits, info.description or words)
    elif origin in (Union, UnionType):
        for part in get_args(annotation):
            yield from _kinds(part, limits, words)
    else:
        yield Kind(annotation, limits, words)


def trace(model: Any, place: Keys) -> tuple[Keys, Any]:
    """The keys of the file in the place of a fault, and the annotation they lead to.

    place: as pydantic gives it, which puts names of types and of kinds among the keys.
    """
    keys: list[str | int] = []
    here: Any = model
    for part in place:
        inner = _member(here, part)
        if inner is not None:
            here = inner
            keys.append(part)
        else:
            here = _tagged(here, part) or here
    return tuple(keys), here


def _member(annotation: Any, key: str | int) -> Any:
    """The annotation of what ``key`` names in a table or a list; None where it names nothing."""
    for kind in kinds(annotation):
        if isinstance(key, int):
            inner = kind.item(key)
        elif kind.is_table:
            inner = fields(kind.type).get(key)
        else:
            inner = get_args(kind.type)[1] if get_origin(kind.type) is dict else None
        if inner is not None:
            return inner
    return None


def _tagged(annotation: Any, tag: str | int) -> Any:
    """The model, of several, whose ``kind`` is ``tag``; None where there is none."""
    return next((model for model in _models(annotation) if tag in _tags(model)), None)


def _models(annotation: Any) -> list[Any]:
    """The models and dataclasses among the kinds of value that an annotation allows."""
    return [kind.type for kind in kinds(annotation) if kind.is_table]


def _tags(model: Any) -> list[Any]:
    """The values of the key ``kind`` by which a model is known."""
    allowed = kinds(fields(model).get("kind", NoneType))
    return [value for kind in allowed for value in get_args(kind.type)]


def in_words(annotation: Any) -> str:
    """What an annotation allows, such as "a number of 0 to 100", or ""; each kind once."""
    if len(_models(annotation)) > 1:
        return f"a table with kind = {tags_in_words(annotation)}"
    said = [kind.words or _in_words(kind) for kind in kinds(annotation)]
    return ", or ".join(dict.fromkeys(words for words in said if words))


def names(annotation: Any) -> list[str]:
    """The keys of a table; none of what is no table of one kind."""
    models = _models(annotation)
    return list(fields(models[0])) if len(models) == 1 else []


def tags_in_words(annotation: Any) -> str:
    """The values that the key ``kind`` of a table may have."""
    return _one_of([tag for model in _models(annotation) for tag in _tags(model)])


def _in_words(kind: Kind) -> str:
    if get_origin(kind.type) is Literal:
        return _one_of(list(get_args(kind.type)))
    if kind.is_table:
        return f"a table of {', '.join(fields(kind.type))}"
    if get_origin(kind.type) in (tuple, list):
        return _list_in_words(kind)
    if kind.type is dict or get_origin(kind.type) is dict:
        return "a table"
    if kind.type is str:
        return "a text that is not empty" if kind.limits.get("min_length") else "a text"
    if kind.type is bool:
        return "true or false"
    number = {int: "a whole number", float: "a number"}.get(kind.type)
    return f"{number}{_range(kind.limits)}" if number else ""


def _list_in_words(kind: Kind) -> str:
    parts = get_args(kind.type)
    if get_origin(kind.type) is list or parts[-1] is Ellipsis:
        return f"a list{_length(kind.limits)}, each item {in_words(parts[0])}"
    said = [in_words(part) for part in parts]
    if len(set(said)) == 1:
        return f"a list of {len(said)}, each {said[0]}"
    return f"a list of {len(said)}: {'; '.join(said)}"


def _length(limits: dict[str, Any]) -> str:
    """Such as " of 10" or " of 2 or more"; "" where any length will do."""
    least, most = limits.get("min_length"), limits.get("max_length")
    if least == most:
        return "" if least is None else f" of {least}"
    said = [f"{least} or more"] if least else []
    said += [f"{most} or fewer"] if most is not None else []
    return f" of {' and '.join(said)}"


def _range(limits: dict[str, Any]) -> str:
    """Such as " of 0 to 100" or " above 0 and at most 1"; "" where there are no limits."""
    low, high = limits.get("ge"), limits.get("le")
    if low is not None and high is not None:
        return f" of {_plain_number(low)} to {_plain_number(high)}"
    names = {"ge": "at least", "gt": "above", "le": "at most", "lt": "below"}
    said = [f"{names[n]} {_plain_number(limits[n])}" for n in names if n in limits]
    return f" {' and '.join(said)}" if said else ""


def _plain_number(value: float) -> str:
    """A limit as it would be typed: no exponent, no ".0"."""
    return str(int(value)) if float(value).is_integer() else repr(value)


def _one_of(values: list[Any]) -> str:
    *most, last = map(repr, values)
    return f"{', '.join(most)} or {last}" if most else last
