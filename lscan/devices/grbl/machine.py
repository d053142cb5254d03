"""What a track asks of a motion controller, whatever language it speaks.

A serial line carries no checksum: whatever a position rests on is read until two readings
in a row agree.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol, TypeVar

from lscan.devices.api import Fact
from lscan.errors import DeviceError

READINGS: Final = 8
"""Readings of which two in a row must agree; a clean line needs two."""

ASKINGS: Final = 3
"""How often a question is asked that changes nothing, until it is answered readably."""

Reading = TypeVar("Reading")
Answer = TypeVar("Answer")


class Unanswered(DeviceError):
    """A line was not answered, or not readably: where it changes nothing, it can be sent again."""


@dataclass(frozen=True)
class Travel:
    """What a controller says of its axis, in machine coordinates.

    low_mm, high_mm: its travel, infinite where it guards none.  step_mm: one motor step.
    max_mm_min, accel_mm_s2: its fastest feed and its acceleration, infinite where unknown.
    """

    low_mm: float = -math.inf
    high_mm: float = math.inf
    step_mm: float = 0.0
    max_mm_min: float = math.inf
    accel_mm_s2: float = math.inf


class Machine(Protocol):
    """One axis of a motion controller, in machine coordinates, mm.

    Every method raises DeviceError where the controller is silent, refuses, is in alarm or
    has restarted, and says what to do.
    """

    @property
    def zero(self) -> str:
        """Name of the machine's zero."""
        ...

    def has_kept(self, zero: str) -> bool:
        """Whether its zero has not moved since it had this name, for all that can be told."""
        ...

    def wake(self) -> Travel:
        """Bring the controller to where it takes commands; what it says of its axis."""
        ...

    def describe(self) -> dict[str, Fact]:
        """Its firmware, its state where it tells one, and the bytes of noise skipped so far."""
        ...

    def home(self) -> None:
        """Search the axis's switch and set the machine's zero from it."""
        ...

    def move(self, target_mm: float, feed_mm_min: float, within_s: float) -> None:
        """Move and wait until at rest."""
        ...

    def position_mm(self) -> float:
        """Where the axis stands, confirmed by a second reading; DeviceError while it moves."""
        ...

    def laser(self, power: float) -> None:
        """Switch the laser on with this S word; 0 switches it off."""
        ...

    def stop(self) -> None:
        """Stop any motion and wait until the machine is idle."""
        ...

    def close(self) -> None:
        """Release the line."""
        ...


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
