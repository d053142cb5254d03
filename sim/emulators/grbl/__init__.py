"""A linear track whose controller answers as Grbl 1.1 or a relative does, or as Marlin.

``GrblEmulator`` is the controller and the axes, ``PseudoTerminal`` a line to it that any program
opens as a serial port, ``TcpPort`` one over TCP, ``Faults`` what goes wrong.
"""

from sim.emulators.grbl.controller import GrblEmulator, MarlinEmulator
from sim.emulators.grbl.machine import Faults, PseudoTerminal, TcpPort
from sim.emulators.grbl.protocol import DEFAULTS, GRBL, Firmware

__all__ = [
    "DEFAULTS", "GRBL", "Faults", "Firmware", "GrblEmulator", "MarlinEmulator", "PseudoTerminal",
    "TcpPort",
]  # fmt: skip
