"""The machine under the controller: three axes, their switches and limits, by Grbl's settings."""

import math
from collections.abc import Mapping

from sim.emulators.grbl.motion import Place, Planner, StraightMove

ROUNDING_MM = 1e-9  # of a target that is a sum


class Axes:
    """Where the head is, in truth and in the controller's count.

    settings: Grbl's ``$`` settings, shared with the controller.  head_mm: the head's true place,
    counted from switches of which each axis has one at 0 and one its travel below.
    """

    def __init__(self, settings: Mapping[int, float], head_mm: Place) -> None:
        self._settings = settings
        self._offset_mm = head_mm  # truth minus count: the count begins at zero
        self.planner = Planner()

    def head_mm(self, now_s: float) -> Place:
        """Where the head truly is."""
        place_mm = self.planner.place_mm(now_s)
        return tuple(a + b for a, b in zip(place_mm, self._offset_mm, strict=True))

    def counted_mm(self, now_s: float) -> Place:
        """Machine coordinates, of whole motor steps."""
        return self.on_steps(self.planner.place_mm(now_s))

    def on_steps(self, target_mm: Place) -> Place:
        """The target on whole motor steps."""
        steps = zip(target_mm, self._three(100), strict=True)
        return tuple(round(mm * per_mm) / per_mm for mm, per_mm in steps)

    def is_beyond(self, target_mm: Place) -> bool:
        """Whether soft limits are on and forbid the target."""
        travels_mm = self._three(130)
        return bool(self._settings[20]) and any(
            not -travel_mm - ROUNDING_MM <= mm <= ROUNDING_MM
            for mm, travel_mm in zip(target_mm, travels_mm, strict=True)
        )

    def push(
        self, target_mm: Place, feed_mm_min: float, now_s: float, *, jog: bool = False
    ) -> None:
        """Queue a move at its feed, or at what its axes may do along it, $110 and $120 on."""
        start_mm = self.planner.planned_mm(now_s)
        ways_mm = [abs(b - a) for a, b in zip(start_mm, target_mm, strict=True)]
        parts = [way_mm / max(math.hypot(*ways_mm), 1e-12) for way_mm in ways_mm]

        def least(base: int) -> float:
            limits = zip(self._three(base), parts, strict=True)
            return min((limit / part for limit, part in limits if part), default=1.0)

        feed_mm_s = min(feed_mm_min, least(110)) / 60
        self.planner.push(StraightMove(target_mm, feed_mm_s, least(120), jog), now_s)

    def seek_switches(self, now_s: float) -> None:
        """Begin to home, at the search rate $25."""
        switches = zip(self._switches_mm(), self._offset_mm, strict=True)
        target_mm = tuple(switch_mm - offset_mm for switch_mm, offset_mm in switches)
        self.push(target_mm, self._settings[25], now_s)

    def stand_off(self) -> None:
        """End homing: the head stands off its switches, and count and truth agree."""
        self._offset_mm = (0.0, 0.0, 0.0)
        off_mm = self._settings[27]
        self.planner.relabel(tuple(mm + (off_mm if mm else -off_mm) for mm in self._switches_mm()))

    def forget(self, now_s: float) -> None:
        """Lose the count: where the head stands becomes zero."""
        self.planner.halt(now_s)
        self._offset_mm = self.head_mm(now_s)
        self.planner.relabel((0.0, 0.0, 0.0))

    def _three(self, base: int) -> list[float]:
        return [self._settings[base + axis] for axis in range(3)]

    def _switches_mm(self) -> list[float]:
        """Where each axis has its switch: at 0, or by mask $23 at the far end."""
        mask = int(self._settings[23])
        return [-mm if mask >> axis & 1 else 0.0 for axis, mm in enumerate(self._three(130))]
