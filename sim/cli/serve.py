"""``lscan-sim serve``: the hardware switched on, said where, and left running until stopped."""

import os
import signal
import sys
from contextlib import ExitStack
from pathlib import Path

from typer import Argument, Option

from lscan.cli.console import Json, note, progress_bar, show
from lscan.config.documents import check
from lscan.devices.signals import ignore_stop_signals, on_stop_signals
from lscan.errors import InputError
from lscan.files.disk import make_folder, read_text
from sim.cli.app import show_places
from sim.devices import load_checked
from sim.emulators.hardware import HEADING, EmulatedHardware, parse_fault
from sim.emulators.track import ServeOptions


def serve(
    scenes: list[Path] = Argument(
        help="Scene file (TOML), or a name that `lscan scenes` lists; with several, such as the "
        "board and what is to be scanned, each has a webcam and a track of its own."
    ),
    http_port: int = Option(0, help="Port of the webcam; 0 for any that is free."),
    fps: float = Option(30.0, help="Pictures per second."),
    quality: int = Option(95, help="Quality of the JPEGs, 1 to 100."),
    subsampling: str = Option("4:4:4", help="Chroma of the JPEGs: 4:4:4, 4:2:2 or 4:2:0."),
    switched_laser: bool = Option(False, "--switched-laser", help="The laser is lit by M3 only."),
    prepare: bool = Option(False, "--prepare", help="Render the whole plan before serving."),
    places: int = Option(64, help="Number of renderings kept, 5 MB each."),
    dialect: str = Option("grbl", help="Dialect of the controller: grbl or marlin."),
    link: Path | None = Option(None, help="Permanent name (a link) for the serial port."),
    tcp: bool = Option(False, "--tcp", help="Serve the controller over TCP, not a serial port."),
    write_rig: Path | None = Option(
        None, help="Rig file to write for lscan; for several scenes, a folder."
    ),
    fault: list[str] | None = Option(
        None, help="Fault to inject, as NAME@SECONDS after the start; none@SECONDS ends it."
    ),
    json: Json = False,
) -> None:
    """Serve the tank as a webcam (MJPEG, loopback) and a Grbl track until Ctrl-C."""
    given = {
        "http_port": http_port, "fps": fps, "quality": quality, "subsampling": subsampling,
        "places": places, "switched_laser": switched_laser, "prepare": prepare,
        "dialect": dialect, "link": link, "tcp": tcp,
    }  # fmt: skip
    options = check(ServeOptions, given, where=None, prefix="--")
    of_one = {"--http-port": http_port, "--link": link, "--fault": fault}
    if len(scenes) > 1 and (given_one := [name for name, value in of_one.items() if value]):
        raise InputError("goes with one scene", where=", ".join(given_one))
    loaded, timed = [load_checked(scene) for scene in scenes], [*map(parse_fault, fault or [])]
    rigs = _rig_files(scenes, write_rig)
    with on_stop_signals(_leave), progress_bar("render") as progress, ExitStack() as stack:
        served = [stack.enter_context(EmulatedHardware(one, options, progress)) for one in loaded]
        found = []
        for scene, hardware, rig in zip(scenes, served, rigs, strict=True):
            if rig is not None:
                hardware.write_rig(rig)
            for one in timed:
                hardware.schedule(one)
            place = {"scene": str(scene), "url": hardware.url, "snapshot": hardware.snapshot_url}
            place["port"] = hardware.port
            found.append(place if rig is None else {**place, "rig": str(rig)})
            if not json:
                show_places(found[-1], json)
            if rig is not None and not json:
                scan = f"lscan scan {rig} -o runs/{rig.stem}"
                note(f"next, in another terminal: lscan live {rig}, or {scan}")
        show(found[0] if len(found) == 1 else {"scenes": found}, json=json)
        sys.stdout.flush()
        while True:
            # Not a lock: Mitsuba puts its SIGINT handler back in such a way (SA_RESTART) that
            # the signal no longer interrupts waiting for one.
            signal.pause()


def _rig_files(scenes: list[Path], write_rig: Path | None) -> list[Path | None]:
    """Where each scene's rig file goes: of several into a folder, made here, by the scene's name.

    Nothing but what this command wrote is replaced, least of all a scene.
    """
    if write_rig is None:
        return [None] * len(scenes)
    several = [write_rig / f"{scene.stem}.toml" for scene in scenes]
    files = several if len(scenes) > 1 else [write_rig]
    if len(set(files)) < len(files):
        names = ", ".join(str(scene) for scene in scenes)
        raise InputError("would have rig files of one name", where="scenes", value=names)
    for file in files:
        if os.path.lexists(file) and not read_text(file).startswith(HEADING):
            allowed = "a new file, or one that lscan-sim serve wrote"
            raise InputError("is another file", where=file, allowed=allowed)
        make_folder(file.parent)
    return [*files]


def _leave() -> None:
    """Leave through every ``with`` block, which a second signal must not cut short."""
    ignore_stop_signals()
    sys.exit(0)
