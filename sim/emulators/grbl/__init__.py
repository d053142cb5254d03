"""A linear track whose controller answers as Grbl 1.1 or a relative does, or as Marlin.

``GrblEmulator`` is the controller and the axes, ``DirectLine`` a serial line to it in simulated
time, ``PseudoTerminal`` one that any program opens as a serial port, ``Faults`` what goes wrong.
"""

from sim.emulators.grbl.controller import GrblEmulator, MarlinEmulator
from sim.emulators.grbl.machine import DirectLine, Faults, PseudoTerminal, SimulatedTime
from sim.emulators.grbl.protocol import (
    DEFAULTS,
    FLUIDNC,
    GRBL,
    GRBL_ESP32,
    GRBLHAL,
    GRBLHAL_AS_GRBL,
    Firmware,
)

__all__ = [
    "DEFAULTS", "FLUIDNC", "GRBL", "GRBLHAL", "GRBLHAL_AS_GRBL", "GRBL_ESP32", "DirectLine",
    "Faults", "Firmware", "GrblEmulator", "MarlinEmulator", "PseudoTerminal", "SimulatedTime",
]  # fmt: skip
