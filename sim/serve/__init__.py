"""The tank as hardware: a webcam over HTTP and a Grbl track on a pseudo-terminal."""

from sim.serve.faults import NAMES, TimedFault, parse_fault
from sim.serve.hardware import EmulatedHardware
from sim.serve.options import ServeOptions

__all__ = ["NAMES", "EmulatedHardware", "ServeOptions", "TimedFault", "parse_fault"]
