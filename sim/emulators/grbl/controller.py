"""The emulated controller: Grbl 1.1's states, answers and three axes, or those of its relatives.

Source: Grbl 1.1 documentation, "Interface Basics", "Commands" and "Jogging", and what firmware
was recorded to answer (docs/reference/drivers.md).  Left out: arcs, probing, coolant, start-up
lines, overrides (their bytes are taken and ignored), check mode, sleep, door; homing goes to the
switches at once and stands off by $27.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from sim.emulators.grbl import protocol
from sim.emulators.grbl.machine import NO_FAULTS, EmulatedController, Faults, with_garbled_bytes

HELP = "[HLP:$$ $# $G $I $N $x=val $Nx=line $J=line $SLP $C $X $H ~ ! ? ctrl-x]"
PLANNED = 15  # blocks the planner holds


class GrblEmulator(EmulatedController):
    """A controller with Grbl or one of its relatives, and what goes wrong with it."""

    line_end = b"\r\n"

    _faults, _generator = NO_FAULTS, np.random.default_rng(0)

    def __init__(
        self, *machine: Any, firmware: protocol.Firmware = protocol.GRBL, **more: Any
    ) -> None:
        """Switch it on.

        Parameters
        ----------
        machine, more
            As of any emulated controller.
        firmware : Firmware
            What it runs.
        """
        self.firmware = firmware
        super().__init__(*machine, **more)

    @property
    def state(self) -> str:
        """The state as a status report says it."""
        with self._lock_out:
            self._update()
            return self._state()

    def _state(self) -> str:
        if self._alarm:
            return "Alarm"
        if self._homing:
            return "Home"
        if self._planner.jogging:
            return "Jog"  # also while it brakes: a jog is cancelled, not held
        if self._held:
            return "Hold:1" if self._planner.moving else "Hold:0"
        if len(self._planner):
            return "Run"
        return "Idle"

    def inject(self, faults: Faults) -> None:
        """Let these faults act, instead of those injected before.

        Parameters
        ----------
        faults : Faults, they act from their ``begin_s`` on
        """
        self._faults = faults
        self._generator = np.random.default_rng(faults.seed)

    def power_cycle(self) -> None:
        """Switch off and on: all is forgotten, and where the head stands becomes zero."""
        self._axes.forget(self._last_s)
        self._power_up()

    # ---- faults -------------------------------------------------------------------------

    @property
    def _acting(self) -> Faults:
        """The faults that act by now."""
        return self._faults if self._last_s >= self._faults.begin_s else NO_FAULTS

    def _on_line(self, data: bytes) -> bytes:
        faults = self._acting
        if faults.unplug:
            raise OSError("the device is gone")
        return with_garbled_bytes(data, faults.garble, self._generator)

    def transmit(self) -> bytes:
        """The bytes to send by now; OSError while the line is unplugged."""
        data = super().transmit()
        return b"" if self._acting.silent else data

    def _say(self, *lines: str) -> None:
        if lines == ("ok",) and self._acting.lose_oks > 0:
            self._faults = replace(self._faults, lose_oks=self._faults.lose_oks - 1)
        else:
            super()._say(*lines)

    def _let_faults_act(self, since_s: float) -> None:
        """Faults of the machine, ``since_s`` being when they were looked at last."""
        faults = self._acting
        if self._planner.moving:
            lost = 1.0 if faults.stuck else 1.0 - 1.0 / faults.slow
            self._planner.hold_still(lost * (self._last_s - max(since_s, faults.begin_s)))
        self._planner.advance(self._last_s)
        if faults.alarm and self._planner.moving:
            self._faults = replace(self._faults, alarm=False)
            self._lock(1)
        if faults.restart:
            self._faults = replace(self._faults, restart=False)
            self.power_cycle()
            if faults.quietly:
                self._out.clear()

    # ---- states -------------------------------------------------------------------------

    def _power_up(self) -> None:
        self._alarm, self._modes = bool(self.settings[22]), protocol.Modes(firmware=self.firmware)
        self._start()

    def _start(self) -> None:
        """Begin anew, as after a reset: motion forgotten, alarm kept."""
        self._homing = self._held = self._suspended = False
        self._critical = 0
        self._modes = self._modes.after_reset()
        self._reports = 0
        self._pending.clear()
        self._line.clear()
        self._say("", self.firmware.banner)
        if self._alarm:
            self._say("[MSG:'$H'|'$X' to unlock]")

    def _reset(self) -> None:
        homing = self._homing
        if self._planner.halt(self._last_s):
            self._alarm = True
            self._say("ALARM:6" if homing else "ALARM:3")
        if self._critical == 2:
            self._say("ok")  # of the line whose target lay beyond the soft limits
        self._start()

    def _lock(self, code: int) -> None:
        """A critical alarm: everything stops, the spindle too, and only a reset is heard."""
        self._planner.halt(self._last_s)
        self._modes.spindle = 5
        self._alarm, self._critical = True, code
        self._held = self._homing = False
        self._say(f"ALARM:{code}", "[MSG:Reset to continue]")

    def _update(self) -> None:
        before_s, self._last_s = self._last_s, self._clock()
        self._let_faults_act(before_s)
        if self._homing and not self._planner.moving:
            self._end_homing()
        if self._held and self._planner.jogging and not self._planner.moving:
            self._planner.flush()  # a hold ends a jog
            self._held = False
        self._process()

    # ---- bytes and lines ----------------------------------------------------------------

    def _take(self, byte: int) -> None:
        if byte == 0x18:
            self._reset()
        elif self._critical:
            return
        elif byte == ord("?"):
            if not self._homing:
                self._report()
        elif byte == 0x85 and self._planner.jogging and self._acting.late_cancel:
            self._suspended = True
        elif byte == ord("!") or (byte == 0x85 and self._planner.jogging):
            if not self._homing and not self._alarm:
                self._planner.brake(self._last_s)
                self._held = True
        elif byte == ord("~"):
            if not self._planner.moving:
                self._held = self._suspended = False
                self._planner.resume(self._last_s)
        elif byte in (10, 13):
            self._end_line()
        elif byte != ord(" ") and byte < 0x80 and len(self._line) <= protocol.LONGEST:
            self._line.append(byte)

    def _process(self) -> None:
        while self._pending and not (
            self._critical or self._homing or self._held or self._suspended
        ):
            text = protocol.clean(self._pending[0])
            waits = "M" in text and not self._planner.jogging  # then it is refused
            if len(self._planner) >= PLANNED or (len(self._planner) and waits):
                return
            self._pending.popleft()
            try:
                if len(text) > protocol.LONGEST:
                    raise protocol.GcodeError(11)
                self._command(text[1:]) if text.startswith("$") else self._execute(text)
            except protocol.GcodeError as error:
                self._say(f"error:{error.code}")
                continue
            if not self._critical and not self._homing:
                self._say("ok")

    def _report(self) -> None:
        """Answer ``?``: the offset in the first and then each tenth report, Ov in the next."""
        unit = 1 / protocol.INCH_MM if self.settings[13] else 1.0
        place_mm = np.array(self._axes.counted_mm(self._last_s))
        if int(self.settings[10]) & 1:
            position = f"MPos:{protocol.coordinates(place_mm, unit)}"
        else:
            position = f"WPos:{protocol.coordinates(place_mm - self._modes.offset_mm, unit)}"
        feed = self._planner.speed_mm_s(self._last_s) * 60 * unit
        fields = [self._state(), position]
        if int(self.settings[10]) & 2:
            fields.append(f"Bf:{PLANNED - len(self._planner)},{128 - len(self._line)}")
        fields.append(f"FS:{feed:.0f},{self.laser_power:.0f}")
        if self._reports % 10 == 0:
            fields.append(f"WCO:{protocol.coordinates(self._modes.offset_mm, unit)}")
        elif self._reports % 10 == 1:
            fields.append("Ov:100,100,100")
        self._reports += 1
        self._say(f"<{'|'.join(fields)}>")

    # ---- $ commands ---------------------------------------------------------------------

    def _command(self, text: str) -> None:
        if text == "":
            self._say(HELP)
        elif text.startswith("J"):
            self._jog(text)
        elif text == "#":
            self._parameters()
        elif text == "G":
            self._say(self._modes.words(bool(self.settings[13])))
        elif text not in ("$", "I", "X", "H") and "=" not in text:
            raise protocol.GcodeError(3)
        elif self._state() not in ("Idle", "Alarm"):
            raise protocol.GcodeError(8)
        elif text == "$":
            self._say(*protocol.setting_lines(self.settings, self.firmware.silent_settings))
        elif text == "I":
            self._say("[VER:1.1h.20190830:]", "[OPT:V,15,128]")
        elif text == "X":
            if self._alarm:
                self._alarm = False
                self._say("[MSG:Caution: Unlocked]")
        elif text == "H":
            if not self.settings[22]:
                raise protocol.GcodeError(5)
            self._alarm = False
            self._start_homing()
        else:
            protocol.change_setting(self.settings, *text.split("=", 1))

    def _parameters(self) -> None:
        for name in ("G54", "G55", "G56", "G57", "G58", "G59", "G28", "G30"):
            self._say(f"[{name}:0.000,0.000,0.000]")
        offset = protocol.coordinates(self._modes.offset_mm)
        self._say(f"[G92:{offset}]", "[TLO:0.000]", "[PRB:0.000,0.000,0.000:0]")

    # ---- G-code -------------------------------------------------------------------------

    def _jog(self, text: str) -> None:
        if not text.startswith("J="):
            raise protocol.GcodeError(16)
        if self._state() not in ("Idle", "Jog"):
            raise protocol.GcodeError(8)
        block = protocol.parse_block(text[2:])
        allowed = block.codes.keys() <= {"units", "distance", "once"}
        if not allowed or block.codes.get("once", 53) != 53 or {"S", "T"} & block.words.keys():
            raise protocol.GcodeError(16)
        if not block.axes:
            raise protocol.GcodeError(26)
        if not block.words.get("F"):
            raise protocol.GcodeError(22)
        target_mm = self._target(block)
        if self._axes.is_beyond(target_mm):
            raise protocol.GcodeError(15)
        self._axes.push(target_mm, self._modes.feed_of(block), self._last_s, jog=True)

    def _execute(self, text: str) -> None:
        """Check the whole block, then let it act: nothing of a refused block is done."""
        if text == "":
            return
        if self._alarm or self._state() == "Jog":
            raise protocol.GcodeError(9)
        block = protocol.parse_block(text)
        self._modes.take(block)
        if block.codes.get("once") == 92:
            self._modes.shift(block, self._planner.planned_mm(self._last_s))
            self._reports = 0
        elif block.axes:
            target_mm = self._target(block)
            if self._axes.is_beyond(target_mm):
                self._lock(2)
            else:
                self._axes.push(target_mm, self._modes.rate_mm_min, self._last_s)


# An emulated controller that answers as Marlin does, as far as a track asks.
#
# Source: Marlin's G-code reference, pages G0-G1, G20, G21, G28, G90, G91, M3, M5, M114, M115, M400,
# M410, its host keepalive, and what it was recorded to answer (docs/reference/drivers.md).


KEEPALIVE_S = 2.0
VERSION = "bugfix-2.1.x"


class MarlinEmulator(EmulatedController):
    """A controller with Marlin.  machine_type: as its firmware was configured."""

    machine_type = "Track"

    def _power_up(self) -> None:
        self._modes = protocol.Modes(feed_mm_min=600.0)
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
            text = protocol.clean(self._pending[0])
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
                block = protocol.parse_block(text)
                self._modes.take(block)
                if block.axes:
                    self._axes.push(self._target(block), self._modes.feed_mm_min, self._last_s)
            except protocol.GcodeError:
                self._say(f'echo:Unknown command: "{text}"')
        self._say("ok")
