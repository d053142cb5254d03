"""What the emulated controllers have in common: axes, bytes in and out, and the serial line."""

import contextlib
import os
import select
import socket
import threading
import time
import tty
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np

from sim.emulators.grbl.motion import Axes, Place
from sim.emulators.grbl.protocol import DEFAULTS, GcodeBlock, Modes

# What the emulated controllers have in common: a machine of three axes, and bytes in and out.


class EmulatedController(ABC):
    """A controller with its machine: bytes in by ``receive``, bytes out by ``transmit``.

    Parameters
    ----------
    settings
        Grbl's ``$`` settings, of the machine too, that differ from DEFAULTS.
    head_mm
        Where the head is at power-up, counted from the switches, of which each axis has one at 0
        and its travel below.  Machine coordinates are zero there until homing.
    clock
        Seconds.
    """

    line_end = b"\n"

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
        self._homing, self._modes = False, Modes()
        self._power_up()

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
        return 0.0 if self._modes.spindle == 5 else self._modes.speed

    def receive(self, data: bytes) -> None:
        """Take bytes from the line; OSError while it is unplugged."""
        with self._lock_out:
            self._update()
            for byte in self._on_line(data):
                self._take(byte)
            self._process()

    def transmit(self) -> bytes:
        """The bytes to send by now; OSError while the line is unplugged."""
        with self._lock_out:
            self._update()
            data = bytes(self._out)
            self._out.clear()
            return self._on_line(data)

    def _on_line(self, data: bytes) -> bytes:
        """The bytes as the line carries them."""
        return data

    @abstractmethod
    def _power_up(self) -> None:
        """Begin with what a controller says and is when it is switched on."""

    @abstractmethod
    def _update(self) -> None:
        """Bring the machine to the present time."""

    @abstractmethod
    def _take(self, byte: int) -> None:
        """Take one byte from the line."""

    @abstractmethod
    def _process(self) -> None:
        """Execute the lines that need not wait, and answer them."""

    def _end_line(self) -> None:
        self._pending.append(self._line.decode("ascii", errors="replace"))
        self._line.clear()

    def _start_homing(self) -> None:
        self._homing = True
        self._axes.seek_switches(self._last_s)

    def _end_homing(self) -> None:
        self._homing = False
        self._axes.stand_off()
        self._say("ok")

    def _target(self, block: GcodeBlock) -> Place:
        """The block's target in machine coordinates, on whole motor steps."""
        start_mm = self._planner.planned_mm(self._last_s)
        return self._axes.on_steps(self._modes.target_mm(block, start_mm))

    def _say(self, *lines: str) -> None:
        for line in lines:
            self._out += line.encode("ascii") + self.line_end


# A line to an emulated controller, a serial port of the system or TCP; faults.


POLL_S = 0.002  # between looks at a controller that has not been spoken to


@dataclass(frozen=True)
class Faults:
    """Faults that act from ``begin_s`` on, on the emulator's clock.

    Attributes
    ----------
    begin_s : float, s
    silent : bool, nothing is answered any more
    garble : float, chance that a byte, in either direction, is replaced by any other
    seed : int, of the generator that draws those bytes
    lose_oks : int, how many of the next ok never arrive
    alarm : bool, the limit switch closes during the next motion
    stuck : bool, a motion goes no further, though the controller says it does
    slow : float, how many times longer a motion takes
    restart : bool, the supply dips; the controller starts anew and takes where it stands for zero
    quietly : bool, the banner of that restart is lost
    late_cancel : bool, a jog is cancelled as it ends, which leaves Grbl suspended until a "~"
    unplug : bool, the line breaks
    """

    begin_s: float = 0.0
    silent: bool = False
    garble: float = 0.0
    seed: int = 0
    lose_oks: int = 0
    alarm: bool = False
    stuck: bool = False
    slow: float = 1.0
    restart: bool = False
    quietly: bool = False
    late_cancel: bool = False
    unplug: bool = False


NO_FAULTS = Faults()


def with_garbled_bytes(data: bytes, chance: float, generator: np.random.Generator) -> bytes:
    """The bytes, each replaced with this chance by another value."""
    if chance <= 0 or not data:
        return data
    values = np.frombuffer(data, dtype=np.uint8)
    hit = generator.random(values.size) < chance
    other = (values + generator.integers(1, 256, values.size)) % 256
    return np.where(hit, other, values).astype(np.uint8).tobytes()


class PseudoTerminal:
    """A controller behind a pseudo-terminal, in real time, in a thread of its own.

    with PseudoTerminal(GrblEmulator()) as terminal:
        ...  # open terminal.port as a serial port
    """

    def __init__(self, controller: EmulatedController) -> None:
        self._controller = controller
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)  # no echo, no line ends changed
        self.port = os.ttyname(self._slave)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._serve, name=f"serial {self.port}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Pull the cable: the port vanishes under whoever has it open; twice is harmless."""
        self._ended.set()
        self._thread.join()
        self._close_ends()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _serve(self) -> None:
        _carry(self._controller, self._master, self._ended)
        if not self._ended.is_set():
            self._close_ends()

    def _close_ends(self) -> None:
        for end in (self._master, self._slave):
            with contextlib.suppress(OSError):
                os.close(end)
        self._master = self._slave = -1


class TcpPort:
    """A controller behind a port of the loopback address, for one client after the other.

    with TcpPort(GrblEmulator()) as line:
        ...  # connect to line.port, socket://127.0.0.1:NUMBER; line.drop() ends a connection
    """

    def __init__(self, controller: EmulatedController, number: int = 0) -> None:
        """Listen.  number: of the port, 0 for any that is free."""
        self._controller = controller
        self._listener = socket.create_server(("127.0.0.1", number))
        self.port = f"socket://127.0.0.1:{self._listener.getsockname()[1]}"
        self._client: socket.socket | None = None
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._serve, name=self.port, daemon=True)
        self._thread.start()

    def drop(self) -> None:
        """End the connection; the controller stays under power, and another may follow."""
        if (client := self._client) is not None:
            with contextlib.suppress(OSError):
                client.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Refuse connections and end the one there is; twice is harmless."""
        self._ended.set()
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        self._listener.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _serve(self) -> None:
        with contextlib.suppress(OSError):  # of a listener that was shut down
            while not self._ended.is_set():
                with self._listener.accept()[0] as self._client:
                    _carry(self._controller, self._client.fileno(), self._ended)


def _carry(controller: EmulatedController, line: int, ended: threading.Event) -> None:
    """Carry bytes over a descriptor until told to end, or the line or the controller ends it."""
    with contextlib.suppress(OSError):
        while not ended.is_set():
            ready, _, _ = select.select([line], [], [], POLL_S)
            if ready:
                if not (data := os.read(line, 4096)):
                    return
                controller.receive(data)
            if data := controller.transmit():
                os.write(line, data)
