"""Which faults there are, at which moments they occur, and how one is drawn."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal, get_args

import numpy as np

from lscan.files.disk import packaged_table
from sim.testing.faultycamera import GARBAGE
from sim.testing.faultydisk import CALLS_A_FRAME

FRAMES: Final[int] = packaged_table("sim.testing", "bench.toml")["plan"]["frames"]
"""Frames of each experiment's scan."""

Device = Literal["camera", "track", "disk", "clock"]
Phase = Literal["opening", "before the move", "in mid-move", "before the grab", "in the write"]
PHASES: Final[tuple[Phase, ...]] = get_args(Phase)


@dataclass(frozen=True)
class FaultKind:
    """A kind of fault.

    says: what an error it leads to must say of what to do, as a regular expression; "" where
    it must not lead to an error.
    """

    device: Device
    says: str


KINDS: Final[Mapping[str, FaultKind]] = {
    kind: FaultKind(**fields)
    for kind, fields in packaged_table("sim.testing", "faults.toml")["kinds"].items()
}


@dataclass(frozen=True)
class InjectedFault:
    """One fault.

    Attributes
    ----------
    kind : str, a key of KINDS
    frame : int, in whose turn it occurs
    phase : Phase, when within that turn
    part : float, where within the phase, 0 to 1 of the way, or of the system calls that write the
        frame
    strength : float, as the device's ``inject`` takes it
    stamped : bool, whether the camera stamps its pictures with their time
    """

    kind: str
    frame: int
    phase: Phase
    part: float
    strength: float
    stamped: bool

    @property
    def call(self) -> int:
        """Number of the system call of the frame's write at which it occurs."""
        return int(self.part * CALLS_A_FRAME)


def draw_fault(kind: str, generator: np.random.Generator) -> InjectedFault:
    """A fault of a kind, its moment and its strength drawn.

    Parameters
    ----------
    kind : str, a key of KINDS
    generator : Generator, all is drawn from it
    """
    device = KINDS[kind].device
    phase: Phase = PHASES[int(generator.integers(len(PHASES)))]
    if kind == "folder vanished" and phase == "opening":  # there is none yet
        phase = "before the move"
    if device == "disk" and generator.random() < 0.5:
        phase = "in the write"
    # A fault of the devices after the last picture's move has no effect any more.
    last = FRAMES if device == "disk" or phase == "before the move" else FRAMES - 1
    stamped = bool(generator.integers(2)) or kind == "camera clock set"
    return InjectedFault(
        kind=kind,
        frame=0 if phase == "opening" else int(generator.integers(last)),
        phase=phase,
        part=float(generator.random()),
        strength=_strength(kind, phase, stamped, generator),
        stamped=stamped,
    )


def _strength(kind: str, phase: Phase, stamped: bool, generator: np.random.Generator) -> float:
    """How strong: see ``inject`` of the device."""
    device = KINDS[kind].device
    if kind in ("serial garbled", "serial noisy"):
        low, high = (-1.0, -0.3) if kind == "serial garbled" else (-4.0, -1.0)
        return float(10 ** generator.uniform(low, high))
    if kind == "lost ok":
        return float(generator.integers(1, 4))
    if kind == "camera late":
        # Without time stamps lateness is known only by counting: flush_frames is 2, and one
        # picture is always under way.
        return float(generator.integers(1, 21)) if stamped else 1.0
    if kind in ("camera clock set", "wall clock set"):
        sign = -1.0 if kind == "wall clock set" or generator.random() < 0.75 else 1.0
        return sign * float(10 ** generator.uniform(-2, 3))
    if kind == "camera garbage":
        # A camera that is grey from the start has no fault.
        return float(generator.integers(len(GARBAGE) - (phase == "opening")))
    if device == "camera":
        return math.inf if generator.random() < 0.6 else float(generator.integers(1, 6))
    return float(generator.random())
