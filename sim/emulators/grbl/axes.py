"""The machine under the controller: three axes, their switches and limits, by Grbl's settings."""

from __future__ import annotations

import math
from collections.abc import Mapping

from sim.emulators.grbl.motion import Block, Place, Planner

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
        x, y, z = (a + b for a, b in zip(place_mm, self._offset_mm, strict=True))
        return x, y, z

    def counted_mm(self, now_s: float) -> Place:
        """Machine coordinates, of whole motor steps."""
        return self.on_steps(list(self.planner.place_mm(now_s)))

    def on_steps(self, target_mm: list[float]) -> Place:
        """The target on whole motor steps."""
        x, y, z = (
            round(mm * per_mm) / per_mm
            for mm, per_mm in zip(target_mm, self._three(100), strict=True)
        )
        return x, y, z

    def planned_mm(self, now_s: float) -> Place:
        """Where the queue ends, from where the next block starts."""
        return self.planner.last_target_mm if len(self.planner) else self.planner.place_mm(now_s)

    def beyond(self, target_mm: Place) -> bool:
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
        ways_mm = [abs(b - a) for a, b in zip(self.planned_mm(now_s), target_mm, strict=True)]
        parts = [way_mm / max(math.hypot(*ways_mm), 1e-12) for way_mm in ways_mm]

        def least(base: int) -> float:
            limits = zip(self._three(base), parts, strict=True)
            return min((limit / part for limit, part in limits if part), default=1.0)

        feed_mm_s = min(feed_mm_min, least(110)) / 60
        self.planner.push(Block(target_mm, feed_mm_s, least(120), jog), now_s)

    def seek_switches(self, now_s: float) -> None:
        """Begin to home, at the search rate $25."""
        switches = (switch for switch, _ in self._ends())
        x, y, z = (a - b for a, b in zip(switches, self._offset_mm, strict=True))
        self.push((x, y, z), self._settings[25], now_s)

    def stand_off(self) -> None:
        """End homing: the head stands off its switches, and count and truth agree."""
        self._offset_mm = (0.0, 0.0, 0.0)
        x, y, z = (stand for _, stand in self._ends())
        self.planner.relabel((x, y, z))

    def forget(self, now_s: float) -> None:
        """Lose the count: where the head stands becomes zero."""
        self.planner.halt(now_s)
        self._offset_mm = self.head_mm(now_s)
        self.planner.relabel((0.0, 0.0, 0.0))

    def _three(self, base: int) -> list[float]:
        return [self._settings[base + axis] for axis in range(3)]

    def _ends(self) -> list[tuple[float, float]]:
        """Of each axis where its switch is, 0 or by mask $23 the far end, and its stand-off."""
        ends = []
        for axis, travel_mm in enumerate(self._three(130)):
            far = int(self._settings[23]) >> axis & 1
            off_mm = self._settings[27]
            ends.append((-travel_mm, -travel_mm + off_mm) if far else (0.0, -off_mm))
        return ends
