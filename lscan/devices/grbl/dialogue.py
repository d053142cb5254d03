"""Talking with Grbl 1.1: what it says as records, and lines with their answers.

Source: Grbl 1.1 interface documentation, "Response Messages", "Push Messages" and
"Real-time StatusReport Reports".  The line carries no checksum, so a line that does not fit the
documented form exactly is taken for noise.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Literal

from lscan.devices.grbl.machine import Exchange, Unanswered, ask_again
from lscan.errors import DeviceError
from lscan.files.disk import packaged_table

# What Grbl 1.1 says, line by line, as records.

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

    firmware: str
    version: str

    @property
    def number(self) -> tuple[int, ...]:
        """The version's numbers, such as (1, 1)."""
        return tuple(map(int, re.findall(r"\d+", self.version)))

    @property
    def is_documented(self) -> bool:
        """Whether it numbers itself as Grbl 1.1; FluidNC and Grbl_ESP32 go by 3 and 1.3."""
        return self.number == (1, 1)


@dataclass(frozen=True)
class GrblSetting:
    """``$number=value``."""

    number: int
    value: float


@dataclass(frozen=True)
class Feedback:
    """``[kind:text]``, a message or an answer to a query; a start-up line has kind ``>``."""

    kind: str
    text: str


@dataclass(frozen=True)
class StatusReport:
    """A real-time report.  Lengths are in the controller's report unit ($13), mm or inches.

    substate: the number after the state.  machine, work: position in machine or in work
    coordinates, of which a report has one.  offset: work coordinates' origin (WCO).  pins: letters
    of the inputs that are active (Pn).  What else it holds must be as documented, and is not kept.
    """

    state: str
    substate: int | None = None
    machine: Numbers | None = None
    work: Numbers | None = None
    offset: Numbers | None = None
    pins: str = ""


Message = Ok | Refusal | Alarm | Banner | GrblSetting | Feedback | StatusReport

CODES: dict[str, dict[str, str]] = packaged_table("lscan.devices.grbl", "codes.toml")
"""What numbers mean, in words: by "error" or "ALARM", then by number."""

_NUMBER = r"-?\d+(?:\.\d*)?"
_FORMS: dict[str, Callable[..., Message]] = {
    r"ok": Ok,
    r"error:(\d{1,3})": lambda code: Refusal(int(code)),
    r"ALARM:(\d{1,3})": lambda code: Alarm(int(code)),
    r"(Grbl(?:HAL)?) (\d+\.\d+\w?)(?: \[.*\])?": Banner,
    rf"\$(\d{{1,3}})=({_NUMBER})": lambda number, value: GrblSetting(int(number), float(value)),
    r"\[(\w+):(.*)\]": Feedback,
    r"(>)(.*:ok)": Feedback,
}
"""What a line looks like, but a report, and the message that is made of its parts."""


def in_words(kind: Literal["error", "ALARM"], code: int) -> str:
    """``error:N, meaning`` or ``ALARM:N, meaning``; of an unknown code, that it is unknown."""
    return f"{kind}:{code}, {CODES[kind].get(str(code), 'which Grbl 1.1 does not document')}"


def parse_line(text: str) -> Message | None:
    """The message in one line without its line end; None where it is none, that is, noise."""
    for form, message in _FORMS.items():
        if said := re.fullmatch(form, text):
            return message(*said.groups())
    return parse_status(text)


_FIELDS = {
    **dict.fromkeys(("MPos", "WPos", "WCO"), rf"{_NUMBER}(?:,{_NUMBER})*"),
    **dict.fromkeys(("F", "Ln"), _NUMBER),
    **dict.fromkeys(("FS", "Bf"), rf"{_NUMBER},{_NUMBER}"),
    "Ov": rf"{_NUMBER},{_NUMBER},{_NUMBER}",
    **dict.fromkeys(("Pn", "A"), "[A-Za-z]*"),  # grblHAL says A: where nothing is on
}
"""The documented fields of a report by their names, and what their values look like."""


def parse_status(text: str) -> StatusReport | None:
    """The status report ``<State|field:values|...>``; None where the text is no such report.

    A report has a documented state and a position of at least one axis; fields that are not
    documented, as other firmware sends them, are passed over.
    """
    if not (text.startswith("<") and text.endswith(">")):
        return None
    head, *parts = text[1:-1].split("|")
    state, colon, substate = head.partition(":")
    if state not in STATES or (colon and not substate.isdecimal()):
        return None
    fields: dict[str, str] = {}
    for part in parts:
        name, separator, values = part.partition(":")
        fits = name.isalnum() and re.fullmatch(_FIELDS.get(name, ".*"), values)
        if not separator or name in fields or not fits:
            return None
        fields[name] = values
    if ("MPos" in fields) == ("WPos" in fields):
        return None
    machine, work, offset = (_numbers(fields.get(name)) for name in ("MPos", "WPos", "WCO"))
    number = int(substate) if colon else None
    return StatusReport(state, number, machine, work, offset, fields.get("Pn", ""))


def _numbers(text: str | None) -> Numbers | None:
    return None if text is None else tuple(map(float, text.split(",")))


# Talking with Grbl 1.1: lines and their answers, reports, and noise passed over.


STATUS: Final = b"?"
ASK_AGAIN_S: Final = 0.25  # a report comes within 20 ms, but Grbl may drop a question


class Dialogue(Exchange[Message]):
    """The exchange with one controller.  homes: by its setting $22."""

    def ends(self, said: Message, text: str) -> bool:
        """Whether it is an ok; Unanswered for a refusal, since noise may have caused it."""
        if isinstance(said, Refusal):
            raise Unanswered(
                f"{self.link.name}: refuses {text!r}: {in_words('error', said.code)}; where the "
                "command is right, a noisy line garbled it: check the cable"
            )
        return isinstance(said, Ok)

    def modes(self) -> list[str]:
        """The words of ``$G``, such as G54 or T0."""

        def ask() -> list[str]:
            for answer in self.command("$G"):
                if isinstance(answer, Feedback) and answer.kind == "GC":
                    return answer.text.split()
            raise self.silent("a readable answer to '$G'")

        return ask_again(ask)

    def status(self) -> StatusReport:
        """A report asked for now, its lengths in the controller's unit."""
        if (report := self._report(self.following)) is None:
            raise self.silent("a status report")
        return report

    def any_status(self) -> StatusReport | None:
        """As ``status``, of a controller that may have restarted; None where none comes."""
        return self._report(self.read)

    def _report(self, read: Callable[[float], Message | None]) -> StatusReport | None:
        link, end_s = self.link, self.link.clock() + self._answer_s
        while link.clock() < end_s:
            link.send_bytes(STATUS)
            ask_again_s = min(end_s, link.clock() + ASK_AGAIN_S)
            while (message := read(ask_again_s)) is not None:
                if isinstance(message, StatusReport):
                    return message
        return None

    def read(self, deadline_s: float) -> Message | None:
        """The next message, whatever it says; None where none is whole by the deadline."""
        while (text := self.link.line(deadline_s)) is not None:
            if (message := parse_line(text)) is not None:
                return message
            self.link.skip(text)
        return None

    def following(self, deadline_s: float) -> Message | None:
        """As ``read``; DeviceError where it says that the position can no longer be held."""
        message = self.read(deadline_s)
        if isinstance(message, Alarm):
            self.lost = True
            what = f"{self.link.name}: {in_words('ALARM', message.code)}; {self.alarm_remedy()}"
            raise DeviceError(what)
        if isinstance(message, Banner):
            raise self.restart_error()
        return message

    def alarm_remedy(self) -> str:
        """What to do about an alarm, and what ``$X`` costs."""
        if self.homes:
            return (
                "clear the way, then home ($H, or homing = true) before the next scan; $X only "
                "unlocks, and leaves the position lost"
            )
        return (
            "clear the way, then unlock by $X, which leaves the position lost; this controller "
            "does not home ($22=0), so before a scan goes on switch it off, push the head by hand "
            "to where it stood when it was first switched on, and switch it on; or scan anew"
        )
