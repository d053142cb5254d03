"""A linear track whose controller answers as Grbl 1.1 does, written from its documentation.

``GrblEmulator`` is the controller and the axes, ``DirectLine`` a serial line to it in simulated
time, ``PseudoTerminal`` one that any program opens as a serial port, ``Faults`` what goes wrong.
"""

from sim.emulators.grbl.controller import GrblEmulator
from sim.emulators.grbl.line import DirectLine, Faults, PseudoTerminal, SimulatedTime
from sim.emulators.grbl.marlin import MarlinEmulator
from sim.emulators.grbl.settings import DEFAULTS

__all__ = [
    "DEFAULTS",
    "DirectLine",
    "Faults",
    "GrblEmulator",
    "MarlinEmulator",
    "PseudoTerminal",
    "SimulatedTime",
]
