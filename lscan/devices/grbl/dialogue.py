"""Talking with Grbl 1.1: lines and their answers, reports, and noise passed over."""

from collections.abc import Callable
from typing import Final

from lscan.devices.grbl.machine import Exchange, Unanswered, asked
from lscan.devices.grbl.protocol import (
    Alarm,
    Banner,
    Feedback,
    Message,
    Ok,
    Refusal,
    StatusReport,
    in_words,
    parse_line,
)
from lscan.errors import DeviceError

STATUS: Final = b"?"
ASK_AGAIN_S: Final = 0.25  # a report comes within 20 ms, but Grbl may drop a question


class Dialogue(Exchange[Message]):
    """The exchange with one controller.  homes: by its setting $22."""

    def ends(self, said: Message, text: str) -> bool:
        """Whether it is an ok; Unanswered for a refusal, since noise may have caused it."""
        if isinstance(said, Refusal):
            raise Unanswered(
                f"{self.link.name}: refuses {text!r}: {in_words('error', said.code)}; where the "
                "command is right, a noisy line garbled it: check the cable"
            )
        return isinstance(said, Ok)

    def modes(self) -> list[str]:
        """The words of ``$G``, such as G54 or T0."""

        def ask() -> list[str]:
            for answer in self.command("$G"):
                if isinstance(answer, Feedback) and answer.kind == "GC":
                    return answer.text.split()
            raise self.silent("a readable answer to '$G'")

        return asked(ask)

    def status(self) -> StatusReport:
        """A report asked for now, its lengths in the controller's unit."""
        report = self._report(self.following)
        if report is None:
            raise self.silent("a status report")
        return report

    def any_status(self) -> StatusReport | None:
        """As ``status``, of a controller that may have restarted; None where none comes."""
        return self._report(self.read)

    def _report(self, read: Callable[[float], Message | None]) -> StatusReport | None:
        link, end_s = self.link, self.link.clock() + self._answer_s
        while link.clock() < end_s:
            link.send_bytes(STATUS)
            ask_again_s = min(end_s, link.clock() + ASK_AGAIN_S)
            while (message := read(ask_again_s)) is not None:
                if isinstance(message, StatusReport):
                    return message
        return None

    def read(self, deadline_s: float) -> Message | None:
        """The next message, whatever it says; None where none is whole by the deadline."""
        while (text := self.link.line(deadline_s)) is not None:
            if (message := parse_line(text)) is not None:
                return message
            self.link.skip(text)
        return None

    def following(self, deadline_s: float) -> Message | None:
        """As ``read``; DeviceError where it says that the position can no longer be held."""
        message = self.read(deadline_s)
        if isinstance(message, Alarm):
            self.lost = True
            raise DeviceError(
                f"{self.link.name}: {in_words('ALARM', message.code)}; {self.alarm_remedy()}"
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
