"""What the controllers of a track have in common, whatever language they speak.

Every line is answered before the next is sent.

A serial line carries no checksum: whatever a position rests on is read until two readings
in a row agree.
"""

import contextlib
import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Generic, TypeVar

from lscan.devices.grbl.link import Link
from lscan.errors import DeviceError

READINGS: Final = 8
"""Readings of which two in a row must agree; a clean line needs two."""

ASKINGS: Final = 3
"""How often a question is asked that changes nothing, until it is answered readably."""

Said = TypeVar("Said")
Reading = TypeVar("Reading")
Answer = TypeVar("Answer")


class Unanswered(DeviceError):
    """A line was not answered, or not readably: where it changes nothing, it can be sent again."""


class Restarted(DeviceError):
    """The controller started anew, so that what it counted is lost."""


@dataclass(frozen=True)
class AxisTravel:
    """What a controller says of its axis, in machine coordinates.

    low_mm, high_mm: its travel, infinite where it guards none.  step_mm: one motor step.
    max_mm_min, accel_mm_s2: its fastest feed and its acceleration, infinite where unknown.
    """

    low_mm: float = -math.inf
    high_mm: float = math.inf
    step_mm: float = 0.0
    max_mm_min: float = math.inf
    accel_mm_s2: float = math.inf


class Exchange(ABC, Generic[Said]):
    """Lines and their answers, with one controller.

    answer_s: how long an answer may take.  homes: whether the controller can home, for what to do
    about a position that is lost.  lost: whether it has said since that it is.
    """

    def __init__(self, link: Link, answer_s: float) -> None:
        self.link, self._answer_s = link, answer_s
        self.homes, self.lost = True, False

    @abstractmethod
    def following(self, deadline_s: float) -> Said | None:
        """What is said next, None where nothing is whole by the deadline.

        Raises DeviceError where it says that the position can no longer be held.
        """

    @abstractmethod
    def ends(self, said: Said, text: str) -> bool:
        """Whether it is the ok that ends the answer to a line; an error where it refuses it."""

    def command(self, text: str, within_s: float | None = None, first: str = "") -> list[Said]:
        """Send a line; what was said until its ok.

        within_s: how long that may take, if not ``answer_s``.  first: what to look at first where
        no answer comes.  Raises Unanswered where it is refused or unanswered, DeviceError where
        the position is lost.
        """
        self.drain()
        self.link.send(text)
        return self.answers(text, within_s, first)

    def answers(self, text: str, within_s: float | None = None, first: str = "") -> list[Said]:
        """As ``command``, of a line that was sent before."""
        answers: list[Said] = []
        deadline_s = self.link.clock() + (self._answer_s if within_s is None else within_s)
        while (said := self.following(deadline_s)) is not None:
            if self.ends(said, text):
                return answers
            answers.append(said)
        raise self.silent(f"an answer to {text!r}", first)

    def query(self, text: str, first: str = "") -> list[Said]:
        """As ``command``, of a line that changes nothing: it is sent again where need be."""
        return asked(lambda: self.command(text, first=first))

    def drain(self) -> None:
        """Read what has come unasked, so that no old ok answers a new line."""
        while self.following(self.link.clock()) is not None:
            pass

    def restarted(self) -> Restarted:
        """The error that says so; the position is lost from here on."""
        self.lost = True
        mend = "home" if self.homes else "put the head back by hand"
        return Restarted(
            f"{self.link.name}: the controller has restarted, so its position is lost; check "
            f"its power and the USB cable, {mend}, and open the track again"
        )

    def silent(self, what: str, first: str = "") -> Unanswered:
        """The error that says that ``what`` did not come."""
        return Unanswered(
            f"{self.link.name}: silent: {what} did not come in time "
            f"({self.link.noise_bytes} bytes of noise so far); {first}check cable and power, then "
            "open the track again"
        )


def asked(ask: Callable[[], Answer]) -> Answer:
    """The answer of ``ask``, which is called again where it raises Unanswered, up to ASKINGS."""
    for _ in range(ASKINGS - 1):
        with contextlib.suppress(Unanswered):
            return ask()
    return ask()


def agreed(read: Callable[[], Reading], what: str, name: str) -> Reading:
    """The reading that two calls in a row of ``read`` give alike; DeviceError where none is.

    what: the thing read, name: the device, both for the message.
    """
    before = read()
    for _ in range(READINGS - 1):
        now = read()
        if now == before:
            return now
        before = now
    raise DeviceError(
        f"{name}: {what}: no two of {READINGS} readings in a row agree; shorten or shield the "
        "cable, keep it away from the motor's, or lower the baud rate"
    )
