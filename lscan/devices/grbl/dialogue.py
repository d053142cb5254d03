"""Talking with Grbl 1.1: lines and their answers, reports, and noise passed over.

Every line is answered before the next is sent.
"""

from __future__ import annotations

from typing import Final

from lscan.devices.grbl.codes import alarm_in_words, error_in_words
from lscan.devices.grbl.link import Link
from lscan.devices.grbl.machine import Unanswered, asked
from lscan.devices.grbl.protocol import (
    Alarm,
    Banner,
    Feedback,
    Message,
    Ok,
    Refusal,
    StatusReport,
    parse_line,
)
from lscan.errors import DeviceError

STATUS: Final = b"?"
ASK_AGAIN_S: Final = 0.25  # a report comes within 20 ms, but Grbl may drop a question


class Dialogue:
    """The exchange with one controller.

    answer_s: how long an answer may take.  homes: whether the controller can home ($22), for
    what to do about an alarm.  lost: whether it has said since that its position is lost.
    """

    def __init__(self, link: Link, answer_s: float) -> None:
        self.link, self._answer_s = link, answer_s
        self.homes, self.lost = True, False

    def command(self, text: str, within_s: float | None = None, first: str = "") -> list[Message]:
        """Send a line; what was said until its ok.

        within_s: how long that may take, if not ``answer_s``.  first: what to look at first where
        no answer comes.  Raises Unanswered where it is refused or unanswered, DeviceError where
        the position is lost.
        """
        link = self.link
        answers: list[Message] = []
        self.drain()
        deadline_s = link.clock() + (self._answer_s if within_s is None else within_s)
        link.send(text)
        while (message := self._next(deadline_s)) is not None:
            if isinstance(message, Ok):
                return answers
            if isinstance(message, Refusal):
                raise Unanswered(
                    f"{link.name}: refuses {text!r}: {error_in_words(message.code)}; where the "
                    "command is right, a noisy line garbled it: check the cable"
                )
            answers.append(message)
        raise self._silent(f"an answer to {text!r}", first)

    def query(self, text: str) -> list[Message]:
        """As ``command``, of a line that changes nothing: it is sent again where need be."""
        return asked(lambda: self.command(text))

    def modes(self) -> list[str]:
        """The words of ``$G``, such as G54 or T0."""

        def ask() -> list[str]:
            for answer in self.command("$G"):
                if isinstance(answer, Feedback) and answer.kind == "GC":
                    return answer.text.split()
            raise self._silent("a readable answer to '$G'")

        return asked(ask)

    def status(self) -> StatusReport:
        """A report asked for now, its lengths in the controller's unit."""
        report = self._report(heed=True)
        if report is None:
            raise self._silent("a status report")
        return report

    def any_status(self) -> StatusReport | None:
        """As ``status``, of a controller that may have restarted; None where none comes."""
        return self._report(heed=False)

    def _report(self, heed: bool) -> StatusReport | None:
        link, end_s = self.link, self.link.clock() + self._answer_s
        read = self._next if heed else self.read
        while link.clock() < end_s:
            link.send_bytes(STATUS)
            ask_again_s = min(end_s, link.clock() + ASK_AGAIN_S)
            while (message := read(ask_again_s)) is not None:
                if isinstance(message, StatusReport):
                    return message
        return None

    def drain(self) -> None:
        """Read what has come unasked, so that no old ok answers a new line."""
        while self._next(self.link.clock()) is not None:
            pass

    def read(self, deadline_s: float) -> Message | None:
        """The next message, whatever it says; None where none is whole by the deadline."""
        while (text := self.link.line(deadline_s)) is not None:
            if (message := parse_line(text)) is not None:
                return message
            self.link.skip(text)
        return None

    def _next(self, deadline_s: float) -> Message | None:
        """The next message; DeviceError where it says that the position can no longer be held."""
        message = self.read(deadline_s)
        if isinstance(message, Alarm):
            self.lost = True
            raise DeviceError(
                f"{self.link.name}: {alarm_in_words(message.code)}; {self.alarm_remedy()}"
            )
        if isinstance(message, Banner):
            raise self.restarted()
        return message

    def alarm_remedy(self) -> str:
        """What to do about an alarm, and what ``$X`` costs."""
        if self.homes:
            return (
                "clear the way, then home ($H, or homing = true) before the next scan; $X only "
                "unlocks, and leaves the position lost"
            )
        return (
            "clear the way, then unlock by $X, which leaves the position lost; this controller "
            "does not home ($22=0), so before a scan goes on switch it off, push the head by hand "
            "to where it stood when it was first switched on, and switch it on; or scan anew"
        )

    def restarted(self) -> DeviceError:
        """The error that says so; the position is lost from here on."""
        self.lost = True
        mend = "home" if self.homes else "put the head back by hand"
        return DeviceError(
            f"{self.link.name}: the controller has restarted, so its position is lost; check "
            f"its power and the USB cable, {mend}, and open the track again"
        )

    def _silent(self, what: str, first: str = "") -> Unanswered:
        return Unanswered(
            f"{self.link.name}: silent: {what} did not come in time "
            f"({self.link.noise_bytes} bytes of noise so far); {first}check cable and power, then "
            "open the track again"
        )
