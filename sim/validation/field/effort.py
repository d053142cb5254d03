"""How much of the field table's work is done: all of it, or a quick look at every row."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class FieldEffort:
    """What a run of the field table measures; by default all of it.

    seeds: of sensor noise, and of what else is drawn at random in a chapter.  photographs: folder
    of real pictures; None: rows of real pictures are left out.  plain: rendered with few samples,
    in the first order of light.
    """

    seeds: tuple[int, ...] = tuple(range(1, 21))
    photographs: Path | None = None
    plain: bool = False

    @property
    def seeded(self) -> str:
        """The seeds in words."""
        return f"seeds {self.seeds[0]} to {self.seeds[-1]}"


FULL = FieldEffort()
QUICK = FieldEffort(seeds=(1,), plain=True)
