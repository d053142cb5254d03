"""How much of the roughness table's work is done: all of it, or a quick look at every row."""

from dataclasses import dataclass


@dataclass(frozen=True)
class RoughnessEffort:
    """What a run of the roughness table measures; by default all of it.

    fields : of random fields whose power law is fitted.  side : of theirs, cells.
    simulated : patches that intervals come from.  trains : of ripples.  frames : of the block's
    scan, ``step_mm`` apart.
    plain : rendered with few samples, in the first order of light.
    """

    fields: int = 200
    side: int = 128
    simulated: int = 400
    trains: int = 40
    frames: int = 240
    step_mm: float = 0.5
    plain: bool = False


FULL = RoughnessEffort()
QUICK = RoughnessEffort(
    fields=4, side=48, simulated=40, trains=2, frames=60, step_mm=2.0, plain=True
)
