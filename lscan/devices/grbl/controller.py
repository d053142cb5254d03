"""Grbl 1.1 as a machine: one axis, jogged in machine coordinates.

Motion is ``$J=G53``: a jog does not touch the controller's modal state, is refused as a whole
beyond the soft limits, and one byte cancels it without loss of position (Grbl 1.1 "Jogging").
"""

import secrets
from collections.abc import Callable
from typing import Final

from lscan.devices.api import Fact
from lscan.devices.grbl.dialogue import Dialogue
from lscan.devices.grbl.link import Link
from lscan.devices.grbl.machine import AxisTravel, agreed
from lscan.devices.grbl.options import SerialTrackOptions
from lscan.devices.grbl.protocol import AXES, Banner, Feedback, GrblSetting, StatusReport
from lscan.errors import DeviceError

FEED_HOLD: Final = b"!"
SOFT_RESET: Final = b"\x18"
JOG_CANCEL: Final = b"\x85"

POLL_S: Final = 0.02
INCH_MM: Final = 25.4

BRAKING_S: Final = 30.0
"""How long what another program moves may take to come to rest: from 300 mm/s at 10 mm/s²,
Grbl's default of $120."""

MARKS: Final = range(100, 256)
"""Tool numbers not used otherwise, up to Grbl's highest.  One of them, set by ``T``, marks a
controller: any restart and any reset, so also the way out of an alarm, sets it back to T0 (Grbl
1.1, ``$G``).  A restart whose banner was lost, which would take where the head stands for zero, is
so noticed, and also one between two sessions of a scan."""

MOVING: Final = {("Hold", 1), ("Door", 2), ("Door", 3)}
"""States, with their numbers, in which a reset would lose steps: a hold still slowing down, a door
that is doing so, retracting or resuming (Grbl 1.1, "Real-time Status Reports"); beside Jog and Run,
which other firmware numbers too."""

_REMEDIES = {
    "Door": "close the safety door and open the track again",
    "Hold": "the feed hold was pressed: release it and open the track again",
    "Sleep": "reset the controller and open the track again",
    "Check": "leave check mode ($C) and open the track again",
}


class GrblMachine:
    """The axis of a controller that runs Grbl 1.1."""

    def __init__(self, link: Link, options: SerialTrackOptions) -> None:
        self._link, self._options = link, options
        self._dialogue = Dialogue(link, options.answer_s)
        self._axis = AXES.index(options.axis)
        self._unit_mm = 1.0
        self._offset: float | None = None
        self._version = ""
        self._braking_s = BRAKING_S
        self._mark = f"T{secrets.choice(MARKS)}"
        self._zero = f"{self._mark} {secrets.token_hex(4)}"

    @property
    def zero(self) -> str:
        """The controller's mark, and a name for this opening where that has set it anew.

        "lost" after an alarm or a restart.
        """
        return "lost" if self._dialogue.lost else self._zero

    def has_kept(self, zero: str) -> bool:
        """Whether it is the same zero still: that of this opening, or the mark found at it."""
        return self.zero in (zero, zero.partition(" ")[0])

    def wake(self) -> AxisTravel:
        """What the settings say of the axis, after the banner; a soft reset asks for one."""
        self._await_banner()
        while self._dialogue.read(self._link.clock() + 0.05) is not None:  # what follows it
            pass
        status = self.status()
        if status.state not in ("Idle", "Alarm"):
            raise self._not_idle(status)
        settings = self._settings()
        self._dialogue.homes = bool(settings[22])
        if status.state == "Alarm" and not self._options.homing:
            raise self._not_idle(status)
        if not self._options.homing:
            self._dialogue.command(self._mark)  # else after homing: in alarm it would be refused
        self._unit_mm = INCH_MM if settings[13] else 1.0
        per_mm, max_mm_min, accel_mm_s2, travel_mm = (
            settings[base + self._axis] for base in (100, 110, 120, 130)
        )
        self._braking_s = self._options.answer_s + self._options.feed_mm_min / 60 / accel_mm_s2
        low_mm, high_mm = -float("inf"), float("inf")
        if settings[20]:
            upward = self._origin_at_switch() and int(settings[23]) >> self._axis & 1
            low_mm, high_mm = (0.0, travel_mm) if upward else (-travel_mm, 0.0)
        return AxisTravel(low_mm, high_mm, 1.0 / per_mm, max_mm_min, accel_mm_s2)

    def describe(self) -> dict[str, Fact]:
        """The version its banner stated, its state, and the inputs that are active (``Pn``)."""
        status = self.status()
        return {
            "firmware": f"Grbl {self._version}",
            "state": status.state,
            "active_inputs": status.pins or "none",
            "noise_bytes": self._link.noise_bytes,
        }

    def home(self) -> None:
        """Run ``$H``; it ends in an ok, in ALARM:6 to 9, or in silence."""
        first = "check for a jam on the way to the switch, "
        self._dialogue.command("$H", self._options.homing_s, first)
        self._dialogue.command(self._mark)

    def move(self, target_mm: float, feed_mm_min: float, within_s: float) -> None:
        """Jog to a machine coordinate and wait until idle; DeviceError if not within_s."""
        link, axis = self._link, self._options.axis
        self._dialogue.drain()
        deadline_s = link.clock() + within_s
        self._dialogue.command(f"$J=G21G90G53{axis}{target_mm:.3f}F{feed_mm_min:.1f}")
        while (status := self.status()).state != "Idle":
            if status.state not in ("Jog", "Run", "Hold"):
                raise self._not_idle(status)
            if link.clock() > deadline_s:
                hint = _REMEDIES.get(status.state, "check for a jam, the feed rate and $110")
                raise DeviceError(
                    f"{link.name}: still in state {status.state} {within_s:.1f} s after being "
                    f"sent to machine {target_mm:g} mm; {hint}"
                )
            link.sleep(POLL_S)

    def position_mm(self) -> float:
        """The axis's machine position at rest, two reports alike, of a controller still marked."""
        position_mm = agreed(self._resting_mm, "position", self._link.name)
        if self._mark not in self._modes():
            raise self._dialogue.restarted()
        return position_mm

    def laser(self, power: float) -> None:
        """M3 with S, or M5.  G1 goes before it: in laser mode ($32) G0 keeps the beam dark."""
        feed = self._options.feed_mm_min
        self._dialogue.command(f"G1F{feed:.1f}M3S{power:g}" if power > 0 else "M5")

    def stop(self) -> None:
        """Cancel a jog and wait until it has come to rest."""
        self._link.send_bytes(JOG_CANCEL)
        self._halt(self.status)

    def status(self) -> StatusReport:
        """A report asked for now, its lengths in the controller's unit."""
        status = self._dialogue.status()
        if status.offset is not None and len(status.offset) > self._axis:
            self._offset = status.offset[self._axis]
        return status

    def _resting_mm(self) -> float:
        """The position in one report; DeviceError where the machine is not idle."""
        for _ in range(64):  # work coordinates need their origin: in each 10th to 30th report
            status = self.status()
            if status.state != "Idle":
                raise self._not_idle(status)
            numbers = status.machine if status.machine is not None else status.work
            if numbers is None or len(numbers) <= self._axis:
                continue
            if status.machine is not None:
                return numbers[self._axis] * self._unit_mm
            if self._offset is not None:
                return (numbers[self._axis] + self._offset) * self._unit_mm
        raise DeviceError(
            f"{self._link.name}: reports no position of axis {self._options.axis} that can be "
            "turned into machine coordinates; set $10=1"
        )

    def _modes(self) -> list[str]:
        return agreed(self._dialogue.modes, "modes ($G)", self._link.name)

    def _await_banner(self) -> None:
        """Wait for the start message, after a soft reset where none comes.

        A reset in motion loses steps (ALARM:3), so what moves is stopped before it.  A mark that
        is found is kept: the controller has counted its steps since it was set.
        """
        link, options = self._link, self._options
        if self._has_banner(options.boot_s):
            return
        status = self._halt(self._dialogue.any_status)
        if status is not None and status.state == "Idle":
            found = next(filter(_is_mark, self._modes()), None)
            self._mark, self._zero = found or self._mark, found or self._zero
        link.send_bytes(SOFT_RESET)
        if self._has_banner(options.answer_s):
            return
        raise DeviceError(
            f"{link.name}: no Grbl banner within {options.boot_s + 2 * options.answer_s:g} s, not "
            "even after a soft reset; check the port, the baud rate, track.options.dialect "
            "('marlin' for a controller with Marlin) and the controller's power"
        )

    def _has_banner(self, within_s: float) -> bool:
        """Whether a banner comes; DeviceError where its version is none that is known."""
        deadline_s = self._link.clock() + within_s
        while (message := self._dialogue.read(deadline_s)) is not None:
            if isinstance(message, Banner):
                if not message.version.startswith("1.1"):
                    raise DeviceError(
                        f"{self._link.name}: runs Grbl {message.version}; needed: 1.1 or a "
                        "firmware that answers as Grbl 1.1 does"
                    )
                self._version = message.version
                return True
        return False

    def _halt(self, report: Callable[[], StatusReport | None]) -> StatusReport | None:
        """What it reports when all motion has been stopped without loss of position.

        report: asks for a report; where it gives None, so does this.
        """
        deadline_s = self._link.clock() + self._braking_s
        while (status := report()) is not None and _is_moving(status):
            if self._link.clock() > deadline_s:
                raise self._not_idle(status)
            self._link.send_bytes(JOG_CANCEL if status.state == "Jog" else FEED_HOLD)
            self._link.sleep(POLL_S)
        return status

    def _settings(self) -> dict[int, float]:
        """``$$`` as numbers by their number, complete and read twice alike."""
        needed = (13, 20, 22, 23, *(base + self._axis for base in (100, 110, 120, 130)))

        def read() -> dict[int, float]:
            said = self._dialogue.query("$$")
            return {s.number: s.value for s in said if isinstance(s, GrblSetting)}

        settings = agreed(read, "settings ($$)", self._link.name)
        if missing := [number for number in needed if number not in settings]:
            raise DeviceError(f"{self._link.name}: $$ does not name ${missing[0]}; needs Grbl 1.1")
        for number in needed:
            if number >= 100 and settings[number] <= 0:
                raise DeviceError(
                    f"{self._link.name}: ${number}={settings[number]:g}; it must be above 0"
                )
        return settings

    def _origin_at_switch(self) -> bool:
        """Whether homing sets the machine's zero at the switch: option Z of ``$I``."""
        answers = self._dialogue.query("$I")
        options = [a.text for a in answers if isinstance(a, Feedback) and a.kind == "OPT"]
        return any("Z" in text.partition(",")[0] for text in options)

    def _not_idle(self, status: StatusReport) -> DeviceError:
        remedy = _REMEDIES.get(status.state, "wait until it is at rest")
        if status.state == "Alarm":
            self._dialogue.lost = True
            remedy = self._dialogue.alarm_remedy()
        return DeviceError(f"{self._link.name}: is in state {status.state}; {remedy}")


def _is_moving(status: StatusReport) -> bool:
    return status.state in ("Jog", "Run") or (status.state, status.substate) in MOVING


def _is_mark(word: str) -> bool:
    return word[0] == "T" and word[1:].isdecimal() and int(word[1:]) in MARKS
