"""An emulated controller that answers as Marlin does, as far as a track asks.

Source: Marlin's G-code reference, pages G0-G1, G20, G21, G28, G90, G91, M3, M5, M114, M115,
M400, M410, its host keepalive, and what it was recorded to answer (docs/reference/drivers.md).
"""

from sim.emulators.grbl.gcode import GcodeError, clean, parse_block
from sim.emulators.grbl.machine import EmulatedController
from sim.emulators.grbl.modes import Modes

KEEPALIVE_S = 2.0
VERSION = "bugfix-2.1.x"


class MarlinEmulator(EmulatedController):
    """A controller with Marlin.  machine_type: as its firmware was configured."""

    machine_type = "Track"

    def _power_up(self) -> None:
        self._modes = Modes(feed_mm_min=600.0)
        self._say("start", f"Marlin {VERSION}")

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
            self._say(
                f"FIRMWARE_NAME:Marlin {VERSION} (Dec 19 2022 12:00:00) SOURCE_CODE_URL:github.com/"
                f"MarlinFirmware/Marlin PROTOCOL_VERSION:1.0 MACHINE_TYPE:{self.machine_type} "
                "EXTRUDER_COUNT:1 UUID:cede2a2f-41a2-4748-9b12-c55c62f367ff",
                "Cap:SERIAL_XON_XOFF:0",
            )
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
