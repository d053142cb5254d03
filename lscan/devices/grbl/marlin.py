"""Marlin as a machine: one axis, ``G1`` and ``M400``, positions by ``M114``.

Source: Marlin's G-code reference, pages G28, M114, M115, M400, M410, and "host keepalive"
(``echo:busy: processing`` every two seconds while a command takes its time).
"""

import re
import secrets
from typing import Final

from lscan.devices.api import Fact
from lscan.devices.grbl.machine import (
    AxisTravel,
    Exchange,
    Link,
    SerialTrackOptions,
    Unanswered,
    agreed_reading,
    ask_again,
)
from lscan.errors import DeviceError

STEP_MM: Final = 0.01
"""M114 writes two decimals."""

_JAM: Final = "check for a jam, "
_OTHER_DIALECT: Final = (
    "where the controller runs Grbl, set track.options.dialect = 'grbl'; where the port's DTR line "
    "holds the board in reset, track.options.dtr = false; "
)

_FIRMWARE = re.compile(r"FIRMWARE_NAME:(Marlin.*?)(?= [A-Z_]+:|$)")
_REPORT = re.compile(r"X:(-?\d+\.\d+) Y:(-?\d+\.\d+) Z:(-?\d+\.\d+)(?: .*)?")
"""The position in mm; "Count" and what follows are motor steps."""


class Lacking(DeviceError):
    """The firmware was built without a command."""


class MarlinExchange(Exchange[str]):
    """Lines and their answers; a controller that is busy says so between them."""

    def following(self, deadline_s: float) -> str | None:
        """The next line; DeviceError where it says that the controller stopped or restarted."""
        text, name = self.link.line(deadline_s), self.link.name
        if text is None:
            return None
        if text.startswith(("Error:", "!!")):
            raise DeviceError(
                f"{name}: stopped: {text[:80]!r}; clear the cause, reset the controller, home, "
                "and open the track again"
            )
        if text.startswith("echo:Unknown command"):
            raise Lacking(f"{name}: {text[:80]!r}; the firmware lacks this command")
        if text == "start":
            raise self.restart_error()
        return text

    def ends(self, said: str, text: str) -> bool:
        """Whether it is an ok, which may go on with more."""
        return said == "ok" or said.startswith("ok ")


class MarlinMachine:
    """The axis of a controller that runs Marlin."""

    notices_restart = False

    def __init__(self, link: Link, options: SerialTrackOptions) -> None:
        self._link, self._options = link, options
        self._exchange = MarlinExchange(link, options.answer_s)
        self._command = self._exchange.command
        self._firmware = ""
        # Marlin keeps nothing by which a restart between two sessions could be noticed.
        self.zero = f"opening {secrets.token_hex(4)}"

    def has_kept(self, zero: str) -> bool:
        """Whether the name is of this opening."""
        return self.zero == zero

    def wake(self) -> AxisTravel:
        """Wait for ``start``, ask for the firmware's name, put the laser out, choose mm.

        What a killed program left moving is waited for: M410 stops it too, but loses steps.
        """
        link, options = self._link, self._options
        deadline_s = link.clock() + options.boot_s
        while (text := link.line(deadline_s)) is not None and text != "start":
            pass
        while link.line(link.clock() + 0.05) is not None:  # the settings a start prints
            pass
        answer = " ".join(self._exchange.query("M115", _OTHER_DIALECT))
        if (firmware := _FIRMWARE.search(answer)) is None:
            raise DeviceError(
                f"{link.name}: is no Marlin: M115 answers {answer[:60]!r}; set track.options."
                "dialect, or check port and baud rate"
            )
        self._firmware = firmware[1]
        try:  # a program that was killed leaves the laser lit
            self._command("M5", options.homing_s, _JAM)
        except Lacking:
            self._exchange.answers("M5")  # its ok
        self._command("M400", options.homing_s, _JAM)
        self._command("G21")
        self._command("G90")
        return AxisTravel(step_mm=STEP_MM)

    def describe(self) -> dict[str, Fact]:
        """The name ``M115`` gave; Marlin reports no state, only whether it answers."""
        self._command("M400")
        return {"firmware": self._firmware, "noise_bytes": self._link.noise_bytes}

    def home(self) -> None:
        """Run ``G28`` for the axis."""
        self._command(f"G28 {self._options.axis}", self._options.homing_s, _JAM)

    def move(self, target_mm: float, feed_mm_min: float, within_s: float) -> None:
        """Move and wait for the end of all motion."""
        self._command(f"G1 {self._options.axis}{target_mm:.3f} F{feed_mm_min:.1f}")
        self._command("M400", within_s, _JAM)

    def position_mm(self) -> float:
        """The axis's position, two reports alike."""
        return agreed_reading(lambda: ask_again(self._reported_mm), "position", self._link.name)

    def laser(self, power: float) -> None:
        """M3 with S, or M5."""
        self._command(f"M3 S{power:g}" if power > 0 else "M5")

    def stop(self) -> None:
        """Stop all motion and wait until it has ended."""
        self._command("M410")
        self._command("M400")

    def _reported_mm(self) -> float:
        for answer in self._command("M114"):
            if report := _REPORT.fullmatch(answer):
                return float(report["XYZ".index(self._options.axis) + 1])
        raise Unanswered(
            f"{self._link.name}: M114 gave no readable position of axis {self._options.axis}; "
            "check the cable, then open the track again"
        )
