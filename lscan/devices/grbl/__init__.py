"""A track on a serial line or a network whose controller runs Grbl 1.1 or Marlin.

[track]
driver = "grbl"
options = { port = "/dev/ttyUSB0", min_mm = 0, max_mm = 180, zero_mm = -190 }
"""

import time
from collections.abc import Callable
from functools import partial

from lscan.config.rig import RigFile
from lscan.devices.api import Fact, TravelDriver
from lscan.devices.grbl.controller import GrblMachine
from lscan.devices.grbl.machine import ROUNDING_MM, Link, SerialTrackOptions, Transport, open_serial
from lscan.devices.grbl.marlin import MarlinMachine
from lscan.devices.grbl.track import SerialTrack

__all__ = ["SerialTrack", "SerialTrackOptions", "open_track", "track_driver"]


def open_track(
    options: SerialTrackOptions,
    transport: Transport | None = None,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
    connect: Callable[[], Transport] | None = None,
) -> SerialTrack:
    """The track the options describe, awake and homed where they say so.

    Parameters
    ----------
    options : SerialTrackOptions
        ``[track.options]`` of a rig file.
    transport : Transport, optional
        In place of ``options.port``.
    clock, sleep : callable
        The time it lives in, s.
    connect : callable, optional
        Gives another transport where this one breaks; where neither is given, ``options.port`` is
        opened again.

    Returns
    -------
    SerialTrack
        At rest.

    Raises
    ------
    DeviceError
        Where the port does not open or the controller does not answer.
    """
    name = f"{options.dialect} track on {options.port}"
    if transport is None:
        line = options.port, options.baud, name, options.write_s, options.dtr
        connect = partial(open_serial, *line)
        transport = connect()
    link = Link(transport, name, clock, sleep, options.write_s, connect)
    kind = GrblMachine if options.dialect == "grbl" else MarlinMachine
    return SerialTrack(kind(link, options), options, link)


class SerialTrackDriver(TravelDriver[SerialTrackOptions]):
    """Registered as "grbl" under ``lscan.tracks``."""

    model, slack_mm = SerialTrackOptions, ROUNDING_MM
    switches_laser = True
    connection_options = frozenset(
        {
            *("port", "baud", "dtr", "boot_s", "answer_s", "homing_s", "write_s"),
            *("reconnects", "reconnect_wait_s"),
        }
    )

    def capabilities(self, rig_file: RigFile) -> dict[str, Fact]:
        """How it is reached, its travel, and whether it homes."""
        options = self.options(rig_file)
        names = {"port", "dialect", "min_mm", "max_mm", "tolerance_mm"}
        return {**options.model_dump(include=names), "homes_on_opening": options.homing}

    def open(self, rig_file: RigFile) -> SerialTrack:
        """The track, awake and homed where its options say so."""
        return open_track(self.options(rig_file))


track_driver = SerialTrackDriver()
