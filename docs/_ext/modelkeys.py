"""Every key of every file a user writes, read from the pydantic models.

A *section* is a table of a file: its dotted name and the model that checks it.  Type, unit,
bounds and default come from the model; what a key means comes from its ``Field(description=...)``
or from ``keys.toml``.
"""

import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

from pydantic import BaseModel
from pydantic.fields import FieldInfo

DESCRIPTIONS = tomllib.loads((Path(__file__).parent / "keys.toml").read_text(encoding="utf-8"))

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
        return f"{self.name}:{self.variant}" if self.variant else self.name


def sections(model: type[BaseModel], prefix: str = "", variant: str = "") -> Iterator[Section]:
    """The model's own section, then those of the models it holds, depth first."""
    yield Section(prefix, model, variant)
    yield from _inner(model, prefix)


def _inner(model: type[BaseModel], prefix: str) -> Iterator[Section]:
    for key, info in model.model_fields.items():
        name = f"{prefix}.{key}" if prefix else key
        models = _models_in(info.annotation)
        repeated = not _is_single(info)
        for inner in models:
            variant = _kind(inner) if len(models) > 1 else ""
            yield Section(name, inner, variant, repeated)
            yield from _inner(inner, name)


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    found: list[type[BaseModel]] = []
    for part in get_args(annotation):
        found += [model for model in _models_in(part) if model not in found]
    return found


def _is_single(info: FieldInfo) -> bool:
    return not str(info.annotation).startswith(("tuple", "list"))


def _kind(model: type[BaseModel]) -> str:
    return str(get_args(model.model_fields["kind"].annotation)[0])


def described_elsewhere(section: Section, key: str) -> bool:
    """Whether the key is a table that has a section of its own."""
    return bool(_models_in(section.model.model_fields[key].annotation))


def description(section: Section, key: str) -> str:
    """What the key means; KeyError where nobody says so."""
    info = section.model.model_fields[key]
    return info.description or str(DESCRIPTIONS[section.label or "file"][key])


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


def as_markdown(section: Section, title: str, level: int = 3) -> str:
    """The section as a heading, a sentence and a table of its keys."""
    texts = DESCRIPTIONS.get(section.label or "file", {})
    lines = [f"{'#' * level} {title}", "", str(texts.get("_", "")), ""]
    table = list(rows(section))
    if table:
        lines += ["| key | type | bounds | unit | default | |", "|---|---|---|---|---|---|"]
        lines += [
            f"| `{key}` | {kind} | {bounds} | {unit_} | {value} | {text} |"
            for key, kind, bounds, unit_, value, text in table
        ]
    return "\n".join([*lines, ""])
