"""What can go wrong between a program and its track."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Faults:
    """Faults that act from ``begin_s`` on, on the emulator's clock.

    silent: nothing is answered any more.  garble: chance that a byte, in either direction, is
    replaced by any other; seed: of the generator that draws them.  lose_oks: how many of the
    next ok never arrive.  alarm: the limit switch closes during the next motion.  stuck: a motion
    goes no further, though the controller says it does.  slow: how many times longer a motion
    takes.  restart: the supply dips; the controller starts anew and takes where it stands for
    zero; quietly: its banner is lost.  unplug: the line breaks.
    """

    begin_s: float = 0.0
    silent: bool = False
    garble: float = 0.0
    seed: int = 0
    lose_oks: int = 0
    alarm: bool = False
    stuck: bool = False
    slow: float = 1.0
    restart: bool = False
    quietly: bool = False
    unplug: bool = False


def garbled(data: bytes, chance: float, generator: np.random.Generator) -> bytes:
    """The bytes, each replaced with this chance by another value."""
    if chance <= 0 or not data:
        return data
    values = np.frombuffer(data, dtype=np.uint8)
    hit = generator.random(values.size) < chance
    other = (values + generator.integers(1, 256, values.size)) % 256
    return np.where(hit, other, values).astype(np.uint8).tobytes()
