"""A controller on a line, whatever its language: options, lines, what all can do."""

import contextlib
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Final, Generic, Literal, Protocol, TypeVar
from urllib.parse import urlsplit

from pydantic import AfterValidator, Field

from lscan.devices.api import ConnectionLost, Fact, TravelOptions
from lscan.errors import DeviceError

# ``[track.options]`` of these tracks, checked before any device is touched.

Place = Annotated[float, Field(ge=-100_000, le=100_000)]
ROUNDING_MM: Final = 0.0005
"""Half of the last of three decimals, with which coordinates go over the line."""


class AxisOptions(TravelOptions):
    """One axis of a controller, and how it moves: what all such tracks are told.

    min_mm, max_mm: positions the head may be sent to; the approach needs ``approach_mm`` of free
    way below min_mm.  zero_mm: the machine coordinate where the position is 0; invert: positions
    grow where machine coordinates fall.  approach_mm: every position is reached upwards, over at
    least this way, so that backlash is taken up; 0: from wherever the head stands.
    tolerance_mm: how far from its target the head may report to have stopped.
    settle_s: rest before a picture.  homing: search the switches on opening; without it the
    machine's zero is where the head stood when the controller started, and any restart moves it.
    answer_s, homing_s: how long an answer, a homing may take.  reconnects: how often a scan tries
    to reach a controller again whose connection broke, each time after reconnect_wait_s.
    laser_power: S word of M3.
    """

    axis: Literal["X", "Y", "Z"] = "X"
    min_mm: Place
    max_mm: Place
    zero_mm: Place = 0.0
    invert: bool = False
    feed_mm_min: Annotated[float, Field(gt=0, le=60_000)] = 500.0
    approach_mm: Annotated[float, Field(ge=0, le=100)] = 1.0
    tolerance_mm: Annotated[float, Field(gt=0, le=1)] = 0.02
    settle_s: Annotated[float, Field(ge=0, le=60)] = 0.2
    homing: bool = True
    answer_s: Annotated[float, Field(gt=0, le=60)] = 2.0
    homing_s: Annotated[float, Field(gt=0, le=600)] = 60.0
    reconnects: Annotated[int, Field(ge=0, le=100)] = 5
    reconnect_wait_s: Annotated[float, Field(ge=0, le=600)] = 1.0
    laser_power: Annotated[float, Field(ge=0, le=100_000)] = 1000.0

    def machine_mm(self, position_mm: float) -> float:
        """Machine coordinate, mm.

        Parameters
        ----------
        position_mm : float, mm, of the track
        """
        return self.zero_mm + (-position_mm if self.invert else position_mm)

    def position_mm(self, machine_mm: float) -> float:
        """Position of the track, mm.

        Parameters
        ----------
        machine_mm : float, mm, machine coordinate
        """
        offset_mm = machine_mm - self.zero_mm
        return -offset_mm if self.invert else offset_mm


def _require_port_number(address: str) -> str:
    if "://" in address and urlsplit(address).port == 0:  # ValueError above 65535
        raise ValueError("its port must be 1 to 65535")
    return address


PortNumber: Final = AfterValidator(_require_port_number)
"""Of an address, checked to be one that there is."""

Port = Annotated[
    str,
    PortNumber,
    Field(
        pattern=r"^(([^:]|:+[^:/])+|(socket|rfc2217)://([^\[\]\s:/?#@]+|\[[0-9a-fA-F:.]+\]):[0-9]+)$",
        description="a serial port, such as /dev/ttyUSB0 or COM3; or socket://HOST:PORT or "
        "rfc2217://HOST:PORT",
    ),
]
"""No other URL that pyserial knows: a rig file may be a stranger's, and ``alt://`` loads any
class, ``spy://`` writes files (pyserial 3.5, "URL Handlers")."""


class SerialTrackOptions(AxisOptions):
    """The track's port, besides what is said of its axis.

    port: the serial port, as ``/dev/ttyUSB0`` or ``COM3``; or, over a network, raw TCP as
    ``socket://HOST:PORT``, a serial port by RFC 2217 as ``rfc2217://HOST:PORT``.  dtr: whether its
    lines DTR and RTS are raised while it is open, which holds some boards in reset.
    boot_s: how long a start may take.  write_s: how long the port may take to accept a line; longer
    where a busy computer or an adapter holds it up.
    """

    port: Port
    baud: Annotated[int, Field(ge=1200, le=4_000_000)] = 115_200
    dtr: bool = True
    dialect: Literal["grbl", "marlin"] = "grbl"
    boot_s: Annotated[float, Field(ge=0, le=30)] = 3.0
    write_s: Annotated[float, Field(gt=0, le=60)] = 5.0


# Lines over a port or a network: sent whole, read until a deadline, noise skipped and counted.


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
    """The serial port, opened for this program alone, or the connection that its URL names.

    ConnectionLost where it cannot be.  write_s: how long it may take to accept what is sent; of
    RFC 2217, pyserial's own 5 s.  dtr: whether its lines DTR and RTS are raised while it is open.
    """
    try:
        import serial
    except ImportError:
        raise DeviceError(f"{name}: needs the package pyserial; install it") from None
    # pyserial 3.5 opens no RFC 2217 port with a write timeout: NotImplementedError.
    accepts_s = None if port.startswith("rfc2217:") else write_s
    try:
        line = serial.serial_for_url(
            port, baud, timeout=0.01, write_timeout=accepts_s, exclusive=True, do_not_open=True
        )
        line.dtr = line.rts = dtr  # before it opens: that would raise both
        line.open()
        return line
    except (OSError, ValueError) as error:
        if "://" in port:
            raise ConnectionLost(
                f"{name}: cannot be reached: {error.__context__ or error}; check the address, the "
                "network, the controller's power, and that no other program holds the connection"
            ) from error
        raise ConnectionLost(
            f"{name}: {port!r} cannot be opened at {baud} baud: {error}; check the cable, the "
            "port's name, that no other program holds it, and that you may use it (on Linux, group "
            "dialout)"
        ) from error


class Link:
    """A connection on which whole lines are exchanged.

    name: how messages call the device.  write_s: how long the transport waits until what is sent
    is accepted.  noise_bytes: bytes skipped so far because they were
    part of no readable line.  clock, sleep: the time, for a line in simulated time.  connect: gives
    another transport in place of one that broke.
    """

    def __init__(
        self,
        transport: Transport,
        name: str,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
        write_s: float = math.inf,
        connect: Callable[[], Transport] | None = None,
    ) -> None:
        self._write_s, self._connect = write_s, connect
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

    @property
    def can_reopen(self) -> bool:
        """Whether there is a way to another transport."""
        return self._connect is not None

    def reopen(self) -> None:
        """Connect anew; ConnectionLost where that fails.  What had come in part is forgotten."""
        assert self._connect is not None
        self.close()
        self._received.clear()
        self._transport = self._connect()

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
        return ConnectionLost(
            f"{self.name}: the connection broke ({error}); check the cable or the network, and the "
            "controller's power, then open the track again"
        )


# What the controllers of a track have in common, whatever language they speak.
#
# Every line is answered before the next is sent.
#
# A serial line carries no checksum: whatever a position rests on is read until two readings in a
# row agree.


READINGS: Final = 8
"""Readings of which two in a row must agree; a clean line needs two."""

ASKINGS: Final = 3
"""How often a question is asked that changes nothing, until it is answered readably."""

Said = TypeVar("Said")
Reading = TypeVar("Reading")
Answer = TypeVar("Answer")


class Unanswered(DeviceError):
    """A line was not answered, or not readably: where it changes nothing, it can be sent again."""


class Restarted(DeviceError):
    """The controller started anew, so that what it counted is lost."""


@dataclass(frozen=True)
class AxisTravel:
    """What a controller says of its axis, in machine coordinates.

    low_mm, high_mm: its travel, infinite where it guards none.  step_mm: one motor step.
    max_mm_min, accel_mm_s2: its fastest feed and its acceleration, infinite where unknown.
    """

    low_mm: float = -math.inf
    high_mm: float = math.inf
    step_mm: float = 0.0
    max_mm_min: float = math.inf
    accel_mm_s2: float = math.inf


class AxisMachine(Protocol):
    """A controller as one axis and a laser, whatever its language; its errors are DeviceError.

    notices_restart: whether ``position_mm`` raises where the controller has restarted since it was
    woken, so that its positions count from elsewhere.
    """

    notices_restart: bool

    @property
    def zero(self) -> str:
        """A name for the zero that its coordinates count from."""

    def has_kept(self, zero: str) -> bool:
        """Whether they count from this zero still."""

    def wake(self) -> AxisTravel:
        """Make it listen, at rest, and ask what it knows of the axis."""

    def describe(self) -> dict[str, Fact]:
        """What it says of itself and its state."""

    def home(self) -> None:
        """Search the switch."""

    def move(self, target_mm: float, feed_mm_min: float, within_s: float) -> None:
        """Move to a machine coordinate and wait until at rest, no longer than ``within_s``."""

    def position_mm(self) -> float:
        """The machine coordinate at which it rests."""

    def laser(self, power: float) -> None:
        """Switch the laser on, or off by 0, and see that it is."""

    def stop(self) -> None:
        """End all motion; the position is kept where the controller can."""


class Connection(Protocol):
    """What a track asks of the line or the network to its controller; ``Link`` has it."""

    name: str
    sleep: Callable[[float], None]

    @property
    def can_reopen(self) -> bool:
        """Whether it can be reached anew."""

    def reopen(self) -> None:
        """Reach it anew; ConnectionLost where that fails."""

    def close(self) -> None:
        """Release it."""


class Exchange(ABC, Generic[Said]):
    """Lines and their answers, with one controller.

    answer_s: how long an answer may take.  homes: whether the controller can home, for what to do
    about a position that is lost.  lost: whether it has said since that it is.
    """

    def __init__(self, link: Link, answer_s: float) -> None:
        self.link, self._answer_s = link, answer_s
        self.homes, self.lost = True, False

    @abstractmethod
    def following(self, deadline_s: float) -> Said | None:
        """What is said next, None where nothing is whole by the deadline.

        Raises DeviceError where it says that the position can no longer be held.
        """

    @abstractmethod
    def ends(self, said: Said, text: str) -> bool:
        """Whether it is the ok that ends the answer to a line; an error where it refuses it."""

    def command(self, text: str, within_s: float | None = None, first: str = "") -> list[Said]:
        """Send a line; what was said until its ok.

        within_s: how long that may take, if not ``answer_s``.  first: what to look at first where
        no answer comes.  Raises Unanswered where it is refused or unanswered, DeviceError where
        the position is lost.
        """
        self.drain()
        self.link.send(text)
        return self.answers(text, within_s, first)

    def answers(self, text: str, within_s: float | None = None, first: str = "") -> list[Said]:
        """As ``command``, of a line that was sent before."""
        answers: list[Said] = []
        deadline_s = self.link.clock() + (self._answer_s if within_s is None else within_s)
        while (said := self.following(deadline_s)) is not None:
            if self.ends(said, text):
                return answers
            answers.append(said)
        raise self.silent(f"an answer to {text!r}", first)

    def query(self, text: str, first: str = "") -> list[Said]:
        """As ``command``, of a line that changes nothing: it is sent again where need be."""
        return ask_again(lambda: self.command(text, first=first))

    def drain(self) -> None:
        """Read what has come unasked, so that no old ok answers a new line."""
        while self.following(self.link.clock()) is not None:
            pass

    def restart_error(self) -> Restarted:
        """The error that says so; the position is lost from here on."""
        self.lost = True
        mend = "home" if self.homes else "put the head back by hand"
        return Restarted(
            f"{self.link.name}: the controller has restarted, so its position is lost; check "
            f"its power and the USB cable, {mend}, and open the track again"
        )

    def silent(self, what: str, first: str = "") -> Unanswered:
        """The error that says that ``what`` did not come."""
        return Unanswered(
            f"{self.link.name}: silent: {what} did not come in time "
            f"({self.link.noise_bytes} bytes of noise so far); {first}check cable and power, then "
            "open the track again"
        )


def ask_again(ask: Callable[[], Answer]) -> Answer:
    """The answer of ``ask``, which is called again where it raises Unanswered, up to ASKINGS."""
    for _ in range(ASKINGS - 1):
        with contextlib.suppress(Unanswered):
            return ask()
    return ask()


def agreed_reading(read: Callable[[], Reading], what: str, name: str) -> Reading:
    """The reading that two calls in a row of ``read`` give alike; DeviceError where none is.

    what: the thing read, name: the device, both for the message.
    """
    before = read()
    for _ in range(READINGS - 1):
        now = read()
        if now == before:
            return now
        before = now
    raise DeviceError(
        f"{name}: {what}: no two of {READINGS} readings in a row agree; shorten or shield the "
        "cable, keep it away from the motor's, or lower the baud rate"
    )
