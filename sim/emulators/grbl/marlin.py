"""An emulated controller that answers as Marlin does, as far as a track asks.

Source: Marlin's G-code reference, pages G0-G1, G20, G21, G28, G90, G91, M3, M5, M114, M115,
M400, M410, and its host keepalive.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping

from sim.emulators.grbl.axes import Axes
from sim.emulators.grbl.controller import DEFAULTS
from sim.emulators.grbl.gcode import GcodeError, clean, parse_block
from sim.emulators.grbl.motion import Place

KEEPALIVE_S = 2.0
INCH_MM = 25.4


class MarlinEmulator:
    """A controller with its machine: bytes in by ``receive``, bytes out by ``transmit``.

    settings: the machine, in Grbl's numbers.  head_mm, clock: as GrblEmulator's.
    """

    def __init__(
        self,
        settings: Mapping[int, float] | None = None,
        head_mm: Place = (-50.0, -50.0, -50.0),
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._lock_out = threading.RLock()
        self._clock = clock
        self._axes = Axes({**DEFAULTS, **(settings or {})}, head_mm)
        self._out, self._line = bytearray(b"start\necho:Marlin 2.1.2\n"), bytearray()
        self._pending: deque[str] = deque()
        self._absolute, self._unit_mm, self._feed_mm_min = True, 1.0, 600.0
        self._homing = False
        self._spoke_s = clock()
        self.laser_power = 0.0

    @property
    def head_mm(self) -> Place:
        """Where the head truly is, counted from the switches."""
        with self._lock_out:
            self._update()
            return self._axes.head_mm(self._clock())

    @property
    def standing_mm(self) -> Place | None:
        """Where the head rests, counted from the switches; None while it moves."""
        with self._lock_out:
            self._update()
            return None if self._axes.planner.moving else self._axes.head_mm(self._clock())

    def receive(self, data: bytes) -> None:
        """Take bytes from the line."""
        with self._lock_out:
            for byte in data:
                if byte not in (10, 13):
                    self._line.append(byte)
                elif self._line:
                    self._pending.append(self._line.decode("ascii", errors="replace"))
                    self._line.clear()
            self._update()

    def transmit(self) -> bytes:
        """The bytes to send by now."""
        with self._lock_out:
            self._update()
            data = bytes(self._out)
            self._out.clear()
            return data

    def _update(self) -> None:
        now_s = self._clock()
        self._axes.planner.advance(now_s)
        if self._homing and not len(self._axes.planner):
            self._homing = False
            self._axes.stand_off()
            self._say("ok")
        while self._pending and not self._homing:
            text = clean(self._pending[0])
            if len(self._axes.planner) and text.startswith(("M400", "M3", "M5", "G28")):
                if now_s - self._spoke_s >= KEEPALIVE_S:
                    self._say("echo:busy: processing")
                return
            self._pending.popleft()
            self._execute(text, now_s)

    def _say(self, text: str) -> None:
        self._spoke_s = self._clock()
        self._out += text.encode("ascii") + b"\n"

    def _execute(self, text: str, now_s: float) -> None:
        if text.startswith("G28"):
            self._homing = True
            self._axes.seek_switches(now_s)
            return
        if text == "M115":
            self._say("FIRMWARE_NAME:Marlin 2.1.2 PROTOCOL_VERSION:1.0 MACHINE_TYPE:Track")
        elif text == "M114":
            x, y, z = self._axes.counted_mm(now_s)
            self._say(f"X:{x:.2f} Y:{y:.2f} Z:{z:.2f} E:0.00 Count X:{x * 80:.0f} Y:0 Z:0")
        elif text == "M410":
            self._axes.planner.halt(now_s)
        elif text != "M400":
            try:
                self._block(text, now_s)
            except GcodeError:
                self._say(f'echo:Unknown command: "{text}"')
        self._say("ok")

    def _block(self, text: str, now_s: float) -> None:
        block = parse_block(text)
        if "units" in block.codes:
            self._unit_mm = INCH_MM if block.codes["units"] == 20 else 1.0
        if "distance" in block.codes:
            self._absolute = block.codes["distance"] == 90
        if "F" in block.words:
            self._feed_mm_min = block.words["F"] * self._unit_mm
        if block.mcodes:
            self.laser_power = block.words.get("S", 0.0) if block.mcodes[0] == 3 else 0.0
        if block.axes:
            target_mm = list(self._axes.planned_mm(now_s))
            for letter, value in block.axes.items():
                start_mm = 0.0 if self._absolute else target_mm["XYZ".index(letter)]
                target_mm["XYZ".index(letter)] = start_mm + value * self._unit_mm
            self._axes.push(self._axes.on_steps(target_mm), self._feed_mm_min, now_s)
