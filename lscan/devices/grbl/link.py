"""Lines over a serial port: sent whole, read until a deadline, noise skipped and counted."""

import contextlib
import math
import time
from collections.abc import Callable
from typing import Final, Protocol

from lscan.errors import DeviceError

LONGEST_LINE: Final = 70  # Grbl 1.1's own limit is 80 with the line end, Marlin's 96
LONGEST_ANSWER: Final = 1024  # Marlin's M115 takes some 300; more without an end is noise


class Transport(Protocol):
    """What is asked of a serial port; pyserial's ``Serial`` has it."""

    @property
    def in_waiting(self) -> int:
        """Bytes that have come and were not read."""

    def read(self, size: int, /) -> bytes:
        """Up to ``size`` bytes, fewer or none after a short while.  OSError: line broken."""

    def write(self, data: bytes, /) -> int | None:
        """Send bytes.  OSError: line broken."""

    def close(self) -> None:
        """Release the port."""


def open_serial(port: str, baud: int, name: str, write_s: float, dtr: bool = True) -> Transport:
    """The serial port, opened for this program alone; DeviceError where it cannot be.

    write_s: how long it may take to accept what is sent.  dtr: whether its lines DTR and RTS are
    raised while it is open.
    """
    try:
        import serial
    except ImportError:
        raise DeviceError(f"{name}: needs the package pyserial; install it") from None
    try:
        line = serial.Serial(None, baud, timeout=0.01, write_timeout=write_s, exclusive=True)
        line.port, line.dtr, line.rts = port, dtr, dtr  # before it opens: that would raise both
        line.open()
        return line
    except (OSError, ValueError) as error:
        raise DeviceError(
            f"{name}: {port!r} cannot be opened at {baud} baud: {error}; check the cable, the "
            "port's name, that no other program holds it, and that you may use it (group dialout)"
        ) from error


class Link:
    """A serial line on which whole lines are exchanged.

    name: how messages call the device.  write_s: how long the transport waits until what is sent
    is accepted.  noise_bytes: bytes skipped so far because they were
    part of no readable line.  clock, sleep: the time, for a line in simulated time.
    """

    def __init__(
        self,
        transport: Transport,
        name: str,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
        write_s: float = math.inf,
    ) -> None:
        self._write_s = write_s
        self.name, self.clock, self.sleep = name, clock, sleep
        self.noise_bytes = 0
        self._transport = transport
        self._received = bytearray()

    def send(self, text: str) -> None:
        """Send one line; DeviceError where it is too long or the line is broken."""
        if len(text) >= LONGEST_LINE:
            raise DeviceError(
                f"{self.name}: {text!r} is {len(text) + 1} characters with its end; "
                f"allowed: {LONGEST_LINE}"
            )
        self.send_bytes(text.encode("ascii") + b"\n")

    def send_bytes(self, data: bytes) -> None:
        """Send bytes as they are, such as Grbl's one-byte real-time commands."""
        try:
            self._transport.write(data)
        except OSError as error:
            raise self._broken(error) from error

    def line(self, deadline_s: float) -> str | None:
        """The next readable line without its end; None where none is whole by the deadline.

        deadline_s: on this link's clock.
        """
        while True:
            while (end := self._received.find(b"\n")) >= 0:
                raw = bytes(self._received[:end])
                del self._received[: end + 1]
                if (text := self._readable(raw)) is not None:
                    return text
            if len(self._received) > LONGEST_ANSWER:
                self.noise_bytes += len(self._received)
                self._received.clear()
            if self.clock() >= deadline_s:
                return None
            try:
                self._received += self._transport.read(max(1, self._transport.in_waiting))
            except OSError as error:
                raise self._broken(error) from error

    def skip(self, text: str) -> None:
        """Count a line that says nothing known as noise."""
        self.noise_bytes += len(text) + 1

    def close(self) -> None:
        """Release the port; a broken one is as good as closed."""
        with contextlib.suppress(OSError):
            self._transport.close()

    def _readable(self, raw: bytes) -> str | None:
        """The line, freed of noise before it; None where it is empty or has noise within."""
        stripped = raw.strip(b"\r\t ")
        first = next((i for i, byte in enumerate(stripped) if 0x20 <= byte < 0x7F), len(stripped))
        kept = stripped[first:]
        if kept.isascii() and (text := kept.decode("ascii")).isprintable():
            self.noise_bytes += first
            return text or None
        self.noise_bytes += len(raw) + 1
        return None

    def _broken(self, error: OSError) -> DeviceError:
        import serial  # here, as in open_serial: only a real port needs the package

        if isinstance(error, serial.SerialTimeoutException):
            return DeviceError(
                f"{self.name}: the port accepted nothing for {self._write_s:g} s; the adapter or "
                "the controller hangs, or the computer was held up: switch the controller off and "
                "on, or raise track.options.write_s, then open the track again"
            )
        return DeviceError(
            f"{self.name}: the serial line broke ({error}); check the cable and the controller's "
            "power, then open the track again"
        )
