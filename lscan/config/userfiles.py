"""Every key of every file that users write, read from the models that check them.

A *section* is a table of a file: its dotted name and the model that checks it.  Type, unit, bounds
and default come from the model; what a key means comes from its ``Field(description=...)`` or from
``keys.toml``.  From both come the reference, what ``lscan schema --text`` prints, and the JSON
schemas by which an editor completes and checks such a file.
"""

import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from textwrap import wrap
from typing import Any, get_args

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from lscan.config.plugins import find_plugin, installed
from lscan.files.disk import json_text, make_folder, read_text, write_atomically

GROUP = "lscan.userfiles"  # of entry points, each a function that returns a UserFile
Options = Mapping[str, Mapping[str, type[BaseModel]]]

UNITS = {  # the end of a key's name, the longest first
    "_w_m2_sr": "W/(m² sr)",
    "_mm_min": "mm/min",
    "_deg_per_m": "°/m",
    "_per_mm": "1/mm",
    "_per_m": "1/m",
    "_per_c": "nm/°C",
    "_mm_s": "mm/s",
    "_ntu": "NTU",
    "_ppm": "ppm",
    "_psu": "psu",
    "_mpa": "MPa",
    "_deg": "°",
    "_rad": "rad",
    "_mm": "mm",
    "_nm": "nm",
    "_um": "µm",
    "_mw": "mW",
    "_ms": "ms",
    "_px": "px",
    "_dn": "DN",
    "_s": "s",
    "_e": "electrons",
    "_c": "°C",
    "_m": "m",
    "_percent": "%",
}


@dataclass(frozen=True)
class Section:
    """One table of a file.

    name: dotted, as the file writes it; "" for the file itself.  variant: which of several models,
    by its ``kind`` or driver; "" where there is one.  repeated: written ``[[name]]``.
    """

    name: str
    model: type[BaseModel]
    variant: str = ""
    repeated: bool = False

    @property
    def label(self) -> str:
        """Name and variant, as ``keys.toml`` has it."""
        if self.variant:
            return f"{self.name}:{self.variant}"
        return re.sub(r"^board(\.|$)", "", self.name)  # its keys are those of a board's own file

    @property
    def title(self) -> str:
        """As the file writes it."""
        if not self.name:
            return "At the top of the file"
        name = f"[[{self.name}]]" if self.repeated else f"[{self.name}]"
        return f"{name}, {self.variant}" if self.variant else name


@dataclass(frozen=True)
class UserFile:
    """A kind of file that users write.

    Attributes
    ----------
    about : str, what it is for
    models : sequence of models, the tables of each of which stand in it
    sections : sequence of Section, in the order of the models; those of drivers' options at the end
    options : mapping, models of ``options`` by table and driver
    is_part : bool, whether it may be there to be included alone, so that any table may be missing
    """

    about: str
    models: Sequence[type[BaseModel]]
    sections: Sequence[Section]
    options: Options = field(default_factory=dict)
    is_part: bool = False


def user_file(about: str, *models: type[BaseModel], options: Options | None = None) -> UserFile:
    """A file of the tables of some models; with drivers' options it is one that others include.

    Parameters
    ----------
    about : str, what it is for
    models : types, of pydantic
    options : mapping, optional, models of ``options`` by table and driver
    """
    found = [section for model in models for section in sections(model)]
    for table, drivers in (options or {}).items():
        found += [Section(f"{table}.options", model, name) for name, model in drivers.items()]
    return UserFile(about, models, found, options or {}, is_part=options is not None)


def kinds() -> tuple[str, ...]:
    """Names of the kinds of file that are installed."""
    return installed(GROUP)


@cache
def find_file(kind: str) -> UserFile:
    """The kind of file of a name.

    Parameters
    ----------
    kind : str, one of ``kinds``

    Raises
    ------
    InputError
        There is none of that name.
    """
    found: UserFile = find_plugin(GROUP, kind)()
    return found


def sections(model: type[BaseModel], prefix: str = "", variant: str = "") -> Iterator[Section]:
    """The model's own section, then those of the models it holds, depth first."""
    yield Section(prefix, model, variant)
    yield from _inner(model, prefix)


def _inner(model: type[BaseModel], prefix: str) -> Iterator[Section]:
    for key, info in model.model_fields.items():
        name = f"{prefix}.{key}" if prefix else key
        models = models_in(info.annotation)
        repeated = not _is_single(info)
        for inner in models:
            variant = _kind(inner) if len(models) > 1 else ""
            yield Section(name, inner, variant, repeated)
            yield from _inner(inner, name)


def models_in(annotation: Any) -> list[type[BaseModel]]:
    """The models that a field may hold, in unions, lists and the like."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    found: list[type[BaseModel]] = []
    for part in get_args(annotation):
        found += [model for model in models_in(part) if model not in found]
    return found


def _is_single(info: FieldInfo) -> bool:
    return not str(info.annotation).startswith(("tuple", "list"))


def _kind(model: type[BaseModel]) -> str:
    return str(get_args(model.model_fields["kind"].annotation)[0])


def described_elsewhere(section: Section, key: str) -> bool:
    """Whether the key is a table that has a section of its own."""
    return bool(models_in(section.model.model_fields[key].annotation))


@cache
def descriptions() -> dict[str, dict[str, str]]:
    """What ``keys.toml`` says, by section and key."""
    return tomllib.loads((Path(__file__).parent / "keys.toml").read_text(encoding="utf-8"))


def description(section: Section, key: str) -> str:
    """What the key means; KeyError where nobody says so."""
    info = section.model.model_fields[key]
    return info.description or descriptions()[section.label or "file"][key]


def unit(key: str) -> str:
    """The unit that a key's name carries, "" where it has none."""
    return next((name for end, name in UNITS.items() if f"_{key}".endswith(end)), "")


def rows(section: Section) -> Iterator[tuple[str, str, str, str, str, str]]:
    """Of each key that is no table: key, type, bounds, unit, default, description."""
    schema = section.model.model_json_schema()
    for key, info in section.model.model_fields.items():
        if described_elsewhere(section, key):
            continue
        name = info.alias or key
        kind, bounds = in_words(schema["properties"][name], schema.get("$defs", {}))
        yield name, kind, bounds, unit(key), default(info), description(section, key)


def default(info: FieldInfo) -> str:
    """The default as TOML writes it; "required" where there is none, "–" for None."""
    if info.is_required():
        return "required"
    value = info.get_default(call_default_factory=True)
    return "–" if value is None else f"`{_toml(value)}`"


def _toml(value: Any) -> str:
    if isinstance(value, BaseModel):
        pairs = ", ".join(f"{key} = {_toml(item)}" for key, item in value.model_dump().items())
        return f"{{ {pairs} }}"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, tuple | list):
        return f"[{', '.join(map(_toml, value))}]"
    if isinstance(value, dict):
        return "{}"
    return f"{value:g}" if isinstance(value, float) and value != round(value, 6) else str(value)


def in_words(schema: dict[str, Any], defs: dict[str, Any]) -> tuple[str, str]:
    """Type and bounds of a JSON schema."""
    if "$ref" in schema:
        return in_words(defs[schema["$ref"].rsplit("/", 1)[-1]], defs)
    if "anyOf" in schema:
        parts = [in_words(part, defs) for part in schema["anyOf"] if part.get("type") != "null"]
        kinds = dict.fromkeys(kind for kind, _ in parts)
        return " or ".join(kinds), "; ".join(dict.fromkeys(text for _, text in parts if text))
    if "const" in schema:
        return f'`"{schema["const"]}"`', ""
    if "enum" in schema:
        return ", ".join(f'`"{value}"`' for value in schema["enum"]), ""
    kind = schema.get("type", "anything")
    if kind == "array":
        return _array(schema, defs)
    names = {"string": "text", "boolean": "true or false", "integer": "whole number"}
    return names.get(kind, "table" if kind == "object" else str(kind)), _bounds(schema)


def _array(schema: dict[str, Any], defs: dict[str, Any]) -> tuple[str, str]:
    items = schema.get("prefixItems")
    if items:
        parts = [in_words(item, defs) for item in items]
        kinds = dict.fromkeys(kind for kind, _ in parts)
        bounds = "; ".join(dict.fromkeys(text for _, text in parts if text))
        return f"{len(items)} × {' or '.join(kinds)}", bounds
    kind, bounds = in_words(schema.get("items", {}), defs)
    return f"list of {kind}", bounds


def _bounds(schema: dict[str, Any]) -> str:
    low, high = schema.get("minimum"), schema.get("maximum")
    above, below = schema.get("exclusiveMinimum"), schema.get("exclusiveMaximum")
    parts = []
    if above is not None:
        parts.append(f"> {above:g}")
    if low is not None:
        parts.append(f"≥ {low:g}")
    if below is not None:
        parts.append(f"< {below:g}")
    if high is not None:
        parts.append(f"≤ {high:g}")
    return ", ".join(parts)


def as_markdown(section: Section) -> str:
    """The section as a heading, a sentence and a table of its keys, for the reference."""
    texts = descriptions().get(section.label or "file", {})
    title = re.sub(r"^\[.*\]", r"`\g<0>`", section.title)
    lines = [f"## {title}", "", texts.get("_", ""), ""]
    table = list(rows(section))
    if table:
        lines += ["| key | type | bounds | unit | default | |", "|---|---|---|---|---|---|"]
        lines += [
            f"| `{key}` | {kind} | {bounds} | {unit_} | {value} | {text} |"
            for key, kind, bounds, unit_, value, text in table
        ]
    return "\n".join([*lines, ""])


_ROLE = re.compile(r"\{\w+\}`(?:[^`<]*<)?([^`>]*)>?`")  # of MyST, such as {doc}`drivers`


def as_text(section: Section) -> str:
    """The section as plain text: its title, and of each key what it may be and what it means.

    Parameters
    ----------
    section : Section
    """
    said = descriptions().get(section.label or "file", {}).get("_", "")
    lines = [section.title, *_filled(said, 2)]
    for key, kind, bounds, unit_, value, meaning in rows(section):
        stated = ", ".join(part for part in (kind, bounds, unit_) if part)
        given = value if value == "required" else f"default {'none' if value == '–' else value}"
        lines += [*_filled(f"{key}: {stated}; {given}", 2), *_filled(meaning, 6)]
    return "\n".join(lines)


def _filled(text: str, indent: int) -> list[str]:
    margin = " " * indent
    return wrap(_plain(text), 100, initial_indent=margin, subsequent_indent=margin)


def _plain(text: str) -> str:
    return _ROLE.sub(r"\1", text).replace("`", "")


# Schemas by which editors complete and check files.


SCHEMAS = "schemas"  # folder of them beside copied scenes


def kind_of(document: Mapping[str, Any]) -> str | None:
    """The kind of file that a document is, by the tables it has; None where no kind has them all.

    Parameters
    ----------
    document : mapping, as TOML is read
    """
    tables = document.keys() - _INCLUDES.keys()
    found = [kind for kind in kinds() if tables <= _tables_of(find_file(kind))]
    return max(found, key=lambda kind: len(find_file(kind).models), default=None)


def _tables_of(file: UserFile) -> set[str]:
    fields = [item for model in file.models for item in model.model_fields.items()]
    return {info.alias or name for name, info in fields}


def name_schemas(folder: Path) -> None:
    """Write the schemas beside copied files, and name in the first line of each file its own.

    Parameters
    ----------
    folder : Path, of TOML files, in it and beneath

    Raises
    ------
    InputError
        A file cannot be read or written.
    """
    make_folder(folder / SCHEMAS)
    for kind in kinds():
        text = json_text(json_schema(kind))
        write_atomically(folder / SCHEMAS / f"{kind}.json", f"{text}\n".encode())
    for file in sorted(folder.rglob("*.toml")):
        text = read_text(file)
        if kind_named := kind_of(tomllib.loads(text)):
            up = "../" * (len(file.relative_to(folder).parts) - 1) or "./"
            write_atomically(file, f"#:schema {up}{SCHEMAS}/{kind_named}.json\n{text}".encode())


_PART = "-part"  # behind the name of a table in a file that includes others
_TEXTS = {"type": "string", "minLength": 1}
_OPEN = {"additionalProperties": True}  # of what says a part of a table: tombi warns without
_INCLUDES = {
    "include": "file, or list of files, or names of scenes, that this one starts from",
    "exclude": "table or key, dotted, or list of such, that is taken out of what is included",
}


def json_schema(kind: str) -> dict[str, Any]:
    """The JSON schema of a kind of file, as TOML is read.

    In a file that includes others, or may be there to be included, any key may be missing, and a
    table may leave open of which kind it is.  What depends on several keys, and whether a file that
    is named is there, no schema says.

    Parameters
    ----------
    kind : str, one of ``kinds``

    Raises
    ------
    InputError
        There is none of that name.

    References
    ----------
    JSON Schema, draft 2020-12.

    Examples
    --------
    >>> json_schema("rig")["properties"]["plan"]["description"]
    'The scan. With a `[shaft]`, positions are arcs.'
    """
    file = find_file(kind)
    tables: dict[str, Any] = {}
    whole: dict[str, Any] = {"properties": {}, "required": []}
    for model in file.models:
        schema = model.model_json_schema()
        tables |= schema.pop("$defs", {})
        whole["properties"] |= schema["properties"]
        whole["required"] += schema.get("required", [])
    for table, drivers in file.options.items():
        owner = tables[whole["properties"][table]["$ref"].rsplit("/", 1)[-1]]
        owner["allOf"] = [_if_driver(name, model, tables) for name, model in drivers.items()]
    for section in file.sections:
        _describe(section, whole if not section.name else tables.get(section.model.__name__, {}))
    if "Board" in tables:  # of a rig; a board's own file is of the model itself
        tables["Board"]["properties"]["file"] = _TEXTS | {"description": "file of the board"}
        tables["Board"]["if"] = {"not": {"required": ["file"]}, **_OPEN}
        tables["Board"]["then"] = {"required": tables["Board"].pop("required", []), **_OPEN}
    part = _without_required({"properties": whole["properties"]})
    lists = {"anyOf": [_TEXTS, {"type": "array", "items": _TEXTS}]}
    part["properties"] |= {
        key: lists | {"description": meaning} for key, meaning in _INCLUDES.items()
    }
    # A file to be included has only some of the tables, and these may have only some of the keys.
    is_whole: dict[str, Any] = {"not": {"required": ["include"]}, **_OPEN}
    needed = {"required": whole["required"]}
    if file.is_part:
        is_whole, needed = {**is_whole, **needed}, {}
    return _tidied(
        {
            "$schema": "https://json-schema.org/draft/2020-12/schema",
            "title": f"lscan: {file.about}",
            "type": "object",
            **part,
            "additionalProperties": False,
            "if": is_whole,
            "then": {"properties": whole["properties"], **needed, **_OPEN},
            "$defs": tables
            | {f"{name}{_PART}": _without_required(table) for name, table in tables.items()},
        }
    )


def _if_driver(name: str, model: type[BaseModel], tables: dict[str, Any]) -> dict[str, Any]:
    """That the options are those of a driver where it is named; its tables are added."""
    schema = model.model_json_schema()
    tables |= schema.pop("$defs", {})
    tables[model.__name__] = schema
    named = {"properties": {"driver": {"const": name}}, "required": ["driver"]}
    options = {"$ref": f"#/$defs/{model.__name__}"}
    return {"if": named | _OPEN, "then": {"properties": {"options": options}, **_OPEN}}


def _describe(section: Section, schema: dict[str, Any]) -> None:
    """Write into the schema of a table what each of its keys means, for editors, in Markdown."""
    texts = descriptions().get(section.label or "file", {})
    for name, info in section.model.model_fields.items():
        inner = Section(f"{section.name}.{name}".lstrip("."), section.model).label
        meaning = info.description or texts.get(name) or descriptions().get(inner, {}).get("_")
        if meaning and (info.alias or name) in schema.get("properties", {}):
            schema["properties"][info.alias or name]["description"] = _ROLE.sub(r"\1", meaning)


def _without_required(schema: Any) -> Any:
    """A schema in which any key may be missing, of tables that are so as well."""
    if isinstance(schema, list):
        return [_without_required(item) for item in schema]
    if not isinstance(schema, dict):
        return schema
    found = {}
    for key, value in schema.items():
        if key == "$ref":
            found[key] = f"{value}{_PART}"
        elif key == "if":  # asks for the driver's name
            found[key] = deepcopy(value)
        elif key == "oneOf":  # without its kind a table may be of several
            found["anyOf"] = _without_required(value)
        elif key != "required" or not isinstance(value, list):
            found[key] = _without_required(value)
    return found


def _tidied(schema: Any) -> Any:
    """Without what only pydantic reads, and the titles and null that TOML has no use for."""
    if isinstance(schema, list):
        return [_tidied(item) for item in schema]
    if not isinstance(schema, dict):
        return schema
    found = {}
    for key, value in schema.items():
        if key == "discriminator" or value is None:
            continue
        if key == "title" and isinstance(value, str) and not value.startswith("lscan: "):
            continue
        if key in ("anyOf", "oneOf") and isinstance(value, list):
            value = [item for item in value if item != {"type": "null"}]
        found[key] = _tidied(value)
    return found
