"""``lscan-sim serve``: the hardware switched on, said where, and left running until stopped."""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from types import FrameType

from lscan.cli.console import print_json, progress_bar
from sim.emulators.faults import parse_fault
from sim.emulators.hardware import EmulatedHardware
from sim.emulators.options import ServeOptions
from sim.scene import Scene


def serve_until_stopped(
    scene: Scene, options: ServeOptions, rig: Path | None, faults: Sequence[str], json: bool
) -> None:
    """Serve until SIGINT or SIGTERM, which leave with exit code 0 and nothing behind.

    rig: file to write the rig of the hardware to.  faults: as ``NAME@SECONDS``.  json: say
    where things are in one JSON object, else in lines.  Raises InputError where an option,
    the scene, a fault or a file is wrong, before anything is said.
    """
    timed = [parse_fault(text) for text in faults]
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _stop)
    with progress_bar("render") as progress, EmulatedHardware(scene, options, progress) as hardware:
        if rig is not None:
            hardware.write_rig(rig)
        for fault in timed:
            hardware.schedule(fault)
        _announce(hardware, rig, json)
        while True:
            # Not a lock: Mitsuba puts its SIGINT handler back in such a way (SA_RESTART) that
            # the signal no longer interrupts waiting for one.
            signal.pause()


def _stop(number: int, frame: FrameType | None) -> None:
    """Leave through every ``with`` block, which a second signal must not cut short."""
    for name in (signal.SIGINT, signal.SIGTERM):
        signal.signal(name, signal.SIG_IGN)
    sys.exit(0)


def _announce(hardware: EmulatedHardware, rig: Path | None, json: bool) -> None:
    where = {"url": hardware.url, "snapshot": hardware.snapshot_url, "port": hardware.port}
    if rig is not None:
        where["rig"] = str(rig)
    if json:
        print_json(where)
    else:
        for name, place in where.items():
            print(f"{name}: {place}")
    sys.stdout.flush()
