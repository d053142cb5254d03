"""Rig files that are right, and the same with one thing wrong.

They name files beside them, which :func:`write_beside` makes: a recorded run, a video, a mesh
and a picture.
"""

import math
import operator
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy, deepcopy
from dataclasses import dataclass
from datetime import date
from functools import reduce
from itertools import product
from operator import getitem
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from lscan.acquisition.replay import ReplayOptions
from lscan.acquisition.writer import create_run
from lscan.config.documents import Document, Strict, merge
from lscan.config.plugins import installed
from lscan.config.rig import Rig, parse_rig
from lscan.devices.genicam import GenicamOptions
from lscan.devices.grbl import SerialTrackOptions
from lscan.devices.klipper import KlipperOptions
from lscan.devices.manual import ManualOptions
from lscan.devices.opencv_camera import OpencvOptions
from lscan.files.disk import packaged_table
from lscan.records import Frame
from sim.devices import CameraOptions, TrackOptions
from sim.scene.file import TankSections

# Rig files that are right: every field stated in one of them, every pair of drivers in one.

SIZE_PX = (16, 16)
CAMERAS: dict[str, type[Strict]] = {
    "genicam": GenicamOptions,
    "opencv": OpencvOptions,
    "replay": ReplayOptions,
    "sim": CameraOptions,
}
TRACKS: dict[str, type[Strict]] = {
    "grbl": SerialTrackOptions,
    "klipper": KlipperOptions,
    "manual": ManualOptions,
    "replay": ReplayOptions,
    "sim": TrackOptions,
}
_TABLE: Document = packaged_table("tests.validation.robustness", "goodrigs.toml")


@dataclass(frozen=True)
class RigPart:
    """A table of a rig file that one model checks.

    prefix: the keys that lead to the table; () is the whole file.  sections: those of the
    model's fields that are set wrong in this rig, () for all.
    """

    model: type[Strict]
    prefix: tuple[str, ...]
    sections: tuple[str, ...] = ()


@dataclass(frozen=True)
class GoodRig:
    """A rig file that is right, and the parts of it that are to be set wrong.

    Attributes
    ----------
    name : str, for messages
    document : Document, the rig file's tables
    parts : tuple, each a table of the document, and the model that checks it
    """

    name: str
    document: Document
    parts: tuple[RigPart, ...]

    @property
    def drivers(self) -> tuple[str, str]:
        """The names of its camera's and its track's driver."""
        return self.document["camera"]["driver"], self.document["track"]["driver"]


def good_rigs() -> list[GoodRig]:
    """Rigs that together hold every field, and every pair of drivers.

    Each field is to be set wrong in one of them only, and each rig holds little besides: some
    thousands of files are read.
    """
    rigs = [_rig(**rig) for rig in _TABLE["rig"]]
    pairs = {rig.drivers for rig in rigs}
    for camera, track in product(CAMERAS, TRACKS):
        if (camera, track) not in pairs:
            rigs.append(_rig(camera, track, ["tank"] if camera == "sim" else []))
    return rigs


def write_beside(folder: Path) -> None:
    """Make the files that the good rigs name: a video, a mesh, a picture and a run.

    Parameters
    ----------
    folder : Path, of the rig file
    """
    for name in ("video.avi", "mesh.ply", "picture.png"):
        (folder / name).touch()
    width_px, height_px = SIZE_PX
    camera = {"driver": "gone", "width_px": width_px, "height_px": height_px}
    document = {"camera": camera, "track": {"driver": "gone"}, "plan": _TABLE["plan"]}
    rig_file = parse_rig(document, source="rig.toml", trusted=True)
    with create_run(folder / "run", rig_file) as writer:
        for index, position_mm in enumerate(rig_file.rig.plan.positions_mm()):
            image = np.full((height_px, width_px), 10, dtype=np.uint8)
            writer.append(Frame(image, index, position_mm, position_mm, 0.1 * index, 20.0))


def _rig(
    camera: str,
    track: str,
    sections: Sequence[str] = (),
    source: Document | None = None,
    laser: str = "untouched",
    wrong: Mapping[str, Sequence[str]] | None = None,
) -> GoodRig:
    """The rig of two drivers with its defaults written out, as goodrigs.toml describes it."""
    laid = reduce(merge, (_TABLE["sections"][name] for name in sections), Document())
    options = source  # of a stream or a file, what only a device has may not even be stated
    if options is None:
        options = _written_out(CAMERAS[camera], _TABLE["camera_options"][camera])
    width_px, height_px = SIZE_PX
    size = {"width_px": width_px, "height_px": height_px}
    track_options = _written_out(TRACKS[track], _TABLE["track_options"][track])
    rig = {
        "camera": {"driver": camera, **size, "options": options},
        "track": {"driver": track, "options": track_options},
        "plan": {**_TABLE["plan"], "laser": laser},
        **{key: value for key, value in laid.items() if key in Rig.model_fields},
    }
    tank = {key: value for key, value in laid.items() if key in TankSections.model_fields}
    written = _written_out(Rig, rig)
    document = {name: written[name] for name in ("name", *rig)}
    if tank:
        document |= _written_out(TankSections, tank)
    places: dict[str, tuple[type[Strict], tuple[str, ...]]] = {
        "file": (Rig, ()),
        "tank": (TankSections, ()),
        "camera": (CAMERAS[camera], ("camera", "options")),
        "track": (TRACKS[track], ("track", "options")),
    }
    parts = (RigPart(*places[name], tuple(fields)) for name, fields in (wrong or {}).items())
    return GoodRig(f"{camera} and {track}", document, tuple(parts))


def _written_out(model: type[Strict], document: Document) -> Document:
    """The document with every default that is not None stated."""
    return model.model_validate(document).model_dump(mode="json", exclude_none=True)


# Values that a field of a file must refuse, and what the refusal must say.
#
# Both follow from the JSON schema that pydantic makes of a model, not from the code under test,
# which reads the same models in a way of its own (lscan.config.documents).


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


# Rules of a rig file over several of its fields, and how each is broken: crossings.toml.


@dataclass(frozen=True)
class CrossRule:
    """A rule and how to break it.

    rule: the model's validator as ``Model.name``, or a sentence where a driver checks it.
    rig: what a rig must contain for the rule to apply.  changes: dotted keys and their new
    values.  key: what the message must name; words: what else it must say.
    """

    rule: str
    rig: Document
    changes: Document
    key: str
    words: tuple[str, ...]

    def fits(self, document: Document) -> bool:
        """Whether a rig contains what the rule applies to."""
        return merge(document, self.rig) == document


CROSSINGS = tuple(
    CrossRule(rule["rule"], rig, rule["changes"], rule["key"], tuple(rule["words"]))
    for rule in packaged_table("tests.validation.robustness", "crossings.toml")["crossing"]
    for rig in rule["rigs"]
)


# Rig files with one thing wrong: every field of the good ones, in every way of its type.
#
# The fields and what they may hold are read from the models' JSON schemas; the wrong values follow
# from those (tests.validation.robustness.rigfiles).


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
