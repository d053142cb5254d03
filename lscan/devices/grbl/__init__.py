"""A track on a serial line whose controller runs Grbl 1.1 or Marlin.

[track]
driver = "grbl"
options = { port = "/dev/ttyUSB0", min_mm = 0, max_mm = 180, zero_mm = -190 }
"""

from __future__ import annotations

import time
from collections.abc import Callable

from lscan.config.rig import RigFile
from lscan.devices.api import Fact
from lscan.devices.grbl.controller import GrblMachine
from lscan.devices.grbl.link import Link, Transport, open_serial
from lscan.devices.grbl.machine import Machine
from lscan.devices.grbl.marlin import MarlinMachine
from lscan.devices.grbl.options import SerialTrackOptions, read_options
from lscan.devices.grbl.track import SerialTrack

__all__ = ["SerialTrack", "SerialTrackOptions", "open_track", "track_driver"]


def open_track(
    options: SerialTrackOptions,
    transport: Transport | None = None,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> SerialTrack:
    """The track the options describe, awake and homed where they say so.

    transport: instead of the serial port ``options.port``.  clock, sleep: the time it lives in.
    Raises DeviceError where the port does not open or the controller does not answer.
    """
    name = f"{options.dialect} track on {options.port}"
    if transport is None:
        transport = open_serial(options.port, options.baud, name, options.write_s)
    link = Link(transport, name, clock, sleep, options.write_s)
    machine: Machine = (
        GrblMachine(link, options) if options.dialect == "grbl" else MarlinMachine(link, options)
    )
    return SerialTrack(machine, options, name, sleep)


class _TrackDriver:
    sections: frozenset[str] = frozenset()
    switches_laser = True
    connection_options = frozenset({"port", "baud", "boot_s", "answer_s", "homing_s", "write_s"})

    def validate(self, rig_file: RigFile) -> None:
        read_options(rig_file)

    def abilities(self, rig_file: RigFile) -> dict[str, Fact]:
        options = read_options(rig_file)
        return {
            "port": options.port,
            "dialect": options.dialect,
            "min_mm": options.min_mm,
            "max_mm": options.max_mm,
            "tolerance_mm": options.tolerance_mm,
            "homes_on_opening": options.homing,
        }

    def open(self, rig_file: RigFile) -> SerialTrack:
        return open_track(read_options(rig_file))


track_driver = _TrackDriver()
