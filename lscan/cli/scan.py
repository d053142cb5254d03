"""The command ``lscan scan``: a thin face over lscan.acquisition.scan."""

from pathlib import Path
from typing import Annotated

import typer

from lscan.cli.console import (
    Json,
    RigOrScene,
    keep_notes_when_stopped,
    note,
    print_json,
    progress_bar,
)


def scan(
    rig: RigOrScene,
    output: Annotated[Path, typer.Option("--output", "-o", help="Run folder to write.")],
    resume: Annotated[bool, typer.Option("--resume", help="Go on with a stopped run.")] = False,
    position_restored: Annotated[
        bool,
        typer.Option(
            "--position-restored",
            help="With --resume, after the track lost its zero: the head was put back by hand.",
        ),
    ] = False,
    json: Json = False,
) -> None:
    """Move the track, take the pictures, write a run folder."""
    from lscan.acquisition.scan import scan as acquire
    from lscan.acquisition.writer import holds_no_run
    from lscan.config.rig import load_rig
    from lscan.errors import InputError

    if position_restored and not resume:
        raise InputError("goes with --resume only", where="--position-restored")
    rig_file = load_rig(rig)
    if resume and holds_no_run(output):
        note(f"there is nothing to resume in {output}; a new run is begun")
    with keep_notes_when_stopped(), progress_bar("scan") as progress:
        run = acquire(
            rig_file, output, resume=resume, position_restored=position_restored, progress=progress
        )
    if json:
        print_json({"run": run.path, "frames": len(run), "state": run.state})
    else:
        print(f"{len(run)} {'frame' if len(run) == 1 else 'frames'} in {run.path}")


# The command ``lscan live``: a thin face over lscan.live.


def live(
    rig: RigOrScene,
    calibration: Annotated[
        Path | None, typer.Option("--calibration", "-c", help="Calibration file (JSON).")
    ] = None,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for the run folders.")
    ] = Path("runs"),
    host: Annotated[str, typer.Option(help="Address to serve on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port; 0: any that is free.")] = 8765,
    token: Annotated[
        str | None,
        typer.Option(help="What a browser must know; made for a --host that others reach."),
    ] = None,
) -> None:
    """Serve a page with the picture, the line, the profile and the buttons of a scan."""
    from lscan.calibration.calibrationfile import load_plane_map
    from lscan.config.rig import load_rig
    from lscan.devices.signals import no_suspending, on_stop_signals
    from lscan.errors import DeviceError
    from lscan.live.scanning import use_map
    from lscan.live.server import grant, listen, make_server
    from lscan.live.session import Session
    from lscan.pipeline import require_size

    rig_file, used = load_rig(rig), None
    if calibration is not None:
        plane_map, size_px = load_plane_map(calibration)
        require_size(rig_file.rig.camera, size_px, calibration, rig)
        used = use_map(calibration, plane_map, rig_file)
    with listen(host, port) as listening:
        access = grant(host, listening.getsockname()[1], token)
        session = Session(rig_file, output, used)
        server = make_server(session, access)
        # Whatever signals come, and however many: the laser is off before the program ends.
        with on_stop_signals(server.stop), no_suspending():
            try:
                first, *others = access.addresses
                print(f"{first}  (Ctrl-C ends)", *others, sep="\n", flush=True)
                print(access.remark, flush=True)
                server.run(sockets=[listening])
            finally:
                unfinished = session.close()
            if unfinished is not None:
                print(f"stopped; go on with: lscan scan {rig} -o {unfinished} --resume", flush=True)
    if session.laser_warning:
        raise DeviceError(session.laser_warning)


# ``lscan scenes``: the scenes that come with lscan, listed or copied.


def scenes(
    copy: Annotated[Path | None, typer.Option(help="New folder to copy all scenes to.")] = None,
    json: Json = False,
) -> None:
    """List the scenes, rigs and boards that come with lscan, or copy them to be changed."""
    from lscan.config.scenes import copy_scenes, scene_about, scene_names

    names = scene_names()
    if copy is not None:
        copy_scenes(copy)
    if json:
        print_json({"scenes": names, "copied_to": copy})
    elif copy is not None:
        print(f"{len(names)} scenes, rigs and boards in {copy}")
    else:
        for name in names:
            print(f"{name:26}{scene_about(name)}")
