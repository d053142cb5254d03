"""Every field of a rig file set wrong, one at a time: refused by its key, and no device touched.

The fields and what they may hold are read from the models that check them, the wrong values
follow from that (sim.hardware.wrongvalues), and each wrong rig is read from a real file.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from copy import deepcopy
from dataclasses import dataclass
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin
from unittest.mock import patch

from lscan.allowed import Keys, fields, kinds
from lscan.documents import Document
from lscan.errors import InputError
from lscan.plugins import installed
from lscan.rig import load_rig
from sim.hardware.crossrules import CROSSINGS
from sim.hardware.goodrigs import GoodRig, as_toml, good_rigs, write_beside
from sim.hardware.wrongvalues import words_wanted, wrong_values
from sim.verify.rows import Row

NAMED = {
    ("camera", "driver"): "lscan.cameras",
    ("track", "driver"): "lscan.tracks",
    ("stripe", "extractor"): "lscan.extractors",
    ("calibration", "plane_map"): "lscan.planemaps",
}
"""Free texts that must be names: of plug-ins of these groups."""

NOT_OURS = re.compile(r"(?i)input should|validation error|traceback|constrained|nonetype|pydantic")
"""Words that no message may hold: they speak of the program, not of the file."""

MOST_SHOWN = 60
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


@dataclass(frozen=True)
class Verdict:
    """What became of a wrong rig.  fault: why its refusal falls short, "" where it does not."""

    wrong: WrongField
    fault: str


# ---- enumeration ------------------------------------------------------------------------


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
        yield WrongField(f"{rig.name}: no {_dotted(place.keys)}", document, place.keys, None, words)


def _changed(rig: GoodRig, keys: Keys, value: Any, words: tuple[str, ...]) -> WrongField:
    document = deepcopy(rig.document)
    _at(document, keys[:-1])[keys[-1]] = value
    what = f"{rig.name}: {_dotted(keys)} = {str(value)[:MOST_SHOWN]}"
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


def _dotted(keys: Keys) -> str:
    return ".".join(map(str, keys))


# ---- judgement --------------------------------------------------------------------------


def shortcoming(wrong: WrongField, file: Path, read: Callable[[Path], object] = load_rig) -> str:
    """Why the refusal of a wrong rig, written to ``file``, falls short; "" where it does not.

    read: what reads a rig file.
    """
    file.write_text(as_toml(wrong.document), encoding="utf-8")
    try:
        read(file)
    except InputError as error:
        return _lacking(str(error), wrong, file)
    except Exception as error:
        return f"raises {type(error).__name__}: {error}"
    return "is accepted"


def _lacking(message: str, wrong: WrongField, file: Path) -> str:
    """What a message does not say of a wrong field, with the message; "" where it says all."""
    shown = [] if wrong.change is None else [repr(wrong.change)[:MOST_SHOWN]]
    wanted = [str(file), _dotted(wrong.keys), *shown, *wrong.words]
    lacking = [text for text in wanted if text not in message]
    if "\n" in message:
        lacking.append("one line")
    if NOT_OURS.search(message):
        lacking.append("words of the file alone")
    return f"lacks {lacking}: {message}" if lacking else ""


@contextmanager
def devices_guarded() -> Iterator[list[str]]:
    """The devices opened while this lasts, of all drivers installed; none is really opened."""
    touched: list[str] = []

    def opening(name: str) -> Callable[..., None]:
        def opened(*_: object, **__: object) -> None:
            touched.append(name)
            raise AssertionError(f"{name} was opened")

        return opened

    targets = ["cv2.VideoCapture", "serial.Serial", "sim.devices.SimCamera", "sim.devices.SimTrack"]
    with ExitStack() as stack:
        for group in ("lscan.cameras", "lscan.tracks"):
            for name, entry in installed(group).items():
                kind = type(entry.load())
                stack.enter_context(patch.object(kind, "open", opening(f"{group} {name}")))
        for target in targets:
            stack.enter_context(patch(target, opening(target)))
        yield touched


def try_all() -> tuple[list[Verdict], list[str]]:
    """What became of every wrong rig, and the devices that were touched.

    Raises AssertionError where a rig that ought to be right is refused.
    """
    rigs = good_rigs()
    with tempfile.TemporaryDirectory() as name, devices_guarded() as touched:
        folder = Path(name)
        write_beside(folder)
        for rig in rigs:
            _assert_good(rig, folder / "good.toml")
        wrongs = [wrong for rig in rigs for wrong in wrong_fields(rig)]
        wrongs += crossed_rigs(rigs)
        file = folder / "my-rig.toml"
        return [Verdict(wrong, shortcoming(wrong, file)) for wrong in wrongs], touched


def _assert_good(rig: GoodRig, file: Path) -> None:
    file.write_text(as_toml(rig.document), encoding="utf-8")
    try:
        load_rig(file)
    except InputError as error:
        raise AssertionError(f"the rig {rig.name} ought to be right: {error}") from error


def field_rows() -> list[Row]:
    """The figures for a rig file with any one field wrong: how many, refused how, touching what."""
    verdicts, touched = try_all()
    bad = [verdict for verdict in verdicts if verdict.fault]
    files = "real TOML files, every field of the models and every pair of drivers"
    return [
        Row(
            what="rig files with one field wrong tried",
            reference=files,
            figure=len(verdicts),
            bar=500,
            unit="files",
            tolerance_from="some hundreds: each field is wrong in several ways",
            at_least=True,
        ),
        Row(
            what="of those not refused by file, key, value and what is allowed",
            reference=files,
            figure=len(bad),
            bar=0,
            unit="files",
            tolerance_from="issue: a message with the key and what is allowed",
        ),
        Row(
            what="devices touched by a rig file with a field wrong",
            reference="every driver's opening function, guarded",
            figure=len(touched),
            bar=0,
            unit="devices",
            tolerance_from="issue: none reaches a device",
        ),
    ]
