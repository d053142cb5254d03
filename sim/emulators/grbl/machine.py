"""What the emulated controllers have in common: a machine of three axes, and bytes in and out."""

import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Mapping

from sim.emulators.grbl.axes import Axes
from sim.emulators.grbl.gcode import GcodeBlock
from sim.emulators.grbl.modes import Modes
from sim.emulators.grbl.motion import Place
from sim.emulators.grbl.settings import DEFAULTS


class EmulatedController(ABC):
    """A controller with its machine: bytes in by ``receive``, bytes out by ``transmit``.

    Parameters
    ----------
    settings
        Grbl's ``$`` settings, of the machine too, that differ from DEFAULTS.
    head_mm
        Where the head is at power-up, counted from the switches, of which each axis has one at 0
        and its travel below.  Machine coordinates are zero there until homing.
    clock
        Seconds.
    """

    line_end = b"\n"

    def __init__(
        self,
        settings: Mapping[int, float] | None = None,
        head_mm: Place = (-50.0, -50.0, -50.0),
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.settings = {**DEFAULTS, **(settings or {})}
        self._lock_out = threading.RLock()  # the line's thread and whoever looks at the head
        self._clock, self._last_s = clock, clock()
        self._axes = Axes(self.settings, head_mm)
        self._planner = self._axes.planner
        self._out, self._line = bytearray(), bytearray()
        self._pending: deque[str] = deque()
        self._homing, self._modes = False, Modes()
        self._power_up()

    @property
    def head_mm(self) -> Place:
        """Where the head truly is, counted from the switches."""
        with self._lock_out:
            self._update()
            return self._axes.head_mm(self._last_s)

    @property
    def standing_mm(self) -> Place | None:
        """Where the head rests, counted from the switches; None while it moves."""
        with self._lock_out:
            self._update()
            return None if self._planner.moving else self._axes.head_mm(self._last_s)

    @property
    def laser_power(self) -> float:
        """S word of the laser that is on; 0 where it is off."""
        return 0.0 if self._modes.spindle == 5 else self._modes.speed

    def receive(self, data: bytes) -> None:
        """Take bytes from the line; OSError while it is unplugged."""
        with self._lock_out:
            self._update()
            for byte in self._on_line(data):
                self._take(byte)
            self._process()

    def transmit(self) -> bytes:
        """The bytes to send by now; OSError while the line is unplugged."""
        with self._lock_out:
            self._update()
            data = bytes(self._out)
            self._out.clear()
            return self._on_line(data)

    def _on_line(self, data: bytes) -> bytes:
        """The bytes as the line carries them."""
        return data

    @abstractmethod
    def _power_up(self) -> None:
        """Begin with what a controller says and is when it is switched on."""

    @abstractmethod
    def _update(self) -> None:
        """Bring the machine to the present time."""

    @abstractmethod
    def _take(self, byte: int) -> None:
        """Take one byte from the line."""

    @abstractmethod
    def _process(self) -> None:
        """Execute the lines that need not wait, and answer them."""

    def _end_line(self) -> None:
        self._pending.append(self._line.decode("ascii", errors="replace"))
        self._line.clear()

    def _start_homing(self) -> None:
        self._homing = True
        self._axes.seek_switches(self._last_s)

    def _end_homing(self) -> None:
        self._homing = False
        self._axes.stand_off()
        self._say("ok")

    def _target(self, block: GcodeBlock) -> Place:
        """The block's target in machine coordinates, on whole motor steps."""
        start_mm = self._planner.planned_mm(self._last_s)
        return self._axes.on_steps(self._modes.target_mm(block, start_mm))

    def _say(self, *lines: str) -> None:
        for line in lines:
            self._out += line.encode("ascii") + self.line_end
