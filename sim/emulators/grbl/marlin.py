"""An emulated controller that answers as Marlin does, as far as a track asks.

Source: Marlin's G-code reference, pages G0-G1, G20, G21, G28, G90, G91, M3, M5, M114, M115,
M400, M410, and its host keepalive.
"""

from sim.emulators.grbl.gcode import GcodeError, clean, parse_block
from sim.emulators.grbl.machine import EmulatedController
from sim.emulators.grbl.modes import Modes

KEEPALIVE_S = 2.0


class MarlinEmulator(EmulatedController):
    """A controller with Marlin."""

    def _power_up(self) -> None:
        self._modes = Modes(feed_mm_min=600.0)
        self._say("start", "echo:Marlin 2.1.2")

    def _update(self) -> None:
        self._last_s = self._clock()
        self._planner.advance(self._last_s)
        if self._homing and not len(self._planner):
            self._end_homing()
        self._process()

    def _take(self, byte: int) -> None:
        if byte not in (10, 13):
            self._line.append(byte)
        elif self._line:
            self._end_line()

    def _process(self) -> None:
        while self._pending and not self._homing:
            text = clean(self._pending[0])
            if len(self._planner) and text.startswith(("M400", "M3", "M5", "G28")):
                if self._last_s - self._spoke_s >= KEEPALIVE_S:
                    self._say("echo:busy: processing")
                return
            self._pending.popleft()
            self._execute(text)

    def _say(self, *lines: str) -> None:
        self._spoke_s = self._last_s
        super()._say(*lines)

    def _execute(self, text: str) -> None:
        if text.startswith("G28"):
            self._start_homing()
            return
        if text == "M115":
            self._say("FIRMWARE_NAME:Marlin 2.1.2 PROTOCOL_VERSION:1.0 MACHINE_TYPE:Track")
        elif text == "M114":
            x, y, z = self._axes.counted_mm(self._last_s)
            self._say(f"X:{x:.2f} Y:{y:.2f} Z:{z:.2f} E:0.00 Count X:{x * 80:.0f} Y:0 Z:0")
        elif text == "M410":
            self._planner.halt(self._last_s)
        elif text != "M400":
            try:
                block = parse_block(text)
                self._modes.take(block)
                if block.axes:
                    self._axes.push(self._target(block), self._modes.feed_mm_min, self._last_s)
            except GcodeError:
                self._say(f'echo:Unknown command: "{text}"')
        self._say("ok")
