"""What the controllers of a track have in common, whatever language they speak.

A serial line carries no checksum: whatever a position rests on is read until two readings
in a row agree.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, TypeVar

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
