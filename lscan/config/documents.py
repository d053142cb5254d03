"""Documents in TOML: read, their includes merged, checked against strict models.

A document may name others to start from: ``include = "rig.toml"`` (or a list); a name such
as "paper/rig" is that of a scene that comes with lscan.  Tables are merged key by key and the
including file wins, so scenes share one rig instead of repeating it.
``exclude = ["workpiece", "lens.focus_mm"]`` beside it takes tables or keys out of
what was included.  Paths inside a document are relative to the file they stand in.
"""

import hashlib
import json
import os
import re
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, GetCoreSchemaHandler, ValidationError
from pydantic_core import CoreSchema, ErrorDetails

from lscan.config.allowed import Keys, in_words, names, tags_in_words, trace
from lscan.config.scenes import included_file, scene_file
from lscan.errors import InputError
from lscan.files.disk import MOST_LEVELS, TOO_DEEP, check_values, content_sha256, dotted, read_text

Document = dict[str, Any]
Model = TypeVar("Model", bound=BaseModel)

MOST_FILES = 100
"""That a document includes in all; each may include others, and one file more than once."""
MOST_NAMED = 3
"""Of keys at fault besides the first that a message names."""

_PART = r"""(?:[\w-]++|"(?:[^"\\\n]|\\.)*+"|'[^'\n]*+')"""
_DEEP_KEY = re.compile(rf"(?<![\w-])(?:{_PART}[ \t]*+\.[ \t]*+){{{MOST_LEVELS}}}")
"""A dotted key of TOML with more parts than that."""


def _make_scalars_strict(schema: Any) -> None:
    """Refuse "850" and true where a number is wanted, 5.0 where a count is, and the like.

    ``strict`` in a model's configuration would also refuse a list for a tuple, and TOML and JSON
    have lists only.
    """
    if isinstance(schema, dict):
        if schema.get("type") in ("bool", "int", "float", "str"):
            schema["strict"] = True
        for part in schema.values():
            _make_scalars_strict(part)
    elif isinstance(schema, list | tuple):
        for part in schema:
            _make_scalars_strict(part)


class Strict(BaseModel):
    """Base of every model of a file: frozen, unknown keys and non-finite numbers refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        schema = handler(source)
        _make_scalars_strict(schema)
        return schema


def read_document(path: Path | str) -> Document:
    """The TOML document at ``path``, or of a scene's name, its includes merged and paths resolved.

    Parameters
    ----------
    path : Path or str
        A file of that path comes before a scene of that name.

    Returns
    -------
    dict
        Keys named ``file`` or ending in ``_file`` are paths that hold from anywhere.

    Raises
    ------
    InputError
        Where a file is missing, is not TOML, includes itself, or excludes what it does not
        include.
    """
    return _read(scene_file(path), chain=(), read=[])


def _read(path: Path, chain: tuple[Path, ...], read: list[Path]) -> Document:
    """The document at ``path``.

    chain: the files that include it, one the other.  read: all files read so far, added to.
    """
    path = Path(os.path.realpath(path))
    if path in chain:
        raise InputError("includes itself", where=path, value=[p.name for p in chain])
    if len(read) > MOST_FILES:
        allowed = f"{MOST_FILES} files in all"
        raise InputError("includes too many files", where=read[0], allowed=allowed)
    read.append(path)
    document = _parse(path)
    check_values(document, path)
    _anchor_paths(document, path)
    files, excluded = (_texts(document, key, path) for key in ("include", "exclude"))
    merged: Document = {}
    for file in files:
        merged = merge(merged, _read(included_file(path.parent, file), (*chain, path), read))
    for name in excluded:
        _exclude(merged, name, path)
    return merge(merged, document)


def _texts(document: Document, key: str, source: Path) -> list[str]:
    """What ``include`` or ``exclude`` names, taken out of the document of the file ``source``."""
    value = document.pop(key, [])
    texts = [value] if isinstance(value, str) else value
    if not isinstance(texts, list) or not all(isinstance(text, str) and text for text in texts):
        what = "a path" if key == "include" else "a dotted key"
        raise InputError(f"bad {key}", where=source, value=value, allowed=f"{what} or a list")
    return texts


def _exclude(included: Document, name: str, source: Path) -> None:
    """Remove the table or key ``name``, dotted, from what the file ``source`` includes."""
    *tables, key = name.split(".")
    table = _value_at(included, tuple(tables))
    if not isinstance(table, dict) or key not in table:
        there = ", ".join(sorted(included)) or "nothing, for the file includes none"
        raise InputError(
            "exclude: is not in what the file includes",
            where=source,
            value=name,
            allowed=f"{there}; a key of a table as table.key",
        )
    del table[key]


def _parse(path: Path) -> Document:
    text = read_text(path)
    deep = _DEEP_KEY.search(text)
    if deep:  # tomllib takes memory as the square of a key's parts: 4 GB for 32,000
        what = f"{'.'.join(deep.group().split('.')[:3])}...: {TOO_DEEP}"
        raise InputError(what, where=path, allowed=f"{MOST_LEVELS} levels")
    try:
        return tomllib.loads(text)
    except ValueError as error:  # also of a number of thousands of digits
        raise InputError(f"is not valid TOML: {error}", where=path) from error
    except RecursionError as error:
        raise InputError(TOO_DEEP, where=path, allowed=f"{MOST_LEVELS} levels") from error


def _anchor_paths(table: Document, source: Path, within: str = "") -> None:
    """Make the paths in a table of the file ``source`` absolute.  within: the table's key."""
    for key, value in table.items():
        if isinstance(value, dict):
            _anchor_paths(value, source, f"{within}{key}.")
        elif isinstance(value, str) and _names_file(key):
            if value == "":
                what = f"{within}{key}: must be a text that is a path"
                raise InputError(what, where=source, value=value)
            table[key] = os.path.realpath(source.parent / value)


def named_files(document: Document) -> dict[str, str]:
    """SHA-256 of what each file holds that a document names, by its path; "" where it is missing.

    Parameters
    ----------
    document : Document, as ``read_document`` gives it

    Raises
    ------
    InputError
        A file cannot be read.
    """
    return {file: _sha256(Path(file)) for file in _files_in(document)}


def by_content(document: Any, key: str = "") -> Any:
    """A document with the SHA-256 of what each file holds in place of its path.

    Parameters
    ----------
    document : Document, as ``read_document`` gives it, or any value in one
    key : str, that a value stands at

    Raises
    ------
    InputError
        A file cannot be read.
    """
    if isinstance(document, dict):
        return {name: by_content(value, name) for name, value in document.items()}
    if isinstance(document, list):
        return [by_content(value) for value in document]
    if isinstance(document, str) and _names_file(key):
        return _sha256(Path(document)) or document
    return document


def _sha256(file: Path) -> str:
    """That of what a file holds; of a document that includes others, of all of them together."""
    if file.suffix == ".toml" and os.path.isfile(file) and "include" in _parse(file):  # noqa: PTH113
        text = json.dumps(by_content(read_document(file)), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()
    return content_sha256(file)


def _files_in(value: Any, key: str = "") -> Iterator[str]:
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from _files_in(inner, name)
    elif isinstance(value, list):
        for inner in value:
            yield from _files_in(inner)
    elif isinstance(value, str) and _names_file(key):
        yield value


def _names_file(key: str) -> bool:
    return key == "file" or key.endswith("_file")


def merge(base: Document, over: Document) -> Document:
    """A new document: one with the keys of another laid over it, table by table.

    A table that is of another ``kind`` than the one beneath it replaces it: what was set for
    a flat port says nothing about a dome.

    Parameters
    ----------
    base : Document, the document beneath
    over : Document, the document whose keys win

    Examples
    --------
    >>> merge({"plan": {"frames": 3, "step_mm": 1.0}}, {"plan": {"frames": 9}})
    {'plan': {'frames': 9, 'step_mm': 1.0}}
    """
    result = dict(base)
    for key, value in over.items():
        beneath = result.get(key)
        if (
            isinstance(value, dict)
            and isinstance(beneath, dict)
            and value.get("kind", beneath.get("kind")) == beneath.get("kind")
        ):
            result[key] = merge(beneath, value)
        else:
            result[key] = value
    return result


def check(model: type[Model], document: Document, where: object, prefix: str = "") -> Model:
    """The document as a model.

    Parameters
    ----------
    model : type
        A class of pydantic, such as a ``Strict``.
    document : dict
        What it is made from.
    where : object
        The file, for the message.
    prefix : str
        The key path that leads to the document in the file; "--" of options of a command line,
        which are then named as they are typed.

    Raises
    ------
    InputError
        One line that names the key at fault, its value and what is allowed.
    """
    try:
        return model.model_validate(document)
    except ValidationError as error:
        raise _explain(error, model, document, where, prefix) from error


@dataclass(frozen=True)
class _ModelFault:
    """One thing that is wrong: the keys that lead to it, what, the value, and what is allowed."""

    keys: Keys
    what: str
    value: Any = None
    allowed: str | None = None


def _explain(
    error: ValidationError, model: type[BaseModel], document: Document, where: object, prefix: str
) -> InputError:
    """The first fault as one line: the file, the key, the value and what is allowed."""
    faults = [_fault(raw, model, document) for raw in error.errors()]
    # Of a value that may be of several kinds each kind finds fault: the one that got furthest
    # into the value says most.
    place = faults[0].keys
    same = [fault for fault in faults if fault.keys[: len(place)] == place]
    first = max(same, key=lambda fault: len(fault.keys))
    key = _named(prefix, first.keys) or "document"
    others = [_named(prefix, fault.keys) for fault in faults if fault not in same]
    others = list(dict.fromkeys(others))
    also = f"; see also {', '.join(others[:MOST_NAMED])}" if others else ""
    more = f" and {len(others) - MOST_NAMED} more" if len(others) > MOST_NAMED else ""
    what = f"{key}: {first.what}{also}{more}"
    return InputError(what, where=where, value=first.value, allowed=first.allowed)


def _named(prefix: str, keys: Keys) -> str:
    if prefix == "--":
        return f"--{dotted(keys).replace('_', '-')}"
    return dotted((prefix, *keys) if prefix else keys)


def _fault(raw: ErrorDetails, model: type[BaseModel], document: Document) -> _ModelFault:
    """A fault that pydantic found, in the words and by the keys of the file."""
    place, kind = raw["loc"], raw["type"]
    if kind in ("extra_forbidden", "unexpected_keyword_argument"):
        keys, table = trace(model, place[:-1])
        allowed = ", ".join(names(table))
        return _ModelFault((*keys, place[-1]), "unknown key", raw["input"], allowed)
    if kind == "missing" and isinstance(place[-1], int):  # the list itself is too short
        place, kind = place[:-1], "too_short"
    keys, annotation = trace(model, place)
    value = _value_at(document, keys)
    if kind.startswith("union_tag") and isinstance(value, dict):
        what = "no such kind" if "kind" in value else "field required"
        return _ModelFault((*keys, "kind"), what, value.get("kind"), tags_in_words(annotation))
    if kind == "missing":
        return _ModelFault(keys, "field required", None, in_words(annotation) or None)
    if kind == "value_error":
        message = str(raw["ctx"]["error"])
        return _ModelFault(keys, message, _named_in(message, value, annotation))
    words, message = in_words(annotation), raw["msg"]
    return _ModelFault(
        keys, f"must be {words}" if words else message[0].lower() + message[1:], value
    )


def _value_at(document: Any, keys: Keys) -> Any:
    """The value that the keys lead to; None where they lead nowhere."""
    try:
        return reduce(getitem, keys, document)
    except (KeyError, IndexError, TypeError):
        return None


def _named_in(message: str, value: Any, annotation: Any) -> Any:
    """Of a table, the keys that a rule over several of them speaks of, with their values."""
    if not isinstance(value, dict):
        return value
    spoken = [name for name in names(annotation) if re.search(rf"\b{name}\b", message)]
    return {name: value[name] for name in spoken if name in value} or None
