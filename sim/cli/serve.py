"""``lscan-sim serve``: the hardware switched on, said where, and left running until stopped."""

import signal
import sys
from pathlib import Path
from typing import Annotated

import typer

from lscan.cli.arguments import Json
from lscan.cli.console import progress_bar
from lscan.devices.signals import STOPPING, on_stop_signals
from sim.cli.arguments import SceneFile, print_places


def serve(
    scene: SceneFile,
    http_port: Annotated[int, typer.Option("--http-port", help="Of the webcam; 0: any.")] = 0,
    fps: Annotated[float, typer.Option("--fps", help="Pictures per second.")] = 30.0,
    quality: Annotated[int, typer.Option("--quality", help="Of the JPEGs, 1 to 100.")] = 95,
    subsampling: Annotated[
        str, typer.Option("--subsampling", help="Chroma: 4:4:4, or a webcam's 4:2:2, 4:2:0.")
    ] = "4:4:4",
    switched_laser: Annotated[
        bool, typer.Option("--switched-laser", help="Lit only by M3, else always.")
    ] = False,
    prepare: Annotated[
        bool, typer.Option("--prepare", help="Render the whole plan before opening.")
    ] = False,
    places: Annotated[int, typer.Option("--places", help="Renderings kept, 5 MB each.")] = 64,
    dialect: Annotated[str, typer.Option("--dialect", help="grbl or marlin.")] = "grbl",
    link: Annotated[
        Path | None, typer.Option("--link", help="Lasting name for the serial port.")
    ] = None,
    write_rig: Annotated[
        Path | None, typer.Option("--write-rig", help="Rig file to write, for lscan.")
    ] = None,
    fault: Annotated[
        list[str] | None,
        typer.Option("--fault", help="NAME@SECONDS after the start; none@SECONDS ends it."),
    ] = None,
    json: Json = False,
) -> None:
    """The tank as a webcam (MJPEG, loopback) and a Grbl track; runs until Ctrl-C."""
    from lscan.config.documents import check
    from sim.devices import load_checked
    from sim.emulators.faults import parse_fault
    from sim.emulators.hardware import EmulatedHardware
    from sim.emulators.options import ServeOptions

    given = {
        "http_port": http_port,
        "fps": fps,
        "quality": quality,
        "subsampling": subsampling,
        "places": places,
        "switched_laser": switched_laser,
        "prepare": prepare,
        "dialect": dialect,
        "link": link,
    }
    options = check(ServeOptions, given, where=None, prefix="--")
    loaded, timed = load_checked(scene), [parse_fault(text) for text in fault or []]
    with (
        on_stop_signals(_leave),
        progress_bar("render") as progress,
        EmulatedHardware(loaded, options, progress) as hardware,
    ):
        if write_rig is not None:
            hardware.write_rig(write_rig)
        for one in timed:
            hardware.schedule(one)
        found = {"url": hardware.url, "snapshot": hardware.snapshot_url, "port": hardware.port}
        print_places(found if write_rig is None else {**found, "rig": write_rig}, json)
        sys.stdout.flush()
        while True:
            # Not a lock: Mitsuba puts its SIGINT handler back in such a way (SA_RESTART) that
            # the signal no longer interrupts waiting for one.
            signal.pause()


def _leave() -> None:
    """Leave through every ``with`` block, which a second signal must not cut short."""
    for number in STOPPING:
        signal.signal(number, signal.SIG_IGN)
    sys.exit(0)
