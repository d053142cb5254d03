"""Motion of the axes: ramps of constant acceleration, one block after another.

Each block starts and ends at rest; Grbl joins blocks without stopping where it can, which a
track that waits after every move never asks for.
"""

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Self

Place = tuple[float, ...]
"""Of the three axes, mm."""


@dataclass(frozen=True)
class Ramp:
    """Way along a block as a function of the time since its start.

    phases: of constant acceleration, one after the other: how long each lasts, s, the speed at
    its start, mm/s, and the acceleration, mm/s².
    """

    phases: tuple[tuple[float, float, float], ...]

    @classmethod
    def from_rest_to_rest(cls, length_mm: float, top_mm_s: float, accel_mm_s2: float) -> Self:
        """Over a way at most at ``top_mm_s``, or at what half the way allows, v² = 2 a s."""
        peak_mm_s = min(top_mm_s, math.sqrt(accel_mm_s2 * length_mm))
        rise_s = peak_mm_s / accel_mm_s2
        steady_s = max(0.0, length_mm / peak_mm_s - rise_s) if peak_mm_s else 0.0
        rise, fall = (rise_s, 0.0, accel_mm_s2), (rise_s, peak_mm_s, -accel_mm_s2)
        return cls((rise, (steady_s, peak_mm_s, 0.0), fall))

    @classmethod
    def to_rest(cls, start_mm_s: float, accel_mm_s2: float) -> Self:
        """Braking from a speed."""
        return cls(((start_mm_s / accel_mm_s2, start_mm_s, -accel_mm_s2),))

    @cached_property  # asked for at every look at the line
    def duration_s(self) -> float:
        """Time to rest."""
        return sum(lasts_s for lasts_s, _, _ in self.phases)

    def at(self, time_s: float) -> tuple[float, float]:
        """Way gone after ``time_s``, mm, and the speed then, mm/s."""
        way_mm = speed_mm_s = 0.0
        left_s = max(0.0, time_s)
        for lasts_s, start_mm_s, accel_mm_s2 in self.phases:
            part_s = min(left_s, lasts_s)
            way_mm += start_mm_s * part_s + accel_mm_s2 * part_s**2 / 2
            speed_mm_s = start_mm_s + accel_mm_s2 * part_s
            left_s -= part_s
            if left_s <= 0:
                break
        return way_mm, max(0.0, speed_mm_s)


@dataclass(frozen=True)
class StraightMove:
    """A straight move, machine coordinates, with its limits along its own direction."""

    target_mm: Place
    feed_mm_s: float
    accel_mm_s2: float
    jog: bool = False


class Planner:
    """The queue of blocks and where the axes are in it.  All times on the caller's clock."""

    def __init__(self) -> None:
        self._queue: deque[StraightMove] = deque()
        self._start_mm: Place = (0.0, 0.0, 0.0)
        self._direction: Place = (0.0, 0.0, 0.0)
        self._ramp: Ramp | None = None
        self._block: StraightMove | None = None
        self._began_s = 0.0
        self.braking = False

    def __len__(self) -> int:
        """Blocks not finished, the present one included."""
        return len(self._queue) + (self._block is not None)

    @property
    def moving(self) -> bool:
        """Whether an axis is in motion."""
        return self._ramp is not None

    @property
    def jogging(self) -> bool:
        """Whether the present block is a jog."""
        return self._block is not None and self._block.jog

    def push(self, block: StraightMove, now_s: float) -> None:
        """Queue a block; at rest it starts at once."""
        self._queue.append(block)
        if self._block is None:
            self._begin(now_s)

    def place_mm(self, now_s: float) -> Place:
        """Where the axes are."""
        if self._ramp is None:
            return self._start_mm
        way_mm, _ = self._ramp.at(now_s - self._began_s)
        return tuple(a + way_mm * d for a, d in zip(self._start_mm, self._direction, strict=True))

    def planned_mm(self, now_s: float) -> Place:
        """Where the queue ends, from where the next block starts."""
        last = self._queue[-1] if self._queue else self._block
        return self.place_mm(now_s) if last is None else last.target_mm

    def speed_mm_s(self, now_s: float) -> float:
        """Speed along the path."""
        return 0.0 if self._ramp is None else self._ramp.at(now_s - self._began_s)[1]

    def advance(self, now_s: float) -> None:
        """Finish what is finished by now and begin what follows."""
        while self._ramp is not None and now_s - self._began_s >= self._ramp.duration_s:
            ended_s = self._began_s + self._ramp.duration_s
            if self.braking:
                self._start_mm, self._ramp, self.braking = self.place_mm(ended_s), None, False
                return
            assert self._block is not None
            self._start_mm, self._ramp, self._block = self._block.target_mm, None, None
            if self._queue:
                self._begin(ended_s)

    def brake(self, now_s: float) -> None:
        """Slow down to rest; the rest of the block stays to be resumed."""
        if self._ramp is not None and not self.braking and self._block is not None:
            place_mm, speed = self.place_mm(now_s), self.speed_mm_s(now_s)
            self._start_mm, self._began_s = place_mm, now_s
            self._ramp, self.braking = Ramp.to_rest(speed, self._block.accel_mm_s2), True

    def resume(self, now_s: float) -> None:
        """Go on with a block that was braked to rest."""
        if self._block is not None and self._ramp is None:
            self._queue.appendleft(self._block)
            self._begin(now_s)

    def flush(self) -> None:
        """Forget every block; for axes at rest."""
        self._queue.clear()
        self._block = None

    def halt(self, now_s: float) -> bool:
        """Stop dead where the axes are and forget every block; whether anything moved."""
        moved = self.moving
        self._start_mm, self._ramp, self.braking = self.place_mm(now_s), None, False
        self.flush()
        return moved

    def relabel(self, place_mm: Place) -> None:
        """Give the place where the axes rest new coordinates; forgets every block."""
        self._start_mm = place_mm
        self.flush()

    def hold_still(self, seconds: float) -> None:
        """Let the present ramp lose ``seconds``: a stuck or slowed machine."""
        self._began_s += seconds

    def _begin(self, now_s: float) -> None:
        self._block = block = self._queue.popleft()
        way = [b - a for a, b in zip(self._start_mm, block.target_mm, strict=True)]
        length_mm = math.hypot(*way)
        self._direction = tuple(part / (length_mm or 1.0) for part in way)
        self._ramp = Ramp.from_rest_to_rest(length_mm, block.feed_mm_s, block.accel_mm_s2)
        self._began_s = now_s
        self.advance(now_s)


# The machine under the controller: three axes, their switches and limits, by Grbl's settings.


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
