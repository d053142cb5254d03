"""Grbl 1.1 as a machine: one axis, jogged in machine coordinates.

Motion is ``$J=G53``: a jog does not touch the controller's modal state, is refused as a whole
beyond the soft limits, and one byte cancels it without loss of position (Grbl 1.1 "Jogging").
Every line is answered before the next is sent.
"""

from __future__ import annotations

from typing import Final, TypeGuard

from lscan.devices.api import Fact
from lscan.devices.grbl.codes import alarm_in_words, error_in_words
from lscan.devices.grbl.link import Link
from lscan.devices.grbl.machine import Travel, agreed
from lscan.devices.grbl.options import SerialTrackOptions
from lscan.devices.grbl.protocol import (
    AXES,
    Alarm,
    Banner,
    Feedback,
    Message,
    Ok,
    Refusal,
    Setting,
    Status,
    parse_line,
)
from lscan.errors import DeviceError

STATUS: Final = b"?"
FEED_HOLD: Final = b"!"
CYCLE_START: Final = b"~"
SOFT_RESET: Final = b"\x18"
JOG_CANCEL: Final = b"\x85"

ASK_AGAIN_S: Final = 0.25  # a report comes within 20 ms, but Grbl may drop a question
POLL_S: Final = 0.02
INCH_MM: Final = 25.4

MARK: Final = "T77"
"""A tool number nobody uses: any restart sets it back to T0 (Grbl 1.1, ``$G``), so that one
whose banner was lost, which would take where the head stands for zero, is noticed."""

_REMEDIES = {
    "Alarm": "clear the way, then home ($H, or homing = true) before the next scan",
    "Door": "close the safety door and open the track again",
    "Hold": "the feed hold was pressed: release it and open the track again",
    "Sleep": "reset the controller and open the track again",
    "Check": "leave check mode ($C) and open the track again",
}


class GrblMachine:
    """The axis of a controller that runs Grbl 1.1."""

    def __init__(self, link: Link, options: SerialTrackOptions) -> None:
        self._link, self._options = link, options
        self._axis = AXES.index(options.axis)
        self._unit_mm = 1.0
        self._offset: float | None = None
        self._version = ""

    def wake(self) -> Travel:
        """What the settings say of the axis, after the banner; a soft reset asks for one."""
        self._await_banner()
        settings = self._settings()
        if not self._options.homing:
            self._command(MARK)  # else after homing: in alarm it would be refused
        self._unit_mm = INCH_MM if settings[13] else 1.0
        per_mm, max_mm_min, accel_mm_s2, travel_mm = (
            settings[base + self._axis] for base in (100, 110, 120, 130)
        )
        low_mm, high_mm = -float("inf"), float("inf")
        if settings[20]:
            upward = self._origin_at_switch() and int(settings[23]) >> self._axis & 1
            low_mm, high_mm = (0.0, travel_mm) if upward else (-travel_mm, 0.0)
        return Travel(low_mm, high_mm, 1.0 / per_mm, max_mm_min, accel_mm_s2)

    def describe(self) -> dict[str, Fact]:
        """The version its banner told, its state, and the inputs that are active (``Pn``)."""
        status = self.status()
        return {
            "firmware": f"Grbl {self._version}",
            "state": status.state,
            "active_inputs": status.pins or "none",
            "noise_bytes": self._link.noise_bytes,
        }

    def home(self) -> None:
        """Run ``$H``; it ends in an ok, in ALARM:6 to 9, or in silence."""
        self._command("$H", self._options.homing_s, "check for a jam on the way to the switch, ")
        self._command(MARK)

    def move(self, target_mm: float, feed_mm_min: float, within_s: float) -> None:
        """Jog to a machine coordinate and wait until idle; DeviceError if not within_s."""
        link = self._link
        self._drain()
        deadline_s = link.clock() + within_s
        self._command(f"$J=G21G90G53{self._options.axis}{target_mm:.3f}F{feed_mm_min:.1f}")
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
        if MARK not in agreed(self._modes, "modes ($G)", self._link.name).split():
            raise self._restarted()
        return position_mm

    def laser(self, power: float) -> None:
        """M3 with S, or M5.  G1 goes before it: in laser mode ($32) G0 keeps the beam dark."""
        feed = self._options.feed_mm_min
        self._command(f"G1F{feed:.1f}M3S{power:g}" if power > 0 else "M5")

    def hold(self) -> None:
        """Send the feed hold; a jog ends by it, at rest and without loss of position."""
        self._link.send_bytes(FEED_HOLD)

    def resume(self) -> None:
        """Send the cycle start, which ends a feed hold."""
        self._link.send_bytes(CYCLE_START)

    def stop(self) -> None:
        """Cancel a jog and wait until idle."""
        self._link.send_bytes(JOG_CANCEL)
        deadline_s = self._link.clock() + self._options.answer_s
        while (status := self.status()).state in ("Jog", "Run", "Hold"):
            if self._link.clock() > deadline_s:
                raise self._not_idle(status)
            self._link.sleep(POLL_S)

    def close(self) -> None:
        """Release the line."""
        self._link.close()

    def status(self) -> Status:
        """A report asked for now, its lengths in the controller's unit."""
        link, end_s = self._link, self._link.clock() + self._options.answer_s
        while link.clock() < end_s:
            link.send_bytes(STATUS)
            ask_again_s = min(end_s, link.clock() + ASK_AGAIN_S)
            while (message := self._next(ask_again_s)) is not None:
                if isinstance(message, Status):
                    self._remember_offset(message)
                    return message
        raise self._silent("a status report")

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

    def _modes(self) -> str:
        answers = self._command("$G")
        return " ".join(a.text for a in answers if isinstance(a, Feedback) and a.kind == "GC")

    def _remember_offset(self, status: Status) -> None:
        if status.offset is not None and len(status.offset) > self._axis:
            self._offset = status.offset[self._axis]

    def _await_banner(self) -> None:
        """Wait for the start message; where none comes, or the start is old, reset softly."""
        link, options = self._link, self._options
        for wait_s in (options.boot_s, options.answer_s):
            deadline_s = link.clock() + wait_s
            while (message := self._read(deadline_s)) is not None:
                if not isinstance(message, Banner):
                    continue
                if not message.version.startswith("1.1"):
                    raise DeviceError(
                        f"{link.name}: runs Grbl {message.version}; needed: 1.1 or a firmware "
                        "that answers as Grbl 1.1 does"
                    )
                self._version = message.version
                self._greet()
                return
            link.send_bytes(SOFT_RESET)
        raise DeviceError(
            f"{link.name}: no Grbl banner within {options.boot_s + options.answer_s:g} s, not "
            "even after a soft reset; check the port, the baud rate, track.options.dialect "
            "('marlin' for a controller with Marlin) and the controller's power"
        )

    def _greet(self) -> None:
        """Read what follows the banner, and see whether the machine may move."""
        while self._read(self._link.clock() + 0.05) is not None:
            pass
        status = self.status()
        if status.state == "Alarm" and self._options.homing:
            return
        if status.state != "Idle":
            raise self._not_idle(status)

    def _settings(self) -> dict[int, float]:
        """``$$`` as numbers by their number, complete and read twice alike."""
        needed = {13, 20, 23, *(base + self._axis for base in (100, 110, 120, 130))}

        def read() -> dict[int, float]:
            answers = self._command("$$")
            return {answer.number: answer.value for answer in answers if _is_setting(answer)}

        settings = agreed(read, "settings ($$)", self._link.name)
        if missing := sorted(needed - settings.keys()):
            raise DeviceError(f"{self._link.name}: $$ does not name ${missing[0]}; needs Grbl 1.1")
        for number in (100 + self._axis, 110 + self._axis, 120 + self._axis, 130 + self._axis):
            if settings[number] <= 0:
                raise DeviceError(
                    f"{self._link.name}: ${number}={settings[number]:g}; it must be above 0"
                )
        return settings

    def _origin_at_switch(self) -> bool:
        """Whether homing sets the machine's zero at the switch: option Z of ``$I``."""
        answers = self._command("$I")
        options = [a.text for a in answers if isinstance(a, Feedback) and a.kind == "OPT"]
        return any("Z" in text.partition(",")[0] for text in options)

    def _command(self, text: str, within_s: float | None = None, first: str = "") -> list[Message]:
        """Send a line; what was said until its ok.  DeviceError if refused or unanswered.

        first: what to look at first where no answer comes.
        """
        link = self._link
        answers: list[Message] = []
        self._drain()
        deadline_s = link.clock() + (self._options.answer_s if within_s is None else within_s)
        link.send(text)
        while (message := self._next(deadline_s)) is not None:
            if isinstance(message, Ok):
                return answers
            if isinstance(message, Refusal):
                raise DeviceError(
                    f"{link.name}: refuses {text!r}: {error_in_words(message.code)}; where the "
                    "command is right, a noisy line garbled it: check the cable"
                )
            answers.append(message)
        raise self._silent(f"an answer to {text!r}", first)

    def _drain(self) -> None:
        """Read what has come unasked, so that no old ok answers a new line."""
        while self._next(self._link.clock()) is not None:
            pass

    def _next(self, deadline_s: float) -> Message | None:
        """The next message; DeviceError where it says that the position can no longer be held."""
        message = self._read(deadline_s)
        if isinstance(message, Alarm):
            raise DeviceError(
                f"{self._link.name}: {alarm_in_words(message.code)}; {_REMEDIES['Alarm']}"
            )
        if isinstance(message, Banner):
            raise self._restarted()
        return message

    def _read(self, deadline_s: float) -> Message | None:
        while (text := self._link.line(deadline_s)) is not None:
            if (message := parse_line(text)) is not None:
                return message
            self._link.skip(text)
        return None

    def _restarted(self) -> DeviceError:
        return DeviceError(
            f"{self._link.name}: the controller has restarted, so its position is lost; check "
            "its power and the USB cable, home, and open the track again"
        )

    def _silent(self, what: str, first: str = "") -> DeviceError:
        return DeviceError(
            f"{self._link.name}: silent: {what} did not come in time "
            f"({self._link.noise_bytes} bytes of noise so far); {first}check cable and power, then "
            "open the track again"
        )

    def _not_idle(self, status: Status) -> DeviceError:
        remedy = _REMEDIES.get(status.state, "wait until it is at rest")
        return DeviceError(f"{self._link.name}: is in state {status.state}; {remedy}")


def _is_setting(message: Message) -> TypeGuard[Setting]:
    return isinstance(message, Setting)
