"""The emulated controller: Grbl 1.1's states, answers and three axes.

Source: Grbl 1.1 documentation, "Interface Basics", "Commands" and "Jogging".  Left out: arcs,
probing, coolant, start-up lines, overrides (their bytes are taken and ignored), check mode,
sleep, door; homing goes to the switches at once and stands off by $27.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from sim.emulators.grbl.axes import Axes
from sim.emulators.grbl.faults import Faults, garbled
from sim.emulators.grbl.gcode import LONGEST, Block, GcodeError, clean, parse_block
from sim.emulators.grbl.modes import INCH_MM, Modes
from sim.emulators.grbl.motion import Place

BANNER = "Grbl 1.1h ['$' for help]"
PLANNED = 15  # blocks the planner holds

DEFAULTS: Mapping[int, float] = {
    **{0: 10, 1: 25, 2: 0, 3: 0, 4: 0, 5: 0, 6: 0, 10: 1, 11: 0.01, 12: 0.002, 13: 0},
    **{20: 1, 21: 0, 22: 1, 23: 0, 24: 25, 25: 500, 26: 250, 27: 1, 30: 1000, 31: 0, 32: 0},
    **{100: 250, 101: 250, 102: 250, 110: 3000, 111: 3000, 112: 3000},
    **{120: 200, 121: 200, 122: 200, 130: 200, 131: 200, 132: 200},
}
_WHOLE = frozenset(range(7)) | {10, 13, 20, 21, 22, 23, 26, 30, 31, 32}


class GrblEmulator:
    """A controller with its machine: bytes in by ``receive``, bytes out by ``transmit``.

    settings: ``$`` settings that differ from DEFAULTS.  head_mm: where the head is at power-up,
    counted from the switches, of which each axis has one at 0 and its travel below.
    clock: seconds.  Machine coordinates are zero where the head stands at power-up, and agree
    with head_mm after homing.
    """

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
        self.inject(Faults())
        self._power_up()

    # ---- the world's side ---------------------------------------------------------------

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
        return self._modes.speed if self._modes.spindle else 0.0

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
        """Let these faults act, instead of those injected before."""
        self._faults = faults
        self._generator = np.random.default_rng(faults.seed)

    def power_cycle(self) -> None:
        """Switch off and on: all is forgotten, and where the head stands becomes zero."""
        self._axes.forget(self._last_s)
        self._power_up()

    # ---- the line's side ----------------------------------------------------------------

    def receive(self, data: bytes) -> None:
        """Take bytes from the line; OSError while it is unplugged."""
        with self._lock_out:
            self._update()
            self._check_plug()
            if self._acting:
                data = garbled(data, self._faults.garble, self._generator)
            for byte in data:
                self._take(byte)
            self._process()

    def transmit(self) -> bytes:
        """The bytes to send by now; OSError while the line is unplugged."""
        with self._lock_out:
            self._update()
            self._check_plug()
            data, faults = bytes(self._out), self._faults
            self._out.clear()
            if not self._acting:
                return data
            return b"" if faults.silent else garbled(data, faults.garble, self._generator)

    # ---- states -------------------------------------------------------------------------

    @property
    def _acting(self) -> bool:
        return self._last_s >= self._faults.begin_s

    def _check_plug(self) -> None:
        if self._acting and self._faults.unplug:
            raise OSError("the device is gone")

    def _power_up(self) -> None:
        self._alarm = bool(self.settings[22])
        self._start()

    def _start(self) -> None:
        """Begin anew, as after a reset: motion forgotten, alarm kept."""
        self._homing = self._held = self._critical = False
        self._modes = Modes()
        self._reports = 0
        self._pending.clear()
        self._line.clear()
        self._say("")
        self._say(BANNER)
        if self._alarm:
            self._say("[MSG:'$H'|'$X' to unlock]")

    def _reset(self) -> None:
        homing = self._homing
        if self._planner.halt(self._last_s):
            self._alarm = True
            self._say("ALARM:6" if homing else "ALARM:3")
        self._start()

    def _lock(self, code: int) -> None:
        """A critical alarm: everything stops, and only a reset is heard."""
        self._planner.halt(self._last_s)
        self._alarm = self._critical = True
        self._held = self._homing = False
        self._say(f"ALARM:{code}")
        self._say("[MSG:Reset to continue]")

    def _update(self) -> None:
        """Bring the machine to the present time."""
        now_s, before_s = self._clock(), self._last_s
        faults, self._last_s = self._faults, now_s
        if self._acting and self._planner.moving:
            lost = 1.0 if faults.stuck else 1.0 - 1.0 / faults.slow
            self._planner.hold_still(lost * (now_s - max(before_s, faults.begin_s)))
        self._planner.advance(now_s)
        if self._acting and faults.alarm and self._planner.moving:
            self._faults = replace(faults, alarm=False)
            self._lock(1)
        if self._acting and faults.restart:
            self._faults = replace(faults, restart=False)
            self.power_cycle()
            if faults.quietly:
                self._out.clear()
        if self._homing and not self._planner.moving:
            self._end_homing()
        if self._held and self._planner.jogging and not self._planner.moving:
            self._planner.flush()  # a hold ends a jog
            self._held = False
        self._process()

    # ---- bytes and lines ----------------------------------------------------------------

    def _say(self, text: str) -> None:
        if text == "ok" and self._acting and self._faults.lose_oks > 0:
            self._faults = replace(self._faults, lose_oks=self._faults.lose_oks - 1)
            return
        self._out += text.encode("ascii") + b"\r\n"

    def _take(self, byte: int) -> None:
        if byte == 0x18:
            self._reset()
        elif self._critical:
            return
        elif byte == ord("?"):
            if not self._homing:
                self._report()
        elif byte == ord("!") or (byte == 0x85 and self._planner.jogging):
            if not self._homing and not self._alarm:
                self._planner.brake(self._last_s)
                self._held = True
        elif byte == ord("~"):
            if self._held and not self._planner.moving:
                self._held = False
                self._planner.resume(self._last_s)
        elif byte in (10, 13):
            self._pending.append(self._line.decode("ascii", errors="replace"))
            self._line.clear()
        elif byte != ord(" ") and byte < 0x80 and len(self._line) <= LONGEST:
            self._line.append(byte)

    def _process(self) -> None:
        """Execute the lines that need not wait, and answer them."""
        while self._pending and not self._critical and not self._homing and not self._held:
            text = clean(self._pending[0])
            if len(self._planner) >= PLANNED or (len(self._planner) and "M" in text):
                return
            self._pending.popleft()
            try:
                if len(text) > LONGEST:
                    raise GcodeError(11)
                self._command(text[1:]) if text.startswith("$") else self._execute(text)
            except GcodeError as error:
                self._say(f"error:{error.code}")
                continue
            if not self._critical and not self._homing:
                self._say("ok")

    def _report(self) -> None:
        """Answer ``?``: the offset in the first and then each tenth report, Ov in the next."""
        unit = 1 / INCH_MM if self.settings[13] else 1.0
        place_mm: Place | list[float] = self._axes.counted_mm(self._last_s)
        machine = bool(int(self.settings[10]) & 1)
        if not machine:
            place_mm = [mm - zero for mm, zero in zip(place_mm, self._modes.offset_mm, strict=True)]
        feed = self._planner.speed_mm_s(self._last_s) * 60 * unit
        fields = [self._state(), f"{'MPos' if machine else 'WPos'}:{_triple(place_mm, unit)}"]
        if int(self.settings[10]) & 2:
            fields.append(f"Bf:{PLANNED - len(self._planner)},{128 - len(self._line)}")
        fields.append(f"FS:{feed:.0f},{self.laser_power:.0f}")
        if self._reports % 10 == 0:
            fields.append(f"WCO:{_triple(self._modes.offset_mm, unit)}")
        elif self._reports % 10 == 1:
            fields.append("Ov:100,100,100")
        self._reports += 1
        self._say(f"<{'|'.join(fields)}>")

    # ---- $ commands ---------------------------------------------------------------------

    def _command(self, text: str) -> None:
        resting = self._state() in ("Idle", "Alarm")
        if text == "":
            self._say("[HLP:$$ $# $G $I $N $x=val $Nx=line $J=line $SLP $C $X $H ~ ! ? ctrl-x]")
        elif text.startswith("J"):
            self._jog(text)
        elif text == "#":
            self._parameters()
        elif text == "G":
            self._say(self._modes.words())
        elif text not in ("$", "I", "X", "H") and "=" not in text:
            raise GcodeError(3)
        elif not resting:
            raise GcodeError(8)
        elif text == "$":
            for number in sorted(self.settings):
                self._say(f"${number}={_setting(number, self.settings[number])}")
        elif text == "I":
            self._say("[VER:1.1h.20190830:]")
            self._say("[OPT:V,15,128]")
        elif text == "X":
            if self._alarm:
                self._alarm = False
                self._say("[MSG:Caution: Unlocked]")
        elif text == "H":
            self._home()
        else:
            self._set(*text.split("=", 1))

    def _set(self, name: str, text: str) -> None:
        if not name.isdecimal() or int(name) not in self.settings:
            raise GcodeError(3)
        try:
            value = float(text)
        except ValueError:
            raise GcodeError(2) from None
        if value < 0:
            raise GcodeError(4)
        if int(name) == 20 and value and not self.settings[22]:
            raise GcodeError(10)
        self.settings[int(name)] = value

    def _parameters(self) -> None:
        for name in ("G54", "G55", "G56", "G57", "G58", "G59", "G28", "G30"):
            self._say(f"[{name}:0.000,0.000,0.000]")
        self._say(f"[G92:{_triple(self._modes.offset_mm)}]")
        self._say("[TLO:0.000]")
        self._say("[PRB:0.000,0.000,0.000:0]")

    def _home(self) -> None:
        """Begin to search the switches: each at 0, or at the travel's far end by mask $23."""
        if not self.settings[22]:
            raise GcodeError(5)
        self._alarm, self._homing = False, True
        self._axes.seek_switches(self._last_s)

    def _end_homing(self) -> None:
        self._homing = False
        self._axes.stand_off()
        self._say("ok")

    # ---- G-code -------------------------------------------------------------------------

    def _jog(self, text: str) -> None:
        if not text.startswith("J="):
            raise GcodeError(16)
        if self._state() not in ("Idle", "Jog"):
            raise GcodeError(8)
        block = parse_block(text[2:])
        if block.mcodes or {"motion", "plane", "coordinates", "feed mode"} & block.codes.keys():
            raise GcodeError(16)
        if block.codes.get("once", 53) != 53 or {"S", "T"} & block.words.keys():
            raise GcodeError(16)
        if not block.axes:
            raise GcodeError(26)
        if not block.words.get("F"):
            raise GcodeError(22)
        target_mm = self._target(block)
        if self._axes.beyond(target_mm):
            raise GcodeError(15)
        self._axes.push(target_mm, self._modes.feed_of(block), self._last_s, jog=True)

    def _execute(self, text: str) -> None:
        """Check the whole block, then let it act: nothing of a refused block is done."""
        if text == "":
            return
        if self._alarm or self._state() == "Jog":
            raise GcodeError(9)
        block = parse_block(text)
        self._modes.take(block)
        if block.codes.get("once") == 92:
            self._modes.shift(block, self._axes.planned_mm(self._last_s))
            self._reports = 0
        elif block.axes:
            self._feed_to(self._target(block))

    def _feed_to(self, target_mm: Place) -> None:
        if self._axes.beyond(target_mm):
            self._lock(2)
        else:
            self._axes.push(target_mm, self._modes.rate_mm_min, self._last_s)

    def _target(self, block: Block) -> Place:
        """The block's target in machine coordinates, on whole motor steps."""
        start_mm = self._axes.planned_mm(self._last_s)
        return self._axes.on_steps(self._modes.target_mm(block, start_mm))


def _triple(numbers: Place | list[float], unit: float = 1.0) -> str:
    """Three coordinates as Grbl writes them, without a minus before zero."""
    return ",".join(f"{round(number * unit, 3) + 0.0:.3f}" for number in numbers)


def _setting(number: int, value: float) -> str:
    return f"{value:.0f}" if number in _WHOLE else f"{value:.3f}"
