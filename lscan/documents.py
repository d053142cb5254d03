"""TOML documents: read, merge their includes, and check them against strict models.

A document may name others to start from: ``include = "rig.toml"`` (or a list).  Tables are
merged key by key and the including file wins, so scenes share one rig instead of
repeating it.  Paths inside a document are relative to the file they stand in.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

from pydantic import BaseModel, ConfigDict, ValidationError, model_validator
from pydantic_core import PydanticCustomError

from lscan.errors import InputError

Document = dict[str, Any]
Model = TypeVar("Model", bound=BaseModel)


class Strict(BaseModel):
    """Base of every model of a file: frozen, unknown keys and non-finite numbers refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _numbers_are_numbers(cls, data: Any) -> Any:
        """Refuse "850" and true where a number is wanted, and 5.0 where a count is."""
        for name, value in data.items() if isinstance(data, dict) else ():
            field = cls.model_fields.get(name)
            wanted = _kinds(field.annotation) if field else set()
            number = bool(wanted & {int, float})
            if number and isinstance(value, bool | str) and type(value) not in wanted:
                raise _wrong_type(name, value, "must be a number")
            if number and float not in wanted and isinstance(value, float):
                raise _wrong_type(name, value, "must be a whole number")
        return data


def _kinds(annotation: Any) -> set[type]:
    """The plain types a field may hold, whatever unions and constraints surround them."""
    origin = get_origin(annotation)
    if origin is Literal:
        return {type(value) for value in get_args(annotation)}
    if origin is Annotated:
        return _kinds(get_args(annotation)[0])
    if origin in (Union, UnionType):
        return set().union(*(_kinds(part) for part in get_args(annotation)))
    return {annotation} if isinstance(annotation, type) else set()


def _wrong_type(name: str, value: Any, message: str) -> PydanticCustomError:
    return PydanticCustomError(
        "wrong_type",
        "{message} (got {value})",
        {"key": name, "value": repr(value), "message": message},
    )


def read_document(path: Path) -> Document:
    """The TOML document at ``path`` with its includes merged in and their paths resolved.

    Keys named ``file`` or ending in ``_file`` become paths that hold from anywhere.
    Raises InputError where a file is missing, is not TOML, or includes itself.
    """
    return _read(path, chain=())


def _read(path: Path, chain: tuple[Path, ...]) -> Document:
    path = path.resolve()
    if path in chain:
        raise InputError("includes itself", where=path, value=[p.name for p in chain])
    document = _parse(path)
    _anchor_paths(document, path.parent)
    includes = document.pop("include", [])
    names = [includes] if isinstance(includes, str) else includes
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise InputError("bad include", where=path, value=includes, allowed="a path or a list")
    merged: Document = {}
    for name in names:
        merged = merge(merged, _read(path.parent / name, (*chain, path)))
    return merge(merged, document)


def _parse(path: Path) -> Document:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", where=path) from error
    except UnicodeDecodeError as error:
        raise InputError("is not UTF-8 text", where=path) from error
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"is not valid TOML: {error}", where=path) from error


def _anchor_paths(table: Document, folder: Path) -> None:
    for key, value in table.items():
        if isinstance(value, dict):
            _anchor_paths(value, folder)
        elif isinstance(value, str) and (key == "file" or key.endswith("_file")):
            table[key] = str((folder / value).resolve())


def merge(base: Document, over: Document) -> Document:
    """A new document: ``base`` with the keys of ``over`` laid over it, table by table.

    A table that is of another ``kind`` than the one beneath it replaces it: what was set for
    a flat port says nothing about a dome.
    """
    result = dict(base)
    for key, value in over.items():
        beneath = result.get(key)
        if (
            isinstance(value, dict)
            and isinstance(beneath, dict)
            and not _other_kind(beneath, value)
        ):
            result[key] = merge(beneath, value)
        else:
            result[key] = value
    return result


def _other_kind(base: Document, over: Document) -> bool:
    return "kind" in over and over["kind"] != base.get("kind")


def check(model: type[Model], document: Document, where: object, prefix: str = "") -> Model:
    """The document as a ``model``; every fault becomes one InputError line.

    where: the file, for the message.  prefix: the key path the document sits under.
    """
    try:
        return model.model_validate(document)
    except ValidationError as error:
        raise InputError(_explain(error, document, prefix), where=where) from error


def _names_a_type(part: str | int) -> bool:
    """Whether a part of a fault's place names one of a union's types, not a key."""
    kinds = ("constrained-", "literal[", "function-", "tuple[", "float", "int")
    return isinstance(part, str) and part.startswith(kinds)


def _field(fault: Any, document: Document) -> tuple[str | int, ...]:
    """The keys that lead to a fault, less the kinds that pydantic puts among them."""
    keys: list[str | int] = []
    inner: Any = document
    for part in fault["loc"]:
        if _names_a_type(part) or _names_the_kind(part, inner):
            continue
        keys.append(part)
        if isinstance(inner, dict):
            inner = inner.get(part)
        else:
            inside = isinstance(inner, list | tuple) and isinstance(part, int) and part < len(inner)
            inner = inner[part] if inside else None
    return tuple(keys)


def _names_the_kind(part: str | int, table: Any) -> bool:
    """Whether a part of a fault's place is the table's ``kind``, and no key of it."""
    return isinstance(table, dict) and part not in table and table.get("kind") == part


def _explain(error: ValidationError, document: Document, prefix: str) -> str:
    faults = error.errors()
    first = faults[0]
    if first["type"] == "union_tag_invalid":
        tags = first["ctx"]["expected_tags"]
        kind = first["ctx"]["tag"]
        key = ".".join([*([prefix] if prefix else []), *map(str, first["loc"])])
        return f"{key}: no such kind {kind!r} (allowed: {tags})"
    field = _field(first, document)
    path = [*([prefix] if prefix else []), *map(str, field)]
    if first["type"] == "union_tag_not_found":
        return f"{'.'.join([*path, 'kind'])}: field required"
    alternatives = [fault for fault in faults if _field(fault, document) == field]
    if len(alternatives) > 1:  # of a value that may be of several kinds
        wanted = ", or ".join(fault["msg"][0].lower() + fault["msg"][1:] for fault in alternatives)
        return f"{'.'.join(path)}: {wanted} (got {first['input']!r})"
    if first["type"] == "wrong_type":
        path.append(first["ctx"]["key"])
    message = first["msg"].removeprefix("Value error, ")
    message = message[0].lower() + message[1:]
    if first["type"] == "extra_forbidden":
        message = "unknown key"
    elif first["type"] != "missing" and not isinstance(first["input"], dict):
        message += f" (got {first['input']!r})"
    more = f"; and {len(faults) - 1} more" if len(faults) > 1 else ""
    return f"{'.'.join(path) or 'document'}: {message}{more}"
