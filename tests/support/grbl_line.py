"""A serial line to an emulated controller in simulated time, and Grbl's relatives at its end."""

from dataclasses import replace

from sim.emulators.grbl.machine import EmulatedController
from sim.emulators.grbl.protocol import Firmware

TICK_S = 0.002  # of simulated time that a read without an answer takes

GRBLHAL = Firmware(
    "GrblHAL 1.1f ['$' or '$HELP' for help]", "never", keeps_offset=True, modes=" G40 G49 G98 G50"
)
GRBLHAL_AS_GRBL = replace(GRBLHAL, banner="Grbl 1.1f ['$' for help]", tool="always")
GRBL_ESP32 = Firmware("Grbl 1.3a ['$' for help]")
FLUIDNC = Firmware(
    "Grbl 3.7 [FluidNC v3.7.17 (wifi) '$' for help]",
    silent_settings=frozenset({*range(7), 11, 12, 13, *range(24, 28), 31}),
)


class SimulatedTime:
    """A clock that goes on only when someone sleeps."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        """The time, s."""
        return self.now_s

    def sleep(self, seconds: float) -> None:
        """Let time pass at once."""
        self.now_s += seconds


class DirectLine:
    """A serial port without a wire: reading what has not come lets simulated time pass.

    controller: at the other end of the line.  time: its clock.
    """

    def __init__(self, controller: EmulatedController, time: SimulatedTime) -> None:
        self._controller, self._time = controller, time
        self._waiting = bytearray()
        self.closed = False

    @property
    def in_waiting(self) -> int:
        """Bytes ready to be read."""
        self._check_open()
        self._waiting += self._controller.transmit()
        return len(self._waiting)

    def read(self, size: int) -> bytes:
        """Up to ``size`` bytes; none after a tick of simulated time."""
        if not self.in_waiting:
            self._time.sleep(TICK_S)
        data = bytes(self._waiting[:size])
        del self._waiting[:size]
        return data

    def write(self, data: bytes) -> int:
        """Send bytes to the controller."""
        self._check_open()
        self._controller.receive(data)
        return len(data)

    def close(self) -> None:
        """Close the port."""
        self.closed = True

    def _check_open(self) -> None:
        if self.closed:
            raise OSError("the port is closed")
