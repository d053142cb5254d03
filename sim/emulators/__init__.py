"""The tank as hardware: a webcam over HTTP and a Grbl track on a pseudo-terminal."""

from sim.emulators.faults import NAMES, TimedFault, parse_fault
from sim.emulators.hardware import EmulatedHardware
from sim.emulators.options import ServeOptions

__all__ = ["NAMES", "EmulatedHardware", "ServeOptions", "TimedFault", "parse_fault"]
