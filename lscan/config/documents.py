"""Documents in TOML: read, includes merged, checked against strict models; written.

A document may name others to start from: ``include = "rig.toml"`` (or a list); a name such
as "paper/rig" is that of a scene that comes with lscan.  Tables are merged key by key and the
including file wins, so scenes share one rig instead of repeating it.
``exclude = ["workpiece", "lens.focus_mm"]`` beside it takes tables or keys out of
what was included.  Paths inside a document are relative to the file they stand in.
"""

import dataclasses
import hashlib
import json
import os
import re
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache, reduce
from operator import getitem
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import tomli_w
from pydantic import BaseModel, ConfigDict, GetCoreSchemaHandler, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import CoreSchema, ErrorDetails

from lscan.config.scenes import included_file, scene_file
from lscan.errors import InputError
from lscan.files.disk import (
    MOST_LEVELS,
    TOO_DEEP,
    check_values,
    content_sha256,
    dotted,
    read_text,
    write_atomically,
)

# What a field of a file's model may hold: read from the model's types, said in words.


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
        if (inner := _member(here, part)) is not None:
            here = inner
            keys.append(part)
        else:
            here = next((model for model in _models(here) if part in _tags(model)), None) or here
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
    said = [kind.words or _kind_in_words(kind) for kind in kinds(annotation)]
    return ", or ".join(dict.fromkeys(words for words in said if words))


def names(annotation: Any) -> list[str]:
    """The keys of a table; none of what is no table of one kind."""
    models = _models(annotation)
    return list(fields(models[0])) if len(models) == 1 else []


def tags_in_words(annotation: Any) -> str:
    """The values that the key ``kind`` of a table may have."""
    return _one_of([tag for model in _models(annotation) for tag in _tags(model)])


def _kind_in_words(kind: Kind) -> str:
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


# Documents in TOML: read, their includes merged, checked against strict models.


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
        what = "exclude: is not in what the file includes"
        allowed = f"{there}; a key of a table as table.key"
        raise InputError(what, where=source, value=name, allowed=allowed)
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
    key = _dotted_name(prefix, first.keys) or "document"
    others = [_dotted_name(prefix, fault.keys) for fault in faults if fault not in same]
    others = list(dict.fromkeys(others))
    also = f"; see also {', '.join(others[:MOST_NAMED])}" if others else ""
    more = f" and {len(others) - MOST_NAMED} more" if len(others) > MOST_NAMED else ""
    what = f"{key}: {first.what}{also}{more}"
    return InputError(what, where=where, value=first.value, allowed=first.allowed)


def _dotted_name(prefix: str, keys: Keys) -> str:
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
        return _ModelFault(keys, message, _keys_named_in(message, value, annotation))
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


def _keys_named_in(message: str, value: Any, annotation: Any) -> Any:
    """Of a table, the keys that a rule over several of them speaks of, with their values."""
    if not isinstance(value, dict):
        return value
    spoken = [name for name in names(annotation) if re.search(rf"\b{name}\b", message)]
    return {name: value[name] for name in spoken if name in value} or None


# Documents written as TOML files.


_PLAIN_LIST = re.compile(r"""\[\n((?: +(?:[-+.\w]+|"[^"\\\n]*"),\n)+) *\]""")
"""A list of numbers or texts as tomli-w writes it, one a line; no text holds a line end."""


def toml_text(document: Document, heading: str = "") -> str:
    """The document as TOML text, lists of numbers or texts on one line each.

    Parameters
    ----------
    document
        Tables of what TOML has.
    heading
        Comment lines, each with its ``#``, that stand first.

    Returns
    -------
    str
        What ``tomllib`` reads as the same document.

    Examples
    --------
    >>> print(toml_text({"sheet": {"apex_mm": [75.0, 0.0, 900.0]}}, "# The laser."), end="")
    # The laser.
    [sheet]
    apex_mm = [75.0, 0.0, 900.0]
    """
    text = _PLAIN_LIST.sub(_on_one_line, tomli_w.dumps(document))
    return f"{heading}\n{text}" if heading else text


def write_toml(file: Path, document: Document, heading: str = "") -> None:
    """Write a document as TOML, whole or not at all, as ``toml_text`` puts it.

    Parameters
    ----------
    file : Path, replaced where it is there
    document : Document, tables of what TOML has
    heading : str, comment lines, each with its ``#``, that stand first

    Raises
    ------
    InputError
        The disk refuses, or a text, such as a folder's name, is not Unicode.
    """
    try:
        data = toml_text(document, heading).encode()
    except UnicodeEncodeError as error:
        what = "cannot be written as TOML: holds a text that is not Unicode"
        around = error.object[max(0, error.start - 40) : error.end]
        raise InputError(what, where=file, value=around) from error
    write_atomically(file, data)


def _on_one_line(found: re.Match[str]) -> str:
    lines = found[1].rstrip("\n").split("\n")  # splitlines() also splits at U+0085 and the like
    return f"[{', '.join(line.strip(' ,') for line in lines)}]"
