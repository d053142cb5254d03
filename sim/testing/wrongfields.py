"""Rig files with one thing wrong: every field of the good ones, in every way of its type.

The fields and what they may hold are read from the models' JSON schemas; the wrong values
follow from those (sim.testing.wrongvalues).
"""

from collections.abc import Iterator, Sequence
from copy import copy, deepcopy
from dataclasses import dataclass
from functools import reduce
from operator import getitem
from typing import Any

from lscan.config.documents import Document
from lscan.config.plugins import installed
from sim.testing.crossing import CROSSINGS
from sim.testing.goodrigs import GoodRig
from sim.testing.wrongvalues import (
    Schema,
    alternatives,
    choices,
    schema_of,
    words_wanted,
    wrong_values,
)

Keys = tuple[str | int, ...]

NAMED = {
    ("camera", "driver"): "lscan.cameras",
    ("track", "driver"): "lscan.tracks",
    ("stripe", "extractor"): "lscan.extractors",
    ("calibration", "plane_map"): "lscan.planemaps",
}
"""Free texts that must be names: of plug-ins of these groups."""

MOST_SHOWN = 30
"""Characters of a value that a message must show; a long one may be cut."""


@dataclass(frozen=True)
class WrongField:
    """A rig file with one thing wrong.

    Attributes
    ----------
    what : str, what was done to it
    document : Document, the rig file's tables
    keys : Keys, what the message must name
    change : the value set, None where a key was taken away
    words : tuple, what else the message must hold, of what is allowed
    """

    what: str
    document: Document
    keys: Keys
    change: Any
    words: tuple[str, ...]


@dataclass(frozen=True)
class FieldPlace:
    """Where a rig file holds a field: its keys, the schema of its values, its present value.

    owner: the names of the model and of the field, None for an item of a list.
    required: whether the file must state it.
    """

    keys: Keys
    schema: Schema
    value: Any
    owner: tuple[str, str] | None = None
    required: bool = False


def places(rig: GoodRig) -> Iterator[FieldPlace]:
    """Every field of the parts of a rig that are to be set wrong, tables before what they hold."""
    for part in rig.parts:
        table = _at(rig.document, part.prefix)
        yield from _members(part.prefix, schema_of(part.model), table, part.sections)


def _members(
    keys: Keys, schema: Schema, table: Document, names: Sequence[str]
) -> Iterator[FieldPlace]:
    """The fields of these names, and all within them, of a table that is of one model."""
    [model] = [one for one in alternatives(schema) if _is_of(one, table)]
    for name in names or model["properties"]:
        field = model["properties"][name]
        owner, required = (model["title"], name), _is_required(name, model, schema)
        yield from _within(FieldPlace((*keys, name), field, table.get(name), owner, required))


def _within(place: FieldPlace) -> Iterator[FieldPlace]:
    """The place and all within it, tables before what they hold."""
    yield place
    keys, value = place.keys, place.value
    for one in alternatives(place.schema):
        if isinstance(value, list) and one["type"] == "array":
            fixed = one.get("prefixItems") or [one["items"]] * len(value)
            for index, (schema, item) in enumerate(zip(fixed, value, strict=True)):
                yield from _within(FieldPlace((*keys, index), schema, item))
        elif isinstance(value, dict) and "properties" in one and _is_of(one, value):
            yield from _members(keys, place.schema, value, ())


def _is_required(name: str, model: Schema, schema: Schema) -> bool:
    """Whether a table of ``schema``, now of ``model``, must have the key ``name``."""
    unions = [part for part in (schema, *schema.get("anyOf", ())) if "oneOf" in part]
    if name == "kind" and unions:  # a function selects the model without the key, too
        return all("discriminator" in union for union in unions)
    return name in model.get("required", ())


def _is_of(model: Schema, table: Document) -> bool:
    """Whether a table is one of this model, where its ``kind`` says so."""
    properties = model.get("properties", {})
    return "kind" not in properties or table.get("kind") in choices(properties["kind"])


def wrong_fields(rig: GoodRig) -> Iterator[WrongField]:
    """The rig with each of its fields wrong in every way, one at a time.

    Parameters
    ----------
    rig : GoodRig, a rig that is right
    """
    for place in places(rig):
        yield from _wrong_values(rig, place)
        if place.owner is not None:
            yield from _wrong_keys(rig, place)


def _wrong_values(rig: GoodRig, place: FieldPlace) -> Iterator[WrongField]:
    words = tuple(words_wanted(place.schema))
    for value in wrong_values(place.schema, place.value):
        yield _changed(rig, place.keys, value, words)
    if place.keys in NAMED:
        names = installed(NAMED[place.keys])
        yield _changed(rig, place.keys, "no such name", names)


def _wrong_keys(rig: GoodRig, place: FieldPlace) -> Iterator[WrongField]:
    """The field misspelt beside itself, and left out where it is needed."""
    *table, name = place.keys
    yield _changed(rig, (*table, f"{name}_"), 1, (str(name),))
    if place.required:
        document = _copied(rig.document, tuple(table))
        del _at(document, tuple(table))[name]
        words = ("field required", *words_wanted(place.schema))
        yield WrongField(f"{rig.name}: no {dotted(place.keys)}", document, place.keys, None, words)


def _changed(rig: GoodRig, keys: Keys, value: Any, words: tuple[str, ...]) -> WrongField:
    document = _copied(rig.document, keys[:-1])
    _at(document, keys[:-1])[keys[-1]] = value
    what = f"{rig.name}: {dotted(keys)} = {str(value)[:MOST_SHOWN]}"
    return WrongField(what, document, keys, value, words)


def _copied(document: Any, keys: Keys) -> Any:
    """The document with copies of the table that the keys lead to and of those around it."""
    result = copy(document)
    if keys:
        result[keys[0]] = _copied(document[keys[0]], keys[1:])
    return result


def crossed_rigs(rigs: list[GoodRig]) -> Iterator[WrongField]:
    """The rigs that break a rule over several fields.

    Parameters
    ----------
    rigs : list, all that are right; each rule takes the first that it fits
    """
    for crossing in CROSSINGS:
        rig = next(rig for rig in rigs if crossing.fits(rig.document))
        document = deepcopy(rig.document)
        for dotted, value in crossing.changes.items():
            *table, last = (int(key) if key.isdigit() else key for key in dotted.split("."))
            _at(document, tuple(table))[last] = value
        keys = tuple(crossing.key.split("."))
        yield WrongField(f"{rig.name}: {crossing.rule}", document, keys, None, crossing.words)


def _at(document: Any, keys: Keys) -> Any:
    return reduce(getitem, keys, document)


def dotted(keys: Keys) -> str:
    """The keys as a message names them: "camera.options.flush_frames".

    Parameters
    ----------
    keys : Keys, path through a document: names of keys, indices of entries

    Examples
    --------
    >>> dotted(("plan", "frames"))
    'plan.frames'
    """
    return ".".join(map(str, keys))
