"""Values that a field of a file must refuse, and what the refusal must say.

Both follow from the JSON schema that pydantic makes of a model, not from the code under test,
which reads the same models in a way of its own (lscan.config.documents).
"""

import math
import operator
import re
from collections.abc import Callable, Iterator
from datetime import date
from typing import Any

from pydantic import TypeAdapter

Schema = dict[str, Any]

A_DAY = date(1979, 5, 27)
TOO_LARGE = 10**400
"""A whole number beyond what a float holds, 1.8e308."""
LIMITS: dict[str, Callable[[Any, Any], bool]] = {
    "minimum": operator.ge,
    "exclusiveMinimum": operator.gt,
    "maximum": operator.le,
    "exclusiveMaximum": operator.lt,
}
"""Of a number: the keyword of the schema, and what must hold of value and limit."""


def schema_of(model: Any) -> Schema:
    """The JSON schema of a model or an annotation, each reference replaced by its definition."""
    whole = TypeAdapter(model).json_schema()
    definitions = whole.pop("$defs", {})

    def inlined(node: Any) -> Any:
        if isinstance(node, list):
            return [inlined(item) for item in node]
        if not isinstance(node, dict):
            return node
        if "$ref" in node:
            return inlined(definitions[node["$ref"].rpartition("/")[2]])
        return {key: inlined(item) for key, item in node.items()}

    schema: Schema = inlined(whole)
    return schema


def alternatives(schema: Schema, description: str = "") -> list[Schema]:
    """The schemas of one type each that a value may follow; null is left out."""
    description = schema.get("description", description)
    parts = schema.get("anyOf") or schema.get("oneOf")
    if parts:
        return [one for part in parts for one in alternatives(part, description)]
    return [] if schema.get("type") == "null" else [{**schema, "description": description}]


def choices(schema: Schema) -> list[Any]:
    """The values of an enumeration, [] of any other schema."""
    return [schema["const"]] if "const" in schema else schema.get("enum", [])


def wrong_values(schema: Schema, value: Any) -> Iterator[Any]:
    """Values that the schema does not allow, of every type TOML has.

    value: the present one, from which lists of a wrong length are made.  What any alternative
    allows is never among them: a whole number for a number, any text for a free text, any list
    for a list of any length.
    """
    allowed = alternatives(schema)
    types = {one["type"] for one in allowed}
    is_number = bool(types & {"integer", "number"})
    yield A_DAY
    if not any(one["type"] == "string" and not choices(one) for one in allowed):
        yield from ("wrong", "12", "")
    if not is_number:
        yield from (12345.678, 1, 0)
    if "boolean" not in types:
        yield from (True, False)
    if "array" not in types:
        yield from ([], ["wrong"], [1.5])
    if "object" not in types:
        yield {"wrong": 1}
    if is_number:
        yield from (math.nan, math.inf, -math.inf, TOO_LARGE, -TOO_LARGE)
    if is_number and "number" not in types:
        yield from (1.5, 20.0)
    for one in allowed:
        yield from (v for v in _outside(one) if not any(_holds(other, v) for other in allowed))
        if one["type"] == "array" and isinstance(value, list):
            yield from _of_wrong_length(one, value)


def _of_wrong_length(schema: Schema, value: list[Any]) -> Iterator[list[Any]]:
    """Lists of the items of ``value``, each an item too short or too long, and an empty one."""
    least, most = schema.get("minItems", 0), schema.get("maxItems", math.inf)
    if least > 0:
        yield from ([], value[: least - 1])
    if most < math.inf and value:
        yield [*value, *value[-1:] * (most + 1 - len(value))]


def _outside(schema: Schema) -> Iterator[Any]:
    """The nearest values beyond each limit, the limit itself where it is excluded."""
    whole = schema["type"] == "integer"
    for name, way in (("minimum", -1), ("maximum", 1)):
        if name in schema:
            edge = schema[name]
            yield edge + way if whole else math.nextafter(edge, way * math.inf)
    yield from (schema[name] for name in ("exclusiveMinimum", "exclusiveMaximum") if name in schema)
    if schema.get("minLength"):
        yield ""
    if "pattern" in schema:
        yield from (text for text in ("", "?", "wrong") if not re.search(schema["pattern"], text))


def _holds(schema: Schema, value: Any) -> bool:
    """Whether the type and the limits of a schema allow a number or a text."""
    if isinstance(value, str):
        fits = re.search(schema.get("pattern", ""), value) is not None
        is_text = schema["type"] == "string" and not choices(schema)
        return is_text and fits and len(value) >= schema.get("minLength", 0)
    if schema["type"] not in ("integer", "number"):
        return False
    return all(holds(value, schema[name]) for name, holds in LIMITS.items() if name in schema)


def words_wanted(schema: Schema) -> list[str]:
    """What a message must say of what is allowed: every limit, choice and key."""
    return [word for one in alternatives(schema) for word in _words_of(one)]


def _words_of(schema: Schema) -> list[str]:
    if choices(schema):
        return [repr(value) for value in choices(schema)]
    words = [_plain(schema[name]) for name in LIMITS if name in schema]
    match schema["type"]:
        case "integer":
            return [*words, "whole number"]
        case "number":
            return [*words, "number"]
        case "boolean":
            return ["true or false"]
        case "string":
            return [schema["description"] or "text"]
        case "array":
            lengths = [str(schema[name]) for name in ("minItems", "maxItems") if name in schema]
            return ["list of" if lengths else "list", *lengths]
    keys = list(schema.get("properties", ()))
    return ["kind"] if "kind" in keys else keys


def _plain(limit: float) -> str:
    """A limit as a person types it: 0 and 1000000, not 0.0 and 1e6."""
    return repr(int(limit) if limit == int(limit) else limit)
