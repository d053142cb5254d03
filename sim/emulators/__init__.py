"""The tank as hardware: a webcam over HTTP and a Grbl track on a pseudo-terminal."""

from sim.emulators.hardware import NAMES, EmulatedHardware, TimedFault, parse_fault
from sim.emulators.track import ServeOptions

__all__ = ["NAMES", "EmulatedHardware", "ServeOptions", "TimedFault", "parse_fault"]
