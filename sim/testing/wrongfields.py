"""Rig files with one thing wrong: every field of the good ones, in every way its type tells.

The fields and what they may hold are read from the models that check them; the wrong values
follow from that (sim.testing.wrongvalues).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass
from functools import reduce
from operator import getitem
from typing import Annotated, Any, get_args, get_origin

from lscan.config.allowed import Keys, fields, kinds
from lscan.config.documents import Document
from lscan.config.plugins import installed
from sim.testing.crossrules import CROSSINGS
from sim.testing.goodrigs import GoodRig
from sim.testing.wrongvalues import words_wanted, wrong_values

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

    keys: what the message must name.  change: the value set, None where a key was taken away.
    words: what else the message must hold, of what is allowed.
    """

    what: str
    document: Document
    keys: Keys
    change: Any
    words: tuple[str, ...]


@dataclass(frozen=True)
class Place:
    """Where a rig file holds a field: its keys, what it may hold, what it holds.

    owner: the model and the name of the field, None for an item of a list.
    required: whether the file must state it.
    """

    keys: Keys
    annotation: Any
    value: Any
    owner: tuple[Any, str] | None = None
    required: bool = False


def places(rig: GoodRig) -> Iterator[Place]:
    """Every field of the parts of a rig that are to be set wrong, tables before what they hold."""
    for part in rig.parts:
        table = _at(rig.document, part.prefix)
        yield from _members(part.prefix, part.model, table, part.sections)


def _members(keys: Keys, annotation: Any, table: Document, names: Sequence[str]) -> Iterator[Place]:
    """The fields of these names, and all within them, of a table that is of one model."""
    [model] = [k.type for k in kinds(annotation) if k.is_table and _is_of(k.type, table)]
    for name in names or fields(model):
        yield from _within(
            Place(
                keys=(*keys, name),
                annotation=fields(model)[name],
                value=table.get(name),
                owner=(model, name),
                required=_is_required(name, model, annotation),
            )
        )


def _within(place: Place) -> Iterator[Place]:
    """The place and all within it, tables before what they hold."""
    yield place
    keys, annotation, value = place.keys, place.annotation, place.value
    if isinstance(value, dict) and any(kind.is_table for kind in kinds(annotation)):
        yield from _members(keys, annotation, value, ())
    for kind in kinds(annotation) if isinstance(value, list) else ():
        if get_origin(kind.type) in (tuple, list):
            for index, item in enumerate(value):
                yield from _within(Place((*keys, index), kind.item(index), item))


def _is_required(name: str, model: Any, annotation: Any) -> bool:
    """Whether a table of ``annotation``, now of ``model``, must have the key ``name``."""
    told_by = list(_discriminators(annotation)) if name == "kind" else []
    if told_by:  # a function tells the kind of a table without the key, too
        return all(isinstance(by, str) for by in told_by)
    return bool(model.model_fields[name].is_required())


def _discriminators(annotation: Any) -> Iterator[Any]:
    """The keys or functions by which pydantic tells apart the models a table may be of."""
    if get_origin(annotation) is Annotated:
        for note in annotation.__metadata__:
            if getattr(note, "discriminator", None) is not None:
                yield note.discriminator
    for part in get_args(annotation):
        yield from _discriminators(part)


def _is_of(model: Any, table: Document) -> bool:
    """Whether a table is one of this model, where its ``kind`` tells."""
    tag = kinds(fields(model)["kind"])[0] if "kind" in fields(model) else None
    return tag is None or table.get("kind") in tag.type.__args__


def wrong_fields(rig: GoodRig) -> Iterator[WrongField]:
    """The rig with each of its fields wrong in every way, one at a time."""
    for place in places(rig):
        yield from _wrong_values(rig, place)
        if place.owner is not None:
            yield from _wrong_keys(rig, place)


def _wrong_values(rig: GoodRig, place: Place) -> Iterator[WrongField]:
    words = tuple(words_wanted(place.annotation))
    for value in wrong_values(place.annotation, place.value):
        yield _changed(rig, place.keys, value, words)
    if place.keys in NAMED:
        names = tuple(installed(NAMED[place.keys]))
        yield _changed(rig, place.keys, "no such name", names)


def _wrong_keys(rig: GoodRig, place: Place) -> Iterator[WrongField]:
    """The field misspelt beside itself, and left out where it is needed."""
    *table, name = place.keys
    yield _changed(rig, (*table, f"{name}_"), 1, (str(name),))
    if place.required:
        document = deepcopy(rig.document)
        del _at(document, tuple(table))[name]
        words = ("field required", *words_wanted(place.annotation))
        yield WrongField(f"{rig.name}: no {dotted(place.keys)}", document, place.keys, None, words)


def _changed(rig: GoodRig, keys: Keys, value: Any, words: tuple[str, ...]) -> WrongField:
    document = deepcopy(rig.document)
    _at(document, keys[:-1])[keys[-1]] = value
    what = f"{rig.name}: {dotted(keys)} = {str(value)[:MOST_SHOWN]}"
    return WrongField(what, document, keys, value, words)


def crossed_rigs(rigs: list[GoodRig]) -> Iterator[WrongField]:
    """The rigs that break a rule over several fields."""
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
    """The keys as a message names them: "camera.options.flush_frames"."""
    return ".".join(map(str, keys))
