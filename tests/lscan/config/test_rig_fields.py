"""A rig file with any one field wrong is refused by its key, and reaches no device."""

import inspect
from collections import Counter
from collections.abc import Callable, Iterator
from copy import deepcopy
from importlib.metadata import entry_points
from itertools import chain, product
from pathlib import Path
from typing import Annotated, Any, Literal, get_args
from unittest.mock import patch

import cv2
import pytest
from pydantic import BaseModel, Discriminator, Field, Tag, create_model

from lscan.config import documents
from lscan.config.documents import Strict, in_words, toml_text
from lscan.config.rig import Rig, load_rig
from lscan.errors import InputError
from sim.scene.file import TankSections
from tests.validation.robustness.campaign import (
    devices_guarded,
    fault_of_refusal,
    shortcoming,
    try_all,
)
from tests.validation.robustness.rigfiles import (
    CAMERAS,
    CROSSINGS,
    TRACKS,
    GoodRig,
    RigPart,
    WrongField,
    crossed_rigs,
    good_rigs,
    places,
    schema_of,
    write_beside,
    wrong_fields,
    wrong_values,
)

EVERY = 40
"""One wrong field of so many is read from a file of its own."""


def models_within(annotation: Any) -> Iterator[type[BaseModel]]:
    """Every model that a value of an annotation may hold, from pydantic's own schema."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
        for field in annotation.model_fields.values():
            yield from models_within(field.annotation)
    for part in get_args(annotation):
        yield from models_within(part)


MODELS = {
    model
    for root in (Rig, TankSections, *CAMERAS.values(), *TRACKS.values())
    for model in models_within(root)
}


# ---- the enumeration is complete --------------------------------------------------------


def test_every_driver_has_its_options_listed() -> None:
    assert set(CAMERAS) == set(entry_points(group="lscan.cameras").names)
    assert set(TRACKS) == set(entry_points(group="lscan.tracks").names)


def test_every_pair_of_drivers_has_a_good_rig() -> None:
    assert {rig.drivers for rig in good_rigs()} == set(product(CAMERAS, TRACKS))


def test_every_field_of_every_model_is_set_wrong() -> None:
    set_wrong = {place.owner for rig in good_rigs() for place in places(rig)} - {None}
    assert set_wrong == {(model.__name__, name) for model in MODELS for name in model.model_fields}
    assert {"ShaftSection", "TrueShaft", "Groove", "Wedge"} <= {m.__name__ for m in MODELS}


def test_every_field_is_set_wrong_by_value_and_by_key() -> None:
    for rig in good_rigs():
        tried = Counter(wrong.keys for wrong in wrong_fields(rig))
        for place in places(rig):
            assert tried[place.keys] >= 5, place.keys
            if place.owner is not None:
                assert tried[(*place.keys[:-1], f"{place.keys[-1]}_")] >= 1, place.keys


def test_every_rule_of_a_model_is_broken_in_each_of_its_ways() -> None:
    """As often as the validator raises: each raise is one thing that can be wrong."""
    broken = Counter(crossing.rule for crossing in CROSSINGS)
    rules = {
        f"{model.__name__}.{name}": inspect.getsource(decorated.func).count("raise ")
        for model in MODELS
        for name, decorated in model.__pydantic_decorators__.model_validators.items()
        if name not in Strict.__pydantic_decorators__.model_validators
    }
    assert len(rules) >= 14
    assert {rule: broken[rule] for rule in rules if broken[rule] < rules[rule]} == {}
    of_models = {rule for rule in broken if "._" in rule}
    assert of_models == set(rules)


def test_every_crossing_starts_from_a_good_rig() -> None:
    assert len(list(crossed_rigs(good_rigs()))) == len(CROSSINGS)


# ---- wrong values follow from the type --------------------------------------------------


@pytest.mark.parametrize(
    ("annotation", "good", "among", "never"),
    [
        (Annotated[int, Field(ge=2, le=5)], 3, [1, 6, 1.5, "12", True, []], [2, 5]),
        (Annotated[float, Field(gt=0, lt=1)], 0.5, [0, 1, "wrong", False], [0.5]),
        (str, "a", [1, 12345.678, True, {"wrong": 1}], ["", "wrong"]),
        (bool, True, [1, 0, "wrong"], [True, False]),
        (Literal["a", "b"], "a", ["wrong", 1], ["a", "b"]),
        (tuple[float, float], [1.0, 2.0], [[], [1.0], [1.0, 2.0, 2.0]], [[1.0, 2.0]]),
        (
            Annotated[tuple[float, ...], Field(min_length=2, max_length=3)],
            [1.0, 2.0],
            [[], [1.0], [1.0, 2.0, 2.0, 2.0]],
            [[1.0, 2.0], [1.0, 2.0, 2.0]],
        ),
    ],
)
def test_wrong_values_lie_just_outside(
    annotation: Any, good: Any, among: list[Any], never: list[Any]
) -> None:
    found = {repr(value) for value in wrong_values(schema_of(annotation), good)}
    assert {repr(value) for value in among} - found == set()
    assert {repr(value) for value in never} & found == set()


def test_lists_of_a_stated_length_say_it() -> None:
    ten = Annotated[tuple[float, ...], Field(min_length=10, max_length=10)]
    assert in_words(ten) == "a list of 10, each item a number"
    some = Annotated[tuple[int, ...], Field(min_length=2)]
    assert in_words(some) == "a list of 2 or more, each item a whole number"
    few = Annotated[list[int], Field(min_length=2, max_length=4)]
    assert in_words(few) == "a list of 2 or more and 4 or fewer, each item a whole number"
    assert in_words(tuple[int, ...]) == "a list, each item a whole number"


class Near(Strict):
    kind: Literal["near"] = "near"
    gap_mm: float


class Far(Strict):
    kind: Literal["far"]


def near_if_left_out(value: Any) -> str:
    return str(value.get("kind", "near"))


KIND_BY_KEY = Annotated[Near | Far, Field(discriminator="kind")]
KIND_BY_FUNCTION = Annotated[
    Annotated[Near, Tag("near")] | Annotated[Far, Tag("far")], Discriminator(near_if_left_out)
]


@pytest.mark.parametrize(
    ("annotation", "kind", "required"),
    [
        (KIND_BY_KEY | None, "near", True),
        (KIND_BY_KEY | None, "far", True),
        (KIND_BY_FUNCTION, "near", False),
        (KIND_BY_FUNCTION, "far", False),
        (Far, "far", True),
    ],
)
def test_a_kind_is_required_where_only_the_key_states_it(
    annotation: Any, kind: str, required: bool
) -> None:
    model = create_model("File", __base__=Strict, piece=(annotation, ...))
    piece = {"kind": kind, "gap_mm": 1.0} if kind == "near" else {"kind": kind}
    rig = GoodRig("x", {"piece": piece}, (RigPart(model, (), ("piece",)),))
    found = {place.keys: place.required for place in places(rig)}
    assert found[("piece", "kind")] is required
    assert found.get(("piece", "gap_mm"), True)


# ---- the judge can find fault -----------------------------------------------------------

GAP = WrongField(
    what="optics.gap_mm out of range",
    document={},
    keys=("optics", "gap_mm"),
    change=-1.0,
    words=("number", "0", "100"),
)
"""A gap of -1 where 0 to 100 is allowed."""


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("{file}: optics.gap_mm: must be a number of 0 to 100 (got -1.0)", ""),
        ("{file}: gap_mm: must be a number of 0 to 100 (got -1.0)", "optics.gap_mm"),
        ("{file}: optics.gap_mm: out of range (got -1.0)", "number"),
        ("{file}: optics.gap_mm: must be a number of at least 0 (got -1.0)", "'100'"),
        ("{file}: optics.gap_mm: must be a number of 0 to 100", "'got -1.0'"),
        ("{file}: optics.gap_mm: must be a number up to 100 (got -1.0)", "'0'"),
        ("{file}: optics.gap_mm: must be a number of 0 to 100.5 (got -1.0)", "'100'"),
        ("optics.gap_mm: must be a number of 0 to 100 (got -1.0)", "rig.toml"),
        ("{file}: optics.gap_mm: a number of 0 to 100\n (got -1.0)", "one line"),
        (
            "{file}: optics.gap_mm: Input should be a number of 0 to 100 (got -1.0)",
            "words of the file",
        ),
    ],
)
def test_a_message_too_thin_is_noticed(tmp_path: Path, text: str, fault: str) -> None:
    file = tmp_path / "rig.toml"

    def refuse(path: Path) -> None:
        error = InputError("")
        error.args = (text.format(file=path),)  # an InputError itself breaks no line
        raise error

    found = shortcoming(GAP, file, read=refuse)
    assert fault in found
    assert bool(found) == bool(fault)


@pytest.mark.parametrize(
    ("read", "fault"),
    [
        (lambda file: None, "is accepted"),
        (lambda file: {}["gone"], "raises KeyError"),
        (lambda file: cv2.VideoCapture(0), "raises AssertionError"),
    ],
)
def test_a_reader_that_does_not_refuse_is_noticed(
    tmp_path: Path, read: Callable[[Path], object], fault: str
) -> None:
    with devices_guarded() as touched:
        assert shortcoming(GAP, tmp_path / "rig.toml", read=read).startswith(fault)
    assert touched == (["cv2.VideoCapture"] if "Assertion" in fault else [])


def test_every_opening_function_is_guarded() -> None:
    groups = ("lscan.cameras", "lscan.tracks")
    with devices_guarded() as touched:
        for entry in [entry for group in groups for entry in entry_points(group=group)]:
            with pytest.raises(AssertionError, match="was opened"):
                entry.load().open(None, None)
    assert len(touched) == len(CAMERAS) + len(TRACKS)


# ---- the rig files ----------------------------------------------------------------------


def test_one_wrong_field_of_many() -> None:
    """As lscan-sim judges the hardware's rooms: each from a file of its own."""
    tried, touched = try_all(EVERY)
    assert len(tried) > 200
    assert [(wrong.what, fault) for wrong, fault in tried if fault] == []
    assert touched == []


@pytest.mark.slow
def test_every_wrong_field_is_refused(tmp_path: Path) -> None:
    """Each value that any field is set to is read from a TOML file once.

    To parse thousands of files that differ in one field takes most of the time.  Where a value was
    read before, the tables take the place of what TOML makes of them: they are the same.
    """
    rigs = good_rigs()
    write_beside(tmp_path)
    file, faults, parsed = tmp_path / "my-rig.toml", {}, set()
    with devices_guarded() as touched:
        for rig in rigs:
            file.write_text(toml_text(rig.document), encoding="utf-8")
            load_rig(file)
        for wrong in [*chain(*map(wrong_fields, rigs)), *crossed_rigs(rigs)]:
            if wrong.change is None or repr(wrong.change) not in parsed:
                parsed.add(repr(wrong.change))
                faults[wrong.what] = shortcoming(wrong, file)
                continue
            with patch.object(documents, "_parse", lambda _, held=wrong: deepcopy(held.document)):
                faults[wrong.what] = fault_of_refusal(wrong, file, load_rig)
    assert {what: fault for what, fault in faults.items() if fault} == {}
    assert touched == []
    assert len(faults) > 8000 and len(parsed) > 100
