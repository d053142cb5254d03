"""``lscan-sim serve``: the hardware switched on, said where, and left running until stopped."""

import os
import signal
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer

from lscan.cli.console import Json, note, print_json, progress_bar
from lscan.devices.signals import ignore_stop_signals, on_stop_signals
from lscan.errors import InputError
from lscan.files.disk import make_folder, read_text
from sim.cli.arguments import print_places


def serve(
    scenes: Annotated[
        list[Path],
        typer.Argument(
            help="Scene file (TOML), or a name that `lscan scenes` lists; of several, such as the "
            "board and what is to be scanned, each has a webcam and a track of its own."
        ),
    ],
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
        Path | None,
        typer.Option(
            "--write-rig", help="Rig file to write, for lscan; of several scenes a folder."
        ),
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
    from sim.emulators.hardware import EmulatedHardware, parse_fault
    from sim.emulators.track import ServeOptions

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
    of_one = {"--http-port": http_port, "--link": link, "--fault": fault}
    if len(scenes) > 1 and (given_one := [name for name, value in of_one.items() if value]):
        raise InputError("goes with one scene", where=", ".join(given_one))
    loaded, timed = [load_checked(scene) for scene in scenes], [*map(parse_fault, fault or [])]
    rigs = _rig_files(scenes, write_rig)
    with (
        on_stop_signals(_leave),
        progress_bar("render") as progress,
        ExitStack() as stack,
    ):
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
                print_places(found[-1], json)
            if rig is not None and not json:
                note(f"next, elsewhere: lscan live {rig}, or lscan scan {rig} -o runs/{rig.stem}")
        if json:
            print_json(found[0] if len(found) == 1 else {"scenes": found})
        sys.stdout.flush()
        while True:
            # Not a lock: Mitsuba puts its SIGINT handler back in such a way (SA_RESTART) that
            # the signal no longer interrupts waiting for one.
            signal.pause()


def _rig_files(scenes: list[Path], write_rig: Path | None) -> list[Path | None]:
    """Where each scene's rig file goes: of several into a folder, made here, by the scene's name.

    Nothing but what this command wrote is replaced, least of all a scene.
    """
    from sim.emulators.hardware import HEADING

    if write_rig is None:
        return [None] * len(scenes)
    files = [write_rig]
    if len(scenes) > 1:
        files = [write_rig / f"{scene.stem}.toml" for scene in scenes]
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
