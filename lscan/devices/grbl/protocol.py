"""What Grbl 1.1 says, line by line, as records.

Source: Grbl 1.1 interface documentation, "Response Messages", "Push Messages" and
"Real-time Status Reports".  The line carries no checksum, so a line that does not fit the
documented form exactly is taken for noise.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

STATES: Final = ("Idle", "Run", "Hold", "Jog", "Alarm", "Door", "Check", "Home", "Sleep")
AXES: Final = "XYZ"

Numbers = tuple[float, ...]


@dataclass(frozen=True)
class Ok:
    """The line before was understood."""


@dataclass(frozen=True)
class Refusal:
    """``error:N``: the line before was not executed."""

    code: int


@dataclass(frozen=True)
class Alarm:
    """``ALARM:N``: the machine has stopped and locked itself."""

    code: int


@dataclass(frozen=True)
class Banner:
    """``Grbl 1.1h ['$' for help]``: the controller has just started."""

    version: str


@dataclass(frozen=True)
class Setting:
    """``$number=value``."""

    number: int
    value: float


@dataclass(frozen=True)
class Feedback:
    """``[kind:text]``, a message or an answer to a query; a start-up line has kind ``>``."""

    kind: str
    text: str


@dataclass(frozen=True)
class Status:
    """A real-time report.  Lengths are in the controller's report unit ($13), mm or inches.

    substate: the number after Hold or Door.  machine, work: position in machine or in work
    coordinates, of which a report has one.  offset: work coordinates' origin (WCO).
    blocks, bytes: what is free in the planner and the receive buffer (Bf).  feed, spindle:
    present speed (F, FS).  overrides: feed, rapids, spindle in % (Ov).  pins: letters of the
    inputs that are active (Pn).  accessories: A.  others: fields not documented, as text.
    """

    state: str
    substate: int | None = None
    machine: Numbers | None = None
    work: Numbers | None = None
    offset: Numbers | None = None
    blocks: int | None = None
    bytes: int | None = None
    line: int | None = None
    feed: float | None = None
    spindle: float | None = None
    overrides: tuple[int, ...] | None = None
    pins: str = ""
    accessories: str = ""
    others: tuple[tuple[str, str], ...] = ()


Message = Ok | Refusal | Alarm | Banner | Setting | Feedback | Status

_NUMBER = r"-?\d+(?:\.\d*)?"
_CODE = re.compile(r"(error|ALARM):(\d{1,3})")
_BANNER = re.compile(r"Grbl (\d+\.\d+\w?)(?: \[.*\])?")
_SETTING = re.compile(rf"\$(\d{{1,3}})=({_NUMBER})")
_FEEDBACK = re.compile(r"\[(\w+):(.*)\]")
_NUMBERS = re.compile(rf"{_NUMBER}(?:,{_NUMBER})*")


def parse_line(text: str) -> Message | None:
    """The message in one line without its line end; None where it is none, that is, noise."""
    if text == "ok":
        return Ok()
    if code := _CODE.fullmatch(text):
        return (Refusal if code[1] == "error" else Alarm)(int(code[2]))
    if banner := _BANNER.fullmatch(text):
        return Banner(banner[1])
    if setting := _SETTING.fullmatch(text):
        return Setting(int(setting[1]), float(setting[2]))
    if feedback := _FEEDBACK.fullmatch(text):
        return Feedback(feedback[1], feedback[2])
    if text.startswith(">") and text.endswith(":ok"):
        return Feedback(">", text[1:])
    return parse_status(text)


def parse_status(text: str) -> Status | None:
    """The status report ``<State|field:values|...>``; None where the text is no such report.

    A report has a documented state and a position of at least one axis.
    """
    if not (text.startswith("<") and text.endswith(">")):
        return None
    head, *fields = text[1:-1].split("|")
    state, colon, substate = head.partition(":")
    if state not in STATES or (colon and not substate.isdecimal()):
        return None
    found: dict[str, object] = {"substate": int(substate) if colon else None}
    others: list[tuple[str, str]] = []
    for field in fields:
        name, colon, values = field.partition(":")
        read = _field(name, values) if colon else None
        if read is None or found.keys() & read.keys():
            return None
        if "others" in read:
            others.append((name, values))
        else:
            found |= read
    if ("machine" in found) == ("work" in found):
        return None
    return Status(state=state, others=tuple(others), **found)  # type: ignore[arg-type]


_LENGTHS = {"MPos": "machine", "WPos": "work", "WCO": "offset"}
_COUNTS = {"Bf": ("blocks", "bytes"), "Ln": ("line",), "F": ("feed",), "FS": ("feed", "spindle")}


def _field(name: str, values: str) -> dict[str, object] | None:
    """One field as attributes of Status; None where its values are not of its kind."""
    if name == "Pn":
        return {"pins": values} if values.isalpha() else None
    if name == "A":
        return {"accessories": values} if values.isalpha() else None
    if name not in _LENGTHS and name not in _COUNTS and name != "Ov":
        return {"others": values} if name.isalnum() else None
    if not _NUMBERS.fullmatch(values):
        return None
    numbers = tuple(float(value) for value in values.split(","))
    if name in _LENGTHS:
        return {_LENGTHS[name]: numbers}
    whole = tuple(int(number) for number in numbers)
    if name == "Ov":
        return {"overrides": whole} if len(whole) == 3 else None
    attributes = _COUNTS[name]
    if len(numbers) != len(attributes):
        return None
    kept: Numbers = numbers if name in ("F", "FS") else whole
    return dict(zip(attributes, kept, strict=True))
