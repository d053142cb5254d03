"""Grbl 1.1, and firmware that answers as it does, as a machine: one axis, jogged.

Motion is ``$J=G53``: a jog does not touch the controller's modal state, is refused as a whole
beyond the soft limits, and one byte cancels it without loss of position (Grbl 1.1 "Jogging").
What each firmware answers is recorded in docs/reference/drivers.md.
"""

import logging
import re
import secrets
from collections.abc import Callable
from contextlib import suppress
from typing import Final

from lscan.devices.api import Fact
from lscan.devices.grbl.dialogue import (
    ASK_AGAIN_S,
    AXES,
    Banner,
    Dialogue,
    Feedback,
    GrblSetting,
    StatusReport,
)
from lscan.devices.grbl.machine import (
    AxisTravel,
    Link,
    Restarted,
    SerialTrackOptions,
    Unanswered,
    agreed_reading,
    ask_again,
)
from lscan.errors import DeviceError

_log = logging.getLogger(__name__)

FEED_HOLD: Final = b"!"
CYCLE_START: Final = b"~"
SOFT_RESET: Final = b"\x18"
JOG_CANCEL: Final = b"\x85"

POLL_S: Final = 0.02
INCH_MM: Final = 25.4

BRAKING_S: Final = 30.0
"""How long what another program moves may take to come to rest: from 300 mm/s at 10 mm/s²,
Grbl's default of $120."""

START_AGAIN_S: Final = 0.5
"""How long after its banner a board may start once more, as some do when their port is opened."""

MOVE_OFF_S: Final = 0.25
"""How long after its ok a motion may begin; firmware of several tasks reports Idle until then."""

KEPT_ON: Final = 255
"""The $1 that keeps the motors on at rest."""

MARKS: Final = range(200_000, 1_000_000)
"""Feeds in mm/min, faster than any machine.  One of them, set by ``F``, marks a controller: any
restart and any reset, so also the way out of an alarm, sets it back to F0, and only another F word
changes it; jogs and M3 do not (``$G``).  A restart whose banner was lost, which would take where
the head stands for zero, is so noticed, and also one between two sessions of a scan.

No other word serves: with T, Grbl 1.1 forgets it at the next line and grblHAL keeps it over a
reset, as it does G92; S would be the power of the next M3."""

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

    notices_restart = True

    def __init__(self, link: Link, options: SerialTrackOptions) -> None:
        self._link, self._options = link, options
        self._dialogue = Dialogue(link, options.answer_s)
        self._axis = AXES.index(options.axis)
        self._unit_mm = 1.0
        self._offset: float | None = None
        self._banner = Banner("Grbl", "")
        self._braking_s = BRAKING_S
        self._mark = 0.0
        self._zero = ""

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
        feed = self._await_banner()
        try:
            return self._look(feed)
        except Restarted:  # once: a board that starts twice
            self._dialogue.lost = False
            return self._look(0.0)

    def describe(self) -> dict[str, Fact]:
        """The version its banner stated, its state, and the inputs that are active (``Pn``)."""
        status = self.status()
        return {
            "firmware": f"{self._banner.firmware} {self._banner.version}",
            "state": status.state,
            "active_inputs": status.pins or "none",
            "noise_bytes": self._link.noise_bytes,
        }

    def home(self) -> None:
        """Run ``$H``; it ends in an ok, in ALARM:6 to 9, or in silence."""
        first = "check for a jam on the way to the switch, "
        self._dialogue.command("$H", self._options.homing_s, first)
        self._set_mark(0.0)

    def move(self, target_mm: float, feed_mm_min: float, within_s: float) -> None:
        """Jog to a machine coordinate and wait until idle; DeviceError if not within_s."""
        link, axis = self._link, self._options.axis
        self._dialogue.drain()
        deadline_s = link.clock() + within_s
        self._dialogue.command(f"$J=G21G90G53{axis}{target_mm:.3f}F{feed_mm_min:.1f}")
        moves_s = link.clock() + MOVE_OFF_S
        while (status := self.status()).state != "Idle" or (
            link.clock() < moves_s and not self._stands_at(target_mm, status)
        ):
            if status.state not in ("Idle", "Jog", "Run", "Hold"):
                raise self._not_idle(status)
            if status.state != "Idle":
                moves_s = link.clock()  # from now on, Idle is the end of the motion
            if link.clock() > deadline_s:
                hint = _REMEDIES.get(status.state, "check for a jam, the feed rate and $110")
                raise DeviceError(
                    f"{link.name}: still in state {status.state} {within_s:.1f} s after being "
                    f"sent to machine {target_mm:g} mm; {hint}"
                )
            link.sleep(POLL_S)

    def position_mm(self) -> float:
        """The axis's machine position at rest, two reports alike, of a controller still marked."""
        position_mm = agreed_reading(self._resting_mm, "position", self._link.name)
        if self._feed() != self._mark:
            raise self._dialogue.restart_error()
        return position_mm

    def laser(self, power: float) -> None:
        """M3 with S, or M5.  G1 goes before it: in laser mode ($32) G0 keeps the beam dark.

        Where M5 is not taken, as in a hold or an alarm, a soft reset puts the laser out: Grbl
        stops the spindle in any state then.  The zero is lost with it.
        """
        if power > 0:
            self._dialogue.command(f"G1M3S{power:g}")
            return
        try:
            self._dialogue.query("M5")
        except DeviceError as error:
            self._link.send_bytes(SOFT_RESET)
            if not self._has_banner(self._options.answer_s):
                raise
            self._dialogue.lost = True
            _log.warning("a soft reset has put the laser out, and lost the zero: %s", error)

    def stop(self) -> None:
        """Cancel a jog, wait until it has come to rest, and see that lines are taken again."""
        self._link.send_bytes(JOG_CANCEL)
        status = self._halt(self.status, self._link.clock() + ASK_AGAIN_S)
        if status is not None and status.state == "Idle":
            self._release()

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
            if (place_mm := self._place_mm(status)) is not None:
                return place_mm
        raise DeviceError(
            f"{self._link.name}: reports no position of axis {self._options.axis} that can be "
            "turned into machine coordinates; set $10=1"
        )

    def _place_mm(self, status: StatusReport) -> float | None:
        """The axis's machine coordinate in a report; None where it does not say."""
        numbers = status.machine if status.machine is not None else status.work
        if numbers is None or len(numbers) <= self._axis:
            return None
        offset = 0.0 if status.machine is not None else self._offset
        return None if offset is None else (numbers[self._axis] + offset) * self._unit_mm

    def _stands_at(self, target_mm: float, status: StatusReport) -> bool:
        place_mm = self._place_mm(status)
        return place_mm is not None and abs(place_mm - target_mm) <= self._options.tolerance_mm

    def _feed(self) -> float:
        """F as ``$G`` reports it, in the controller's unit; 0 after a start."""
        modes = agreed_reading(self._dialogue.modes, "modes ($G)", self._link.name)
        feeds = [float(word[1:]) for word in modes if re.fullmatch(r"F\d+\.?\d*", word)]
        return feeds[0] if feeds else 0.0

    def _set_mark(self, found: float) -> None:
        """Mark the controller, anew or by the mark that it had.

        found: the feed it had before, in its unit; none of a mark where that is no mark.
        """
        least_mm_min = MARKS.start - INCH_MM  # an inch is rounded
        has_mark = found * self._unit_mm >= least_mm_min
        mark_mm_min = found * self._unit_mm if has_mark else float(secrets.choice(MARKS))

        def mark() -> float:
            self._dialogue.command(f"G21G94F{mark_mm_min:.1f}")
            if (feed := self._feed()) * self._unit_mm < least_mm_min:
                raise Unanswered(
                    f"{self._link.name}: $G does not report the feed F{mark_mm_min:.1f} that was "
                    "set, so a restart would go unnoticed; needs Grbl 1.1 or a firmware like it"
                )
            return feed

        self._mark = ask_again(mark)
        self._zero = f"F{self._mark:.10g}" + ("" if has_mark else f" {secrets.token_hex(4)}")

    def _await_banner(self) -> float:
        """Wait for the start message, after a soft reset where none comes.

        A reset in motion loses steps (ALARM:3), so what moves is stopped before it.  Gives the feed
        found: a mark is kept, since the controller has counted its steps since it was set.
        """
        link, options, feed = self._link, self._options, 0.0
        if self._has_banner(options.boot_s):
            return feed
        status = self._halt(self._dialogue.any_status)
        if status is not None and status.state == "Idle":
            self._release()
            feed = self._feed()
        link.send_bytes(SOFT_RESET)
        if self._has_banner(options.answer_s):
            return feed
        raise DeviceError(
            f"{link.name}: no Grbl banner within {options.boot_s + 2 * options.answer_s:g} s, not "
            "even after a soft reset; check the port, the baud rate, track.options.dialect "
            "('marlin' for a controller with Marlin) and the controller's power, and try "
            "track.options.dtr = false: the port's DTR line may hold the board in reset"
        )

    def _look(self, feed: float) -> AxisTravel:
        """What the settings say of the axis.  feed: what ``$G`` reported before the start, or 0."""
        rest_s = self._link.clock() + min(START_AGAIN_S, self._options.boot_s)
        while (message := self._dialogue.read(rest_s)) is not None:  # what follows the banner
            feed = 0.0 if isinstance(message, Banner) else feed
        status = self.status()
        if status.state not in ("Idle", "Alarm"):
            raise self._not_idle(status)
        settings = self._settings()
        self._dialogue.homes = bool(settings[22])
        if status.state == "Alarm" and not self._options.homing:
            raise self._not_idle(status)
        self._unit_mm = INCH_MM if settings[13] else 1.0
        if not self._options.homing:
            self._set_mark(feed)  # else after homing: in alarm it would be refused
        per_mm, max_mm_min, accel_mm_s2, travel_mm = (
            settings[base + self._axis] for base in (100, 110, 120, 130)
        )
        self._braking_s = self._options.answer_s + self._options.feed_mm_min / 60 / accel_mm_s2
        low_mm, high_mm = -float("inf"), float("inf")
        if settings[20] and self._banner.is_documented:
            upward = self._origin_at_switch() and int(settings[23]) >> self._axis & 1
            low_mm, high_mm = (0.0, travel_mm) if upward else (-travel_mm, 0.0)
        return AxisTravel(low_mm, high_mm, 1.0 / per_mm, max_mm_min, accel_mm_s2)

    def _has_banner(self, within_s: float) -> bool:
        """Whether a banner comes; DeviceError where its version is none that is known."""
        deadline_s = self._link.clock() + within_s
        while (message := self._dialogue.read(deadline_s)) is not None:
            if isinstance(message, Banner):
                if message.number < (1, 1):
                    raise DeviceError(
                        f"{self._link.name}: runs Grbl {message.version}; needed: 1.1 or a "
                        "firmware that answers as Grbl 1.1 does"
                    )
                self._banner = message
                return True
        return False

    def _halt(
        self, report: Callable[[], StatusReport | None], ask_s: float = 0.0
    ) -> StatusReport | None:
        """What it reports when all motion has been stopped without loss of position.

        report: asks for a report; where it gives None, so does this.  ask_s: when to ask it to
        stop.  It is asked again only where it seems not to have heard: a cancel that comes as the
        jog ends leaves Grbl suspended.
        """
        deadline_s = self._link.clock() + self._braking_s
        while (status := report()) is not None and _is_moving(status):
            now_s = self._link.clock()
            if now_s > deadline_s:
                raise self._not_idle(status)
            if now_s >= ask_s:
                self._link.send_bytes(JOG_CANCEL if status.state == "Jog" else FEED_HOLD)
                ask_s = now_s + ASK_AGAIN_S
            self._link.sleep(POLL_S)
        return status

    def _release(self) -> None:
        """See that a controller that reports Idle takes lines.

        A jog cancelled as it ends leaves Grbl suspended, until it is told to go on.
        """
        try:
            self._dialogue.command("$G")
        except Unanswered:
            self._link.send_bytes(CYCLE_START)
            with suppress(Unanswered):  # refused for what a noisy line had left before it
                self._dialogue.answers("$G")

    def _settings(self) -> dict[int, float]:
        """``$$`` as numbers by their number, complete and read twice alike."""
        needed = (13, 20, 22, 23, *(base + self._axis for base in (100, 110, 120, 130)))
        assumed = {} if self._banner.is_documented else {13: 0.0}  # FluidNC does not say

        def read() -> dict[int, float]:
            said = self._dialogue.query("$$")
            return assumed | {s.number: s.value for s in said if isinstance(s, GrblSetting)}

        settings = agreed_reading(read, "settings ($$)", self._link.name)
        if missing := [number for number in needed if number not in settings]:
            raise DeviceError(f"{self._link.name}: $$ does not name ${missing[0]}; needs Grbl 1.1")
        for number in needed:
            if number >= 100 and settings[number] <= 0:
                what = f"{self._link.name}: ${number}={settings[number]:g}; it must be above 0"
                raise DeviceError(what)
        if (hold_ms := settings.get(1, KEPT_ON)) != KEPT_ON:
            _log.warning(
                "%s: the motors let go %g ms after each move ($1=%g), so the head may creep "
                "between frames unseen; $1=255 keeps them on",
                *(self._link.name, hold_ms, hold_ms),
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
